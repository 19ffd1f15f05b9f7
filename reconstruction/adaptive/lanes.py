"""Vector instructions of kernels: boxes of cells, and the taps of single rays, on flat textures.

Numba vectorises no loop as short as a row of a box. These are written as vectors of `LANES` and of
`TAPS` float32, which LLVM maps to the registers that a processor has. No index is checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic as numba_intrinsic

LANES = 8
"""Cells of a vector: the rows of a box are padded to whole vectors."""
TAPS = 4
CUBIC = (
    (-0.5, 1.5, -1.5, 0.5),
    (1.0, -2.5, 2.0, -0.5),
    (-0.5, 0.0, 0.5, 0.0),
    (0.0, 1.0, 0.0, 0.0),
)
"""Coefficients of the four weights of Catmull-Rom interpolation, those of the third power first."""
_FLOAT, _INDEX, _LANE = ir.FloatType(), ir.IntType(64), ir.IntType(32)
_FAST = ("fast",)
intrinsic = cast(Callable[[Callable], Callable[..., Any]], numba_intrinsic)
"""A kernel calls it without its first parameter, Numba's context of types."""


class _Code:
    """Writes the instructions of one call: its arguments, arrays as their addresses."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.builder = builder
        self.arguments = []
        for kind, value in zip(signature.args, arguments, strict=True):
            if isinstance(kind, types.Array):
                self.arguments.append(context.make_array(kind)(context, builder, value).data)
            else:
                wanted = types.intp if isinstance(kind, types.Integer) else types.float32
                self.arguments.append(context.cast(builder, value, kind, wanted))

    def at(self, data: Any, index: Any, count: int) -> Any:
        """Return the address of the vector of `count` elements from an index on."""
        vector = ir.VectorType(data.type.pointee, count).as_pointer()
        return self.builder.bitcast(self.builder.gep(data, [index]), vector)

    def load(self, data: Any, index: Any, count: int) -> Any:
        """Return the elements from an index on, float32 or int16, as a vector of float32."""
        whole = data.type.pointee != _FLOAT
        values = self.builder.load(self.at(data, index, count), align=2 if whole else 4)
        return self.builder.sitofp(values, ir.VectorType(_FLOAT, count)) if whole else values

    def add(self, values: Any, data: Any, index: Any) -> None:
        """Add a vector to the float32 from an index on."""
        before = self.load(data, index, values.type.count)
        self.store(self.builder.fadd(before, values, flags=_FAST), data, index)

    def store(self, values: Any, data: Any, index: Any) -> None:
        """Set the float32 from an index on to a vector."""
        self.builder.store(values, self.at(data, index, values.type.count), align=4)

    def times(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=_FAST)

    def times_plus(self, a: Any, b: Any, c: Any) -> Any:
        return self.builder.fadd(self.times(a, b), c, flags=_FAST)

    def spread(self, value: Any, count: int) -> Any:
        """Return a vector of which every lane is the value."""
        none = ir.Constant(ir.VectorType(_FLOAT, count), ir.Undefined)
        one = self.builder.insert_element(none, value, _LANE(0))
        return self._lanes(one, [0] * count)

    def sum(self, values: Any) -> Any:
        """Return the sum of the lanes, one half added to the other."""
        count = values.type.count
        while count > 1:
            count //= 2
            low, high = (self._lanes(values, list(range(at, at + count))) for at in (0, count))
            values = self.builder.fadd(low, high, flags=_FAST)
        return self.builder.extract_element(values, _LANE(0))

    def cubic(self, fraction: Any) -> Any:
        """Return the weights of the four taps around a fraction in [0, 1)."""
        t = self.spread(fraction, TAPS)
        weights, *rest = (ir.Constant(ir.VectorType(_FLOAT, TAPS), list(row)) for row in CUBIC)
        for row in rest:
            weights = self.times_plus(weights, t, row)
        return weights

    def row(self, first: Any, row: int, wide: Any) -> Any:
        """Return the index of what lies `row` rows below an index."""
        return self.builder.add(first, self.builder.mul(wide, _INDEX(row)))

    def lane(self, values: Any, lane: int, count: int) -> Any:
        """Return a vector of which every lane is one of another's."""
        return self._lanes(values, [lane] * count)

    def _lanes(self, values: Any, which: list[int]) -> Any:
        none = ir.Constant(values.type, ir.Undefined)
        lanes = ir.Constant(ir.VectorType(_LANE, len(which)), which)
        return self.builder.shuffle_vector(values, none, lanes)

    @contextmanager
    def box(self, at: Any, wide: Any, start: Any, height: Any, vectors: Any) -> Iterator[Any]:
        """Loop over the vectors of a box: their indices on the texture and in the cells.

        Down the rows, vector by vector: most boxes are one vector wide.
        """
        lanes = _INDEX(LANES)
        with cgutils.for_range(self.builder, vectors) as across:
            top = self.builder.add(at, self.builder.mul(across.index, lanes))
            first = self.builder.add(start, across.index)
            with cgutils.for_range(self.builder, height) as down:
                on_texture = self.builder.add(top, self.builder.mul(down.index, wide))
                vector = self.builder.add(first, self.builder.mul(down.index, vectors))
                yield on_texture, self.builder.mul(vector, lanes)


@intrinsic
def read_box(_, texture, at, wide, cells, start, height, vectors):
    """Return the sum of a box of cells times what lies below on a flat float32 texture.

    at: of the texture's value below the first cell. wide: values from row to row. cells: (vector,
    LANES) int16 or float32, of the box from `start` on, `vectors` in each of `height` rows.
    """
    signature = types.float32(texture, at, wide, cells, start, height, vectors)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = _Code(context, builder, signature, arguments)
        values, at, wide, cells, *box = code.arguments
        total = cgutils.alloca_once(builder, ir.VectorType(_FLOAT, LANES))
        builder.store(ir.Constant(total.type.pointee, [0.0] * LANES), total)
        with code.box(at, wide, *box) as (here, there):
            seen, cell = code.load(values, here, LANES), code.load(cells, there, LANES)
            builder.store(code.times_plus(cell, seen, builder.load(total)), total)
        return code.sum(builder.load(total))

    return signature, generate


@intrinsic
def add_box(_, texture, at, wide, cells, start, height, vectors, value):
    """Add a box of cells, times a value, to what lies below on a texture, see `read_box`."""
    signature = types.void(texture, at, wide, cells, start, height, vectors, value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = _Code(context, builder, signature, arguments)
        values, at, wide, cells, *box, value = code.arguments
        share = code.spread(value, LANES)
        with code.box(at, wide, *box) as (here, there):
            code.add(code.times(code.load(cells, there, LANES), share), values, here)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def copy_box(_, texture, at, wide, cells, start, height, vectors):
    """Set a box of float32 cells to what lies below on a texture, see `read_box`."""
    signature = types.void(texture, at, wide, cells, start, height, vectors)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = _Code(context, builder, signature, arguments)
        values, at, wide, cells, *box = code.arguments
        with code.box(at, wide, *box) as (here, there):
            code.store(code.load(values, here, LANES), cells, there)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def read_taps(_, texture, at, wide, fraction_y, fraction_x):
    """Return a flat float32 texture between its values, from the first of four rows of taps on."""
    signature = types.float32(texture, at, wide, fraction_y, fraction_x)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = _Code(context, builder, signature, arguments)
        values, at, wide, fraction_y, fraction_x = code.arguments
        down, line = code.cubic(fraction_y), ir.Constant(ir.VectorType(_FLOAT, TAPS), [0.0] * TAPS)
        for row in range(TAPS):
            taps = code.load(values, code.row(at, row, wide), TAPS)
            line = code.times_plus(code.lane(down, row, TAPS), taps, line)
        return code.sum(code.times(line, code.cubic(fraction_x)))

    return signature, generate


@intrinsic
def add_taps(_, texture, at, wide, fraction_y, fraction_x, value):
    """Add the adjoint of `read_taps` of a value to a texture."""
    signature = types.void(texture, at, wide, fraction_y, fraction_x, value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = _Code(context, builder, signature, arguments)
        values, at, wide, fraction_y, fraction_x, value = code.arguments
        down = code.cubic(fraction_y)
        right = code.times(code.cubic(fraction_x), code.spread(value, TAPS))
        for row in range(TAPS):
            share = code.times(code.lane(down, row, TAPS), right)
            code.add(share, values, code.row(at, row, wide))
        return context.get_dummy_value()

    return signature, generate

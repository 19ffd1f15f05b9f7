"""Vector instructions of kernels: boxes of cells, and the taps of single rays, on flat textures.

Vectors are of `LANES` and of `TAPS` float32. No index is checked. With plain loops instead, which
Numba 0.68 does not vectorise when they are so short, `adaptive` takes 26 % more time (96x128, one
shot).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types

from emmc_rig.reconstruction.adaptive.vectors import FLOAT, LANE, Code, function, intrinsic

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
_INDEX = ir.IntType(64)
_FAST = ("fast",)


class _Code(Code):
    """Writes sums in any order."""

    def add(self, values: Any, data: Any, index: Any) -> None:
        """Add a vector to the float32 from an index on."""
        before = self.load(data, index, values.type.count)
        self.store(self.builder.fadd(before, values, flags=_FAST), data, index)

    def times(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=_FAST)

    def times_plus(self, a: Any, b: Any, c: Any) -> Any:
        return self.builder.fadd(self.times(a, b), c, flags=_FAST)

    def sum(self, values: Any) -> Any:
        """Return the sum of the lanes, one half added to the other."""
        count = values.type.count
        while count > 1:
            count //= 2
            low, high = (self.lanes(values, range(at, at + count)) for at in (0, count))
            values = self.builder.fadd(low, high, flags=_FAST)
        return self.builder.extract_element(values, LANE(0))

    def cubic(self, fraction: Any) -> Any:
        """Return the weights of the four taps around a fraction in [0, 1)."""
        t = self.spread(fraction, TAPS)
        weights, *rest = (ir.Constant(ir.VectorType(FLOAT, TAPS), list(row)) for row in CUBIC)
        for row in rest:
            weights = self.times_plus(weights, t, row)
        return weights

    def row(self, first: Any, row: int, wide: Any) -> Any:
        """Return the index of what lies `row` rows below an index."""
        return self.builder.add(first, self.builder.mul(wide, _INDEX(row)))

    def lane(self, values: Any, lane: int, count: int) -> Any:
        """Return a vector of which every lane is one of another's."""
        return self.lanes(values, [lane] * count)

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
def read_box(context, texture, at, wide, cells, start, height, vectors):
    """Return the sum of a box of cells times what lies below on a flat float32 texture.

    at: of the texture's value below the first cell. wide: values from row to row. cells: (vector,
    LANES) int16 or float32, of the box from `start` on, `vectors` in each of `height` rows.
    """

    def write(code, texture, at, wide, cells, *box):
        total = cgutils.alloca_once(code.builder, ir.VectorType(FLOAT, LANES))
        code.builder.store(ir.Constant(total.type.pointee, [0.0] * LANES), total)
        with code.box(at, wide, *box) as (here, there):
            seen, cell = code.load(texture, here, LANES), code.load(cells, there, LANES)
            code.builder.store(code.times_plus(cell, seen, code.builder.load(total)), total)
        return code.sum(code.builder.load(total))

    kinds = texture, at, wide, cells, start, height, vectors
    return function(types.float32, kinds, write, _Code)


@intrinsic
def add_box(context, texture, at, wide, cells, start, height, vectors, value):
    """Add a box of cells, times a value, to what lies below on a texture, see `read_box`."""

    def write(code, texture, at, wide, cells, start, height, vectors, value):
        share = code.spread(value, LANES)
        with code.box(at, wide, start, height, vectors) as (here, there):
            code.add(code.times(code.load(cells, there, LANES), share), texture, here)

    kinds = texture, at, wide, cells, start, height, vectors, value
    return function(types.void, kinds, write, _Code)


@intrinsic
def read_taps(context, texture, at, wide, fraction_y, fraction_x):
    """Return a flat float32 texture between its values, from the first of four rows of taps on."""

    def write(code, texture, at, wide, fraction_y, fraction_x):
        down, line = code.cubic(fraction_y), ir.Constant(ir.VectorType(FLOAT, TAPS), [0.0] * TAPS)
        for row in range(TAPS):
            taps = code.load(texture, code.row(at, row, wide), TAPS)
            line = code.times_plus(code.lane(down, row, TAPS), taps, line)
        return code.sum(code.times(line, code.cubic(fraction_x)))

    return function(types.float32, (texture, at, wide, fraction_y, fraction_x), write, _Code)


@intrinsic
def add_taps(context, texture, at, wide, fraction_y, fraction_x, value):
    """Add the adjoint of `read_taps` of a value to a texture."""

    def write(code, texture, at, wide, fraction_y, fraction_x, value):
        down = code.cubic(fraction_y)
        right = code.times(code.cubic(fraction_x), code.spread(value, TAPS))
        for row in range(TAPS):
            share = code.times(code.lane(down, row, TAPS), right)
            code.add(share, texture, code.row(at, row, wide))

    return function(types.void, (texture, at, wide, fraction_y, fraction_x, value), write, _Code)

"""Tiles of SIDE x SIDE numbers, of LANES problems each, that kernels keep in vector registers.

Small matrices of many problems are worked on side by side: a vector holds one entry of LANES
matrices. A compiler does not keep a tile's vectors in registers throughout a sum, since what is
stored might be what is read next; so these functions, which kernels call, are written in its own
language. Products and factors then are bound by arithmetic, at two products a vector read: with
plain loops over lanes for the Cholesky factor alone, `adaptive` takes 39 % more time (96x128, one
shot).

Matrices lie in flat float32 arrays, at an index: (row, column, lane) of a tile. The arguments
`flat`, `table` and `vectors` are such arrays; nothing checks their bounds.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import models, register_model

from emmc_rig.reconstruction.adaptive.vectors import FLOAT, Code, function, intrinsic

LANES = 16
"""Problems side by side: a vector register of AVX-512; other processors take several for it."""
SIDE = 4
"""Of a tile. Its 16 vectors and 8 of the factors fit the 32 registers."""

_VECTOR = ir.VectorType(FLOAT, LANES)
_TILE_OF = ir.ArrayType(_VECTOR, SIDE * SIDE)
_EACH = range(SIDE)


class _Tile(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Tile({SIDE}, {LANES})")


_TILE = _Tile()


@register_model(_Tile)
class _TileModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _TILE_OF)


class _Code(Code):
    """Writes vectors of LANES and tiles of them."""

    def read(self, flat: Any, at: Any, number: int = 0) -> Any:
        """Return the vector that lies `number` vectors beyond an index."""
        return self.load(flat, at, LANES, number * LANES)

    def write(self, flat: Any, at: Any, number: int, vector: Any) -> None:
        self.store(vector, flat, at, number * LANES)

    def called(self, name: str, *vectors: Any) -> Any:
        """Return what an intrinsic of the compiler makes of vectors."""
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(vectors))
        name = f"llvm.{name}.v{LANES}f32"
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, vectors)

    def plus(self, total: Any, left: Any, right: Any) -> Any:
        return self.called("fmuladd", left, right, total)

    def less(self, total: Any, left: Any, right: Any) -> Any:
        return self.plus(total, self.builder.fneg(left), right)

    def times(self, left: Any, right: Any) -> Any:
        return self.builder.fmul(left, right)

    def rows(self, tile: Any) -> list[list[Any]]:
        """Return the vectors of a tile, row by row."""
        return [
            [self.builder.extract_value(tile, row * SIDE + column) for column in _EACH]
            for row in _EACH
        ]

    def tile(self, rows: list[list[Any]]) -> Any:
        out = ir.Constant(_TILE_OF, ir.Undefined)
        for number, vector in enumerate(vector for row in rows for vector in row):
            out = self.builder.insert_value(out, vector, number)
        return out


def _function(returned: Any, kinds: Any, write: Any) -> Any:
    return function(returned, kinds, write, _Code)


@intrinsic
def zero_tile(context):
    """Return a tile of zeros."""
    return _function(_TILE, (), lambda code: ir.Constant(_TILE_OF, None))


@intrinsic
def load_tile(context, flat, at):
    """Return the tile at flat[at]."""

    def write(code, flat, at):
        return code.tile(
            [[code.read(flat, at, SIDE * row + column) for column in _EACH] for row in _EACH]
        )

    return _function(_TILE, (flat, at), write)


@intrinsic
def store_tile(context, tile, flat, at):
    """Put a tile at flat[at]."""

    def write(code, tile, flat, at):
        for row, vectors in enumerate(code.rows(tile)):
            for column, vector in enumerate(vectors):
                code.write(flat, at, SIDE * row + column, vector)

    return _function(types.void, (tile, flat, at), write)


@intrinsic
def scatter_tile(context, tile, flat, at, apart, places, first):
    """Put the vector of each row r and column c at flat[at + r * apart + places[first + c]].

    places: int64.
    """

    def write(code, tile, flat, at, apart, places, first):
        rows = code.rows(tile)
        for column in _EACH:
            to = code.builder.add(at, code.builder.load(code.place(places, first, column)))
            for row in _EACH:
                code.write(flat, to, 0, rows[row][column])
                to = code.builder.add(to, apart) if row < SIDE - 1 else to

    return _function(types.void, (tile, flat, at, apart, places, first), write)


@intrinsic
def multiplied(context, tile, other):
    """Return the product of two tiles, entry by entry."""

    def write(code, tile, other):
        pairs = zip(code.rows(tile), code.rows(other), strict=True)
        return code.tile([list(map(code.times, *rows)) for rows in pairs])

    return _function(_TILE, (tile, other), write)


@intrinsic
def combined(context, tile, other, flat):
    """Return a tile times the vector at flat[0], plus another times that at flat[LANES]."""

    def write(code, tile, other, flat):
        zero = ir.Constant(ir.IntType(64), 0)
        first, second = code.read(flat, zero, 0), code.read(flat, zero, 1)
        pairs = zip(code.rows(tile), code.rows(other), strict=True)
        return code.tile(
            [
                [
                    code.plus(code.times(own, first), its, second)
                    for own, its in zip(*rows, strict=True)
                ]
                for rows in pairs
            ]
        )

    return _function(_TILE, (tile, other, flat), write)


@intrinsic
def plus_diagonal(context, tile, flat, at):
    """Return a tile plus the SIDE vectors at flat[at], on its diagonal."""

    def write(code, tile, flat, at):
        out = code.rows(tile)
        for row in _EACH:
            out[row][row] = code.builder.fadd(out[row][row], code.read(flat, at, row))
        return code.tile(out)

    return _function(_TILE, (tile, flat, at), write)


@intrinsic
def plus_outer(context, tile, table, rows, first, term, vectors, at, apart):
    """Return a tile plus the outer product of numbers and vectors.

    The number of its row r is table[rows[first + r] + term], rows being int64; the vector of its
    column c lies at vectors[at + c * apart].
    """

    def write(code, tile, table, rows, first, term, vectors, at, apart):
        out = code.rows(tile)
        read = []
        for column in _EACH:
            read.append(code.read(vectors, at))
            at = code.builder.add(at, apart) if column < SIDE - 1 else at
        for row in _EACH:
            start = code.builder.load(code.place(rows, first, row))
            number = code.builder.load(code.place(table, code.builder.add(start, term)))
            number = code.spread(number, LANES)
            for column in _EACH:
                out[row][column] = code.plus(out[row][column], number, read[column])
        return code.tile(out)

    return _function(_TILE, (tile, table, rows, first, term, vectors, at, apart), write)


@intrinsic
def less_products(context, tile, flat, left, right):
    """Return a tile less the product of that at flat[left] and the transpose of that at right."""

    def write(code, tile, flat, left, right):
        out = code.rows(tile)
        for term in _EACH:
            others = [code.read(flat, right, SIDE * column + term) for column in _EACH]
            for row in _EACH:
                factor = code.read(flat, left, SIDE * row + term)
                for column in _EACH:
                    out[row][column] = code.less(out[row][column], factor, others[column])
        return code.tile(out)

    return _function(_TILE, (tile, flat, left, right), write)


@intrinsic
def factored(context, tile, least):
    """Return the Cholesky factor of a tile, the inverses of its pivots on the diagonal.

    Squared pivots are at least `least`. What is above the diagonal is neither read nor set.
    """

    def write(code, tile, least):
        out = code.rows(tile)
        least, unit = code.spread(least, LANES), ir.Constant(_VECTOR, [1.0] * LANES)
        for column in _EACH:
            for row in range(column, SIDE):
                for term in range(column):
                    out[row][column] = code.less(
                        out[row][column], out[row][term], out[column][term]
                    )
                if row == column:
                    square = code.called("maxnum", out[row][column], least)
                    out[row][column] = code.builder.fdiv(unit, code.called("sqrt", square))
                else:
                    out[row][column] = code.times(out[row][column], out[column][column])
        return code.tile(out)

    return _function(_TILE, (tile, least), write)


@intrinsic
def divided(context, tile, flat, factor):
    """Return a tile divided by the transpose of the factor (`factored`) at flat[factor]."""

    def write(code, tile, flat, factor):
        out = code.rows(tile)
        for column in _EACH:
            by = [code.read(flat, factor, SIDE * column + term) for term in range(column + 1)]
            for row in _EACH:
                for term in range(column):
                    out[row][column] = code.less(out[row][column], out[row][term], by[term])
                out[row][column] = code.times(out[row][column], by[column])
        return code.tile(out)

    return _function(_TILE, (tile, flat, factor), write)


@intrinsic
def take_applied(context, tile, flat, source, target):
    """Take a tile times the SIDE vectors at flat[source] off those at flat[target]."""

    def write(code, tile, flat, source, target):
        given = [code.read(flat, source, column) for column in _EACH]
        for row, vectors in enumerate(code.rows(tile)):
            left = code.read(flat, target, row)
            for vector, value in zip(vectors, given, strict=True):
                left = code.less(left, vector, value)
            code.write(flat, target, row, left)

    return _function(types.void, (tile, flat, source, target), write)


@intrinsic
def substitute(context, tile, flat, at):
    """Divide the SIDE vectors at flat[at] by a factor (`factored`)."""

    def write(code, tile, flat, at):
        solved = []
        for row, vectors in enumerate(code.rows(tile)):
            left = code.read(flat, at, row)
            for vector, value in zip(vectors, solved, strict=False):
                left = code.less(left, vector, value)
            solved.append(code.times(left, vectors[row]))
            code.write(flat, at, row, solved[row])

    return _function(types.void, (tile, flat, at), write)


def _conjugate_product(code: _Code, flat: Any, here: Any, there: Any) -> list[Any]:
    """Return real and imaginary part of flat[here] times the conjugate of flat[there]."""
    (real, imaginary), (other_real, other_imaginary) = (
        (code.read(flat, at, 0), code.read(flat, at, 1)) for at in (here, there)
    )
    return [
        code.plus(code.times(real, other_real), imaginary, other_imaginary),
        code.less(code.times(imaginary, other_real), real, other_imaginary),
    ]


@intrinsic
def meet(context, flat, here, there, out, at):
    """Put the product of the complex number at flat[here] and the conjugate of that at [there] at
    out[at]: real and imaginary part follow each other."""

    def write(code, flat, here, there, out, at):
        for number, vector in enumerate(_conjugate_product(code, flat, here, there)):
            code.write(out, at, number, vector)

    return _function(types.void, (flat, here, there, out, at), write)


@intrinsic
def meet_too(context, flat, here, there, out, at):
    """Add such a product, see `meet`, to what is at out[at]."""

    def write(code, flat, here, there, out, at):
        for number, vector in enumerate(_conjugate_product(code, flat, here, there)):
            code.write(out, at, number, code.builder.fadd(code.read(out, at, number), vector))

    return _function(types.void, (flat, here, there, out, at), write)

"""Vector instructions of blocks: which are alike, cosines in one, Walsh-Hadamard across a stack.

A block is SIDE x SIDE numbers. It lies in SIDE vectors, so that its transforms never leave the
registers; a quarter of it is a cell. Stacks, (block, row, column) of up to STACK blocks, and
pictures are flat float32 arrays. No index is checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types

from emmc_rig.reconstruction.adaptive.vectors import FLOAT, LANE, Code, function, intrinsic

SIDE = 8
CELL = SIDE // 2
STACK = 16
"""A power of two: a vector of each block fits the registers of AVX2."""
_C1, _C2, _C3, _C4, _C5, _C6, _C7 = (
    float(0.5 * np.cos(k * np.pi / (2 * SIDE))) for k in range(1, SIDE)
)
_ROW = ir.VectorType(FLOAT, SIDE)
_COUNTS = ir.VectorType(LANE, SIDE)
_INDEX = ir.IntType(64)
_FUSED = ("contract",)
"""Sums stay in the order written: a butterfly is no sum of all it spans."""


class _Row:
    """A vector of which sums and products can be written as formulas."""

    def __init__(self, builder: Any, values: Any) -> None:
        self.builder, self.values = builder, values

    def __add__(self, other: _Row) -> _Row:
        return _Row(self.builder, self.builder.fadd(self.values, other.values, flags=_FUSED))

    def __sub__(self, other: _Row) -> _Row:
        return _Row(self.builder, self.builder.fsub(self.values, other.values, flags=_FUSED))

    def __rmul__(self, number: float) -> _Row:
        by = ir.Constant(_ROW, [number] * SIDE)
        return _Row(self.builder, self.builder.fmul(self.values, by, flags=_FUSED))


def _analysed(rows: Sequence[_Row]) -> list[_Row]:
    """Return the eight cosine coefficients of eight values."""
    a, b, c, d, e, f, g, h = rows
    a, h, b, g, c, f, d, e = a + h, a - h, b + g, b - g, c + f, c - f, d + e, d - e
    return [
        _C4 * (a + d + b + c),
        _C1 * h + _C3 * g + _C5 * f + _C7 * e,
        _C2 * (a - d) + _C6 * (b - c),
        _C3 * h - _C7 * g - _C1 * f - _C5 * e,
        _C4 * (a + d - b - c),
        _C5 * h - _C1 * g + _C7 * f + _C3 * e,
        _C6 * (a - d) - _C2 * (b - c),
        _C7 * h - _C5 * g + _C3 * f - _C1 * e,
    ]


def _synthesised(rows: Sequence[_Row]) -> list[_Row]:
    """Return the eight values of eight cosine coefficients: the inverse of `_analysed`."""
    a, b, c, d, e, f, g, h = rows
    outer, inner = _C4 * (a + e), _C4 * (a - e)
    p, q = _C2 * c + _C6 * g, _C6 * c - _C2 * g
    k = _C1 * b + _C3 * d + _C5 * f + _C7 * h
    m = _C3 * b - _C7 * d - _C1 * f - _C5 * h
    n = _C5 * b - _C1 * d + _C7 * f + _C3 * h
    o = _C7 * b - _C5 * d + _C3 * f - _C1 * h
    return [
        outer + p + k, inner + q + m, inner - q + n, outer - p + o,
        outer - p - o, inner - q - n, inner + q - m, outer + p - k,
    ]  # fmt: skip


class _Code(Code):
    """Writes transforms of blocks and stacks."""

    def row_starts(self, at: Any, wide: Any, count: int = SIDE) -> list[Any]:
        """Return the indices of rows `wide` numbers apart, the first one's first."""
        return [self.builder.add(at, self.builder.mul(wide, _INDEX(row))) for row in range(count)]

    def rows(self, flat: Any, indices: Sequence[Any]) -> list[_Row]:
        return [_Row(self.builder, self.load(flat, at, SIDE)) for at in indices]

    def transposed(self, rows: Sequence[_Row]) -> list[_Row]:
        """Return a block with rows and columns exchanged: halves, quarters, and numbers of it."""
        out, lanes = [row.values for row in rows], range(SIDE)
        for apart in (4, 2, 1):
            upper = [n + SIDE - apart if n & apart else n for n in lanes]
            lower = [n + SIDE if n & apart else n + apart for n in lanes]
            for row in (n for n in lanes if not n & apart):
                pair = out[row], out[row + apart]
                out[row], out[row + apart] = (
                    self.builder.shuffle_vector(*pair, ir.Constant(_COUNTS, which))
                    for which in (upper, lower)
                )
        return [_Row(self.builder, row) for row in out]

    def across(self, rows: Sequence[_Row]) -> list[_Row]:
        """Return the Walsh-Hadamard transform of a power of two of rows, not normalised."""
        if len(rows) == 1:
            return list(rows)
        half = len(rows) // 2
        pairs = list(zip(rows[:half], rows[half:], strict=True))
        sums, differences = [a + b for a, b in pairs], [a - b for a, b in pairs]
        return [*self.across(sums), *self.across(differences)]

    def dropped(self, row: _Row, least: Any, kept: Any) -> tuple[_Row, Any]:
        """Return a row with values below `least` set to 0, and the counts of the other values."""
        kind = ir.FunctionType(_ROW, [_ROW])
        name = f"llvm.fabs.v{SIDE}f32"
        size = cgutils.get_or_insert_function(self.builder.module, kind, name)
        drop = self.builder.fcmp_ordered("<", self.builder.call(size, [row.values]), least)
        values = self.builder.select(drop, ir.Constant(_ROW, [0.0] * SIDE), row.values)
        stays = self.builder.zext(self.builder.not_(drop), _COUNTS)
        return _Row(self.builder, values), self.builder.add(kept, stays)


def _block(code: _Code, number: Any) -> list[Any]:
    """Return the indices of the rows of a stack's block."""
    return code.row_starts(code.builder.mul(number, _INDEX(SIDE * SIDE)), _INDEX(SIDE))


@intrinsic
def cells_apart(context, guide, own, first, wide, squares, at, height, vectors):
    """Set squares[at] and on to the squared distances of a cell to displaced cells of a picture.

    own: start of the cell, first: start of the first displaced cell, in the flat picture `guide`,
    whose rows are `wide` numbers apart. Displaced cells start at `height` rows of `vectors` * SIDE.
    """

    def write(code, guide, own, first, wide, squares, at, height, vectors):
        builder, steps = code.builder, range(CELL)
        cell = [
            [code.spread(builder.load(code.place(guide, row, n)), SIDE) for n in steps]
            for row in code.row_starts(own, wide, CELL)
        ]
        with cgutils.for_range(builder, height) as down, cgutils.for_range(builder, vectors) as to:
            begin = builder.add(first, builder.mul(to.index, _INDEX(SIDE)))
            begin = builder.add(begin, builder.mul(down.index, wide))
            total = ir.Constant(_ROW, [0.0] * SIDE)
            for row, numbers in zip(code.row_starts(begin, wide, CELL), cell, strict=True):
                for n, number in enumerate(numbers):
                    apart = builder.fsub(code.load(guide, row, SIDE, n), number, flags=_FUSED)
                    square = builder.fmul(apart, apart, flags=_FUSED)
                    total = builder.fadd(total, square, flags=_FUSED)
            vector = builder.add(builder.mul(down.index, vectors), to.index)
            code.store(total, squares, builder.add(at, builder.mul(vector, _INDEX(SIDE))))

    kinds = guide, own, first, wide, squares, at, height, vectors
    return function(types.void, kinds, write, _Code)


@intrinsic
def stack_block(context, picture, at, wide, stack, number):
    """Set a block of a stack to the cosine coefficients of a picture's from picture[at] on.

    wide: numbers from row to row of the picture.
    """

    def write(code, picture, at, wide, stack, number):
        rows = _analysed(code.rows(picture, code.row_starts(at, wide)))
        rows = _analysed(code.transposed(rows))
        for row, to in zip(rows, _block(code, number), strict=True):
            code.store(row.values, stack, to)

    return function(types.void, (picture, at, wide, stack, number), write, _Code)


@intrinsic
def add_block(context, stack, number, share, picture, at, wide):
    """Add a share of the block whose coefficients `stack_block` set to a picture."""

    def write(code, stack, number, share, picture, at, wide):
        rows = _synthesised(code.rows(stack, _block(code, number)))
        rows = _synthesised(code.transposed(rows))
        share = code.spread(share, SIDE)
        for row, to in zip(rows, code.row_starts(at, wide), strict=True):
            added = code.builder.fmul(row.values, share, flags=_FUSED)
            before = code.load(picture, to, SIDE)
            code.store(code.builder.fadd(before, added, flags=_FUSED), picture, to)

    return function(types.void, (stack, number, share, picture, at, wide), write, _Code)


@intrinsic
def shrink_stack(context, stack, count, least):
    """Drop what is nearer zero than `least` of the transform across a stack; return what is kept.

    count: of its blocks, a power of two. The stack's mean (0, 0, 0) stays, and counts where it is
    not nearer zero.
    """

    def write(code, stack, count, least):
        builder = code.builder
        total = cgutils.alloca_once(builder, LANE)
        builder.store(LANE(0), total)
        sizes = [2**power for power in range(STACK.bit_length())]
        for size in sizes:
            with builder.if_then(builder.icmp_signed("==", count, count.type(size))):
                # Transformed twice, a stack is `size` times as large.
                cut = builder.fmul(least, ir.Constant(FLOAT, float(np.sqrt(size))))
                _shrink_rows(code, stack, size, code.spread(cut, SIDE), total)
        return builder.load(total)

    return function(types.int32, (stack, count, least), write, _Code)


def _shrink_rows(code: _Code, stack: Any, size: int, least: Any, total: Any) -> None:
    builder = code.builder
    kept = cgutils.alloca_once(builder, _COUNTS)
    builder.store(ir.Constant(_COUNTS, [0] * SIDE), kept)
    with cgutils.for_range(builder, _INDEX(SIDE)) as loop:
        first = builder.mul(loop.index, _INDEX(SIDE))
        places = [builder.add(first, _INDEX(SIDE * SIDE * block)) for block in range(size)]
        seen, counts = code.across(code.rows(stack, places)), builder.load(kept)
        left = []
        for row in seen:
            row, counts = code.dropped(row, least, counts)
            left.append(row)
        builder.store(counts, kept)
        mean = builder.extract_element(seen[0].values, LANE(0))
        with_mean = builder.insert_element(left[0].values, mean, LANE(0))
        is_first = builder.icmp_signed("==", loop.index, _INDEX(0))
        left[0] = _Row(builder, builder.select(is_first, with_mean, left[0].values))
        for row, place in zip(code.across(left), places, strict=True):
            code.store((1 / size * row).values, stack, place)
    for lane in range(SIDE):
        of_lane = builder.extract_element(builder.load(kept), LANE(lane))
        builder.store(builder.add(builder.load(total), of_lane), total)

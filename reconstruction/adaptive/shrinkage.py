"""Remove white noise from a picture: like blocks are shrunk together, in opponent colours.

Collaborative filtering (BM3D's first step, Dabov et al. 2007): around every reference block the
blocks most like it are found on a cleaner picture, stacked, and transformed (cosines in the block,
Walsh-Hadamard across the stack); coefficients below a threshold are dropped, and the blocks put
back, averaged with the inverse of the number of coefficients kept. What a scene repeats, along an
edge or in a texture, is so learned from the scene itself.

Cosines along rows are taken once for the whole picture, and undone once for the sum of all blocks.
Operations of a reference block: 3 x 64 per block searched, 3 x 2 x 64 x 9 per block of the stack.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands, summed_in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.lightfield import OPPONENT
from reconstruction.adaptive.lanes import add_box, copy_box

Array = NDArray[np.floating]
SIDE = 8
STACK = 16
REACH = 9
"""Blocks are searched within so many samples along each axis."""
ALIKE = 4.0
"""Mean square difference of blocks that are stacked, at most, over the noise's variance. 2x -0.03,
0.5x +0.02 dB."""
LANES = 16
"""Blocks searched side by side."""
_C1, _C2, _C3, _C4, _C5, _C6, _C7 = (
    np.float32(0.5 * np.cos(k * np.pi / (2 * SIDE))) for k in range(1, SIDE)
)
_OPPONENT = OPPONENT.astype(np.float32)


@njit(inline="always")
def _analysed(a, b, c, d, e, f, g, h):
    """Return the eight cosine coefficients of eight values."""
    a, h, b, g, c, f, d, e = a + h, a - h, b + g, b - g, c + f, c - f, d + e, d - e
    return (
        _C4 * (a + d + b + c),
        _C1 * h + _C3 * g + _C5 * f + _C7 * e,
        _C2 * (a - d) + _C6 * (b - c),
        _C3 * h - _C7 * g - _C1 * f - _C5 * e,
        _C4 * (a + d - b - c),
        _C5 * h - _C1 * g + _C7 * f + _C3 * e,
        _C6 * (a - d) - _C2 * (b - c),
        _C7 * h - _C5 * g + _C3 * f - _C1 * e,
    )


@njit(inline="always")
def _synthesised(a, b, c, d, e, f, g, h):
    """Return the eight values of eight cosine coefficients: the inverse of `_analysed`."""
    outer, inner = _C4 * (a + e), _C4 * (a - e)
    p, q = _C2 * c + _C6 * g, _C6 * c - _C2 * g
    k = _C1 * b + _C3 * d + _C5 * f + _C7 * h
    m = _C3 * b - _C7 * d - _C1 * f - _C5 * h
    n = _C5 * b - _C1 * d + _C7 * f + _C3 * h
    o = _C7 * b - _C5 * d + _C3 * f - _C1 * h
    return (
        outer + p + k,
        inner + q + m,
        inner - q + n,
        outer - p + o,
        outer - p - o,
        inner - q - n,
        inner + q - m,
        outer + p - k,
    )


@njit(cache=True, fastmath=True, nogil=True)
def _rows_analysed(picture, first, last, out):
    """Set rows of out (c, y, x, SIDE) to the coefficients of the values from (y, x) rightward."""
    for c in range(picture.shape[0]):
        for y in range(first, last):
            row = picture[c, y]
            for x in range(out.shape[2]):
                (
                    out[c, y, x, 0], out[c, y, x, 1], out[c, y, x, 2], out[c, y, x, 3],
                    out[c, y, x, 4], out[c, y, x, 5], out[c, y, x, 6], out[c, y, x, 7],
                ) = _analysed(
                    row[x], row[x + 1], row[x + 2], row[x + 3],
                    row[x + 4], row[x + 5], row[x + 6], row[x + 7],
                )  # fmt: skip


@njit(cache=True, fastmath=True, nogil=True)
def _rows_synthesised(coefficients, first, last, out):
    """Add to rows of out (c, y, x) the values whose coefficients (c, y, x, SIDE) these are."""
    for c in range(out.shape[0]):
        for y in range(first, last):
            row = out[c, y]
            for x in range(coefficients.shape[2]):
                t = coefficients[c, y, x]
                values = _synthesised(t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7])
                for i in range(SIDE):
                    row[x + i] += values[i]


@njit(forceinline=True, fastmath=True)
def _columns_analysed(block, side):
    """Set a flat block to the coefficients of its columns; side is SIDE."""
    for x in range(side):
        (
            block[x], block[8 + x], block[16 + x], block[24 + x],
            block[32 + x], block[40 + x], block[48 + x], block[56 + x],
        ) = _analysed(
            block[x], block[8 + x], block[16 + x], block[24 + x],
            block[32 + x], block[40 + x], block[48 + x], block[56 + x],
        )  # fmt: skip


@njit(forceinline=True, fastmath=True)
def _columns_synthesised(block, side):
    """The inverse of `_columns_analysed`."""
    for x in range(side):
        (
            block[x], block[8 + x], block[16 + x], block[24 + x],
            block[32 + x], block[40 + x], block[48 + x], block[56 + x],
        ) = _synthesised(
            block[x], block[8 + x], block[16 + x], block[24 + x],
            block[32 + x], block[40 + x], block[48 + x], block[56 + x],
        )  # fmt: skip


@njit(forceinline=True, fastmath=True)
def _hadamard(stack, count):
    """Transform a stack (block, value) of `count` blocks, a power of two; its own inverse."""
    width = 1
    root = np.float32(np.sqrt(0.5))
    while width < count:
        for first in range(0, count, 2 * width):
            for k in range(first, first + width):
                one, other = stack[k], stack[k + width]
                for i in range(SIDE * SIDE):
                    a, b = one[i], other[i]
                    one[i] = (a + b) * root
                    other[i] = (a - b) * root
        width *= 2


@njit(forceinline=True, fastmath=True)
def _unlikeness(guide, y, x, top, left, width, squares):
    """Set squares (width,) to those of how far the blocks right of (top, left) are from (y, x)'s.

    guide: with columns to spare.
    """
    for n in range(width):
        squares[n] = 0
    for i in range(SIDE):
        own = guide[y + i, x : x + SIDE]
        a, b, c, d, e, f, g, h = own[0], own[1], own[2], own[3], own[4], own[5], own[6], own[7]
        row = guide[top + i, left:]
        for n in range(width):
            p, q, r, s = row[n] - a, row[n + 1] - b, row[n + 2] - c, row[n + 3] - d
            t, u, v, w = row[n + 4] - e, row[n + 5] - f, row[n + 6] - g, row[n + 7] - h
            squares[n] += p * p + q * q + r * r + s * s + t * t + u * u + v * v + w * w


@njit(forceinline=True, fastmath=True)
def _alike(guide, y, x, last_x, reach, unlike, squares, distances, places):
    """Set places (STACK, 2) to the blocks most like that at (y, x), itself first.

    last_x: the last column where blocks begin. unlike: the mean square difference beyond which
    blocks are not stacked. Returns how many, a power of two.
    """
    limit = unlike * SIDE * SIDE
    found = 1
    distances[0] = -1
    places[0, 0], places[0, 1] = y, x
    left, right = max(0, x - reach), min(last_x, x + reach)
    width = -(-(right - left + 1) // LANES) * LANES
    for yy in range(max(0, y - reach), min(guide.shape[0] - SIDE, y + reach) + 1):
        _unlikeness(guide, y, x, yy, left, width, squares)
        for xx in range(left, right + 1):
            square = squares[xx - left]
            worst = limit if found < STACK else min(limit, distances[STACK - 1])
            if square >= worst or (yy == y and xx == x):
                continue
            at = found if found < STACK else STACK - 1
            if found < STACK:
                found += 1
            while at > 1 and distances[at - 1] > square:
                distances[at] = distances[at - 1]
                places[at, 0], places[at, 1] = places[at - 1, 0], places[at - 1, 1]
                at -= 1
            distances[at] = square
            places[at, 0], places[at, 1] = yy, xx
    count = 1
    while count * 2 <= found:
        count *= 2
    return count


@njit(forceinline=True, fastmath=True)
def _cut(values, least):
    """Drop values below the least; return how many are kept."""
    kept = 0
    for n in range(values.size):
        drop = abs(values[n]) < least
        kept += 0 if drop else 1
        values[n] = np.float32(0) if drop else values[n]
    return kept


@njit(cache=True, fastmath=True, nogil=True)
def _shrink(rows, guide, side, cuts, unlike, reach, starts_y, starts_x, total, weight):
    """Add the blocks' estimates to total (c, y, x, SIDE) and their weights to weight (c, y, x).

    rows, total: coefficients of the SIDE values from (y, x) rightward. weight: where blocks begin.
    """
    flat = np.empty(STACK * SIDE * SIDE, np.float32)
    stack = flat.reshape(STACK, SIDE * SIDE)
    squares = np.empty(2 * reach + 1 + LANES, np.float32)
    distances = np.empty(STACK, np.float32)
    places = np.empty((STACK, 2), np.int64)
    _, length, begins, _ = rows.shape
    flat_rows, flat_total = rows.reshape(-1), total.reshape(-1)
    for y in starts_y:
        for x in starts_x:
            count = _alike(
                guide, y, x, rows.shape[2] - 1, reach, unlike, squares, distances, places
            )
            for c in range(rows.shape[0]):
                for k in range(count):
                    at = ((c * length + places[k, 0]) * begins + places[k, 1]) * SIDE
                    copy_box(flat_rows, at, begins * SIDE, flat, k * SIDE, SIDE, 1)
                    _columns_analysed(stack[k], side)
                _hadamard(stack, count)
                mean = flat[0]
                kept = 1 + _cut(flat[: count * SIDE * SIDE], cuts[c])
                flat[0] = mean
                _hadamard(stack, count)
                share = np.float32(1.0) / kept
                for k in range(count):
                    _columns_synthesised(stack[k], side)
                    at = ((c * length + places[k, 0]) * begins + places[k, 1]) * SIDE
                    add_box(flat_total, at, begins * SIDE, flat, k * SIDE, SIDE, 1, share)
                    weight[c, places[k, 0], places[k, 1]] += share


def _starts(length: int, step: int, first: int) -> NDArray[np.int64]:
    """Return where blocks start along an axis: every `step`, and at both ends."""
    inner = np.arange(first % step, length - SIDE + 1, step)
    return np.unique(np.concatenate([[0], inner, [length - SIDE]])).astype(np.int64)


def _spread(weight: Array, columns: int) -> Array:
    """Return on every sample (y, x) the sum of the weights of the blocks that cover it."""
    begins = np.pad(weight, ((0, 0), (0, columns - weight.shape[1])))
    found = cv2.boxFilter(
        begins,
        -1,
        (SIDE, SIDE),
        anchor=(SIDE - 1, SIDE - 1),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )
    return np.asarray(found, dtype=np.float32)


def denoised(
    picture: Array,
    guide: Array,
    sigma: float,
    step: int = 4,
    first: int = 0,
    threshold: float = 2.7,
    chroma: float = 2.5,
    reach: int = REACH,
) -> Array:
    """Return a picture (c, y, x) without white noise of deviation sigma in every colour.

    picture: of one colour, or RGB. guide: (c, y, x), a cleaner picture, in which like blocks are
    found. step: between reference blocks; first: where they begin, to vary over repeated calls.
    threshold: in deviations, chroma times as large in chrominance, which varies less.
    """
    mixing = _OPPONENT if len(picture) == 3 else np.eye(len(picture), dtype=np.float32)
    opponent = np.ascontiguousarray(np.einsum("oc,cyx->oyx", mixing, picture, optimize=True))
    luminance = np.ascontiguousarray(np.einsum("c,cyx->yx", mixing[0], guide, optimize=True))
    spare = np.pad(luminance, ((0, 0), (0, SIDE + LANES)))
    rows = _starts(picture.shape[1], step, first)
    columns = _starts(picture.shape[2], step, first)
    cuts = np.array([1, chroma, chroma], dtype=np.float32) * np.float32(threshold * sigma)
    begins = (*picture.shape[:2], picture.shape[2] - SIDE + 1)
    analysed = np.empty((*begins, SIDE), dtype=np.float32)
    in_bands(lambda _, top, end: _rows_analysed(opponent, top, end, analysed), picture.shape[1])
    totals = np.zeros((2, *analysed.shape), dtype=np.float32)
    weights = np.zeros((2, *begins), dtype=np.float32)
    unlike = np.float32(ALIKE * sigma**2)

    def work(which: int, begin: int, end: int) -> None:
        added = totals[which], weights[which]
        _shrink(analysed, spare, SIDE, cuts, unlike, reach, rows[begin:end], columns, *added)

    summed_in_bands(work, len(rows), (reach + SIDE / 2) / step)
    totals[0] += totals[1]
    weights[0] += weights[1]
    total = np.zeros(picture.shape, dtype=np.float32)
    in_bands(lambda _, top, end: _rows_synthesised(totals[0], top, end, total), picture.shape[1])
    mean = total / np.stack([_spread(part, picture.shape[2]) for part in weights[0]])
    return np.ascontiguousarray(np.einsum("oc,oyx->cyx", mixing, mean, optimize=True))

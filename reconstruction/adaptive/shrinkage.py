"""Remove white noise from a picture: like blocks are shrunk together, in opponent colours.

Collaborative filtering (BM3D's first step, Dabov et al. 2007): around every reference block the
blocks most like it are found on a cleaner picture, stacked, and transformed (cosines in the block,
Walsh-Hadamard across the stack); coefficients below a threshold are dropped, and the blocks put
back, averaged with the inverse of the number of coefficients kept. What a scene repeats, along an
edge or in a texture, is so learned from the scene itself.

Operations of a reference block: 64 per block searched, 2 x 3 x 1024 per block of the stack.
"""

from __future__ import annotations

import numpy as np
from numba import get_num_threads, njit
from numpy.typing import NDArray
from scipy.fft import dct

from reconstruction.adaptive.bands import in_bands
from reconstruction.problem import OPPONENT

Array = NDArray[np.floating]
SIDE = 8
STACK = 16
REACH = 9
"""Blocks are searched within so many samples along each axis."""
ALIKE = 4.0
"""Mean square difference of blocks that are stacked, at most, over the noise's variance."""
_COSINES = np.asarray(dct(np.eye(SIDE), axis=0, norm="ortho"), dtype=np.float32)
_TRANSPOSED = np.ascontiguousarray(_COSINES.T)
_OPPONENT = OPPONENT.astype(np.float32)


@njit(cache=True, fastmath=True)
def _transform(left, block, right, half):
    """Set block to left block right, all (SIDE, SIDE)."""
    for i in range(SIDE):
        for j in range(SIDE):
            half[i, j] = 0
        for k in range(SIDE):
            for j in range(SIDE):
                half[i, j] += left[i, k] * block[k, j]
    for i in range(SIDE):
        for j in range(SIDE):
            block[i, j] = 0
        for k in range(SIDE):
            for j in range(SIDE):
                block[i, j] += half[i, k] * right[k, j]


@njit(cache=True, fastmath=True)
def _hadamard(stack, count):
    """Transform a stack (block, SIDE, SIDE) of `count` blocks, a power of two; its own inverse."""
    width = 1
    root = np.float32(np.sqrt(0.5))
    while width < count:
        for first in range(0, count, 2 * width):
            for k in range(first, first + width):
                for i in range(SIDE):
                    for j in range(SIDE):
                        a, b = stack[k, i, j], stack[k + width, i, j]
                        stack[k, i, j] = (a + b) * root
                        stack[k + width, i, j] = (a - b) * root
        width *= 2


@njit(cache=True, fastmath=True)
def _alike(guide, y, x, reach, unlike, distances, places):
    """Set places (STACK, 2) to the blocks most like that at (y, x), itself first.

    unlike: the mean square difference beyond which blocks are not stacked. Returns how many, a
    power of two.
    """
    limit = unlike * SIDE * SIDE
    found = 1
    distances[0] = -1
    places[0, 0], places[0, 1] = y, x
    for yy in range(max(0, y - reach), min(guide.shape[0] - SIDE, y + reach) + 1):
        for xx in range(max(0, x - reach), min(guide.shape[1] - SIDE, x + reach) + 1):
            if yy == y and xx == x:
                continue
            worst = limit if found < STACK else min(limit, distances[STACK - 1])
            square = np.float32(0)
            for i in range(SIDE):
                for j in range(SIDE):
                    apart = guide[yy + i, xx + j] - guide[y + i, x + j]
                    square += apart * apart
                if square >= worst:
                    break
            if square >= worst:
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


@njit(cache=True, fastmath=True, nogil=True)
def _shrink(
    picture, guide, cosines, transposed, cuts, unlike, reach, starts_y, starts_x, total, weight
):
    """Add the blocks' estimates to total (c, y, x) and their weights to weight, alike."""
    half = np.empty((SIDE, SIDE), np.float32)
    stack = np.empty((STACK, SIDE, SIDE), np.float32)
    distances = np.empty(STACK, np.float32)
    places = np.empty((STACK, 2), np.int64)
    for row in range(starts_y.size):
        for x in starts_x:
            count = _alike(guide, starts_y[row], x, reach, unlike, distances, places)
            for c in range(picture.shape[0]):
                for k in range(count):
                    top, left = places[k]
                    for i in range(SIDE):
                        for j in range(SIDE):
                            stack[k, i, j] = picture[c, top + i, left + j]
                    _transform(cosines, stack[k], transposed, half)
                _hadamard(stack, count)
                kept = 1
                mean = stack[0, 0, 0]
                for k in range(count):
                    for i in range(SIDE):
                        for j in range(SIDE):
                            if abs(stack[k, i, j]) < cuts[c]:
                                stack[k, i, j] = 0
                            else:
                                kept += 1
                stack[0, 0, 0] = mean
                _hadamard(stack, count)
                share = np.float32(1.0) / kept
                for k in range(count):
                    _transform(transposed, stack[k], cosines, half)
                    top, left = places[k]
                    for i in range(SIDE):
                        for j in range(SIDE):
                            total[c, top + i, left + j] += share * stack[k, i, j]
                            weight[c, top + i, left + j] += share


def _starts(length: int, step: int, first: int) -> NDArray[np.int64]:
    """Return where blocks start along an axis: every `step`, and at both ends."""
    inner = np.arange(first % step, length - SIDE + 1, step)
    return np.unique(np.concatenate([[0], inner, [length - SIDE]])).astype(np.int64)


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
    # Blocks of two bands overlap: each adds to its own sums.
    sums = np.zeros((get_num_threads(), 2, *picture.shape), dtype=np.float32)
    rows = _starts(picture.shape[1], step, first)
    columns = _starts(picture.shape[2], step, first)
    cuts = np.array([1, chroma, chroma], dtype=np.float32) * np.float32(threshold * sigma)

    def work(band: int, begin: int, end: int) -> None:
        _shrink(
            opponent,
            luminance,
            _COSINES,
            _TRANSPOSED,
            cuts,
            np.float32(ALIKE * sigma**2),
            reach,
            rows[begin:end],
            columns,
            sums[band, 0],
            sums[band, 1],
        )

    in_bands(work, len(rows), len(sums))
    total, weight = sums.sum(axis=0)
    mean = total / weight
    return np.ascontiguousarray(np.einsum("oc,oyx->cyx", mixing, mean, optimize=True))

"""Remove white noise from a picture: like blocks are shrunk together, in opponent colours.

Collaborative filtering (BM3D's first step, Dabov et al. 2007): around every reference block the
blocks most like it are found on a cleaner picture, stacked, and transformed (cosines in the block,
Walsh-Hadamard across the stack); coefficients below a threshold are dropped, and the blocks put
back, averaged with the inverse of the number of coefficients kept. What a scene repeats, along an
edge or in a texture, is so learned from the scene itself.

Operations of a reference block: 3 x 64 per block searched, 3 x 2 x 64 x 14 per block of the stack.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import summed_in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.lightfield import OPPONENT
from reconstruction.adaptive.stacks import SIDE, STACK, add_block, shrink_stack, stack_block

Array = NDArray[np.floating]
REACH = 9
"""Blocks are searched within so many samples along each axis."""
ALIKE = 4.0
"""Mean square difference of blocks that are stacked, at most, over the noise's variance. 2x -0.03,
0.5x +0.02 dB."""
LANES = 16
"""Blocks searched side by side."""
_OPPONENT = OPPONENT.astype(np.float32)


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


@njit(cache=True, fastmath=True, nogil=True)
def _shrink(picture, guide, cuts, unlike, reach, starts_y, starts_x, total, weight):
    """Add the blocks' estimates of a picture to total (c, y, x), and their weights to weight.

    weight: (c, y, x), where blocks begin.
    """
    stack = np.empty(STACK * SIDE * SIDE, np.float32)
    squares = np.empty(2 * reach + 1 + LANES, np.float32)
    distances = np.empty(STACK, np.float32)
    places = np.empty((STACK, 2), np.int64)
    colours, length, wide = picture.shape
    flat, flat_total = picture.reshape(-1), total.reshape(-1)
    for y in starts_y:
        for x in starts_x:
            count = _alike(guide, y, x, wide - SIDE, reach, unlike, squares, distances, places)
            for c in range(colours):
                for k in range(count):
                    at = (c * length + places[k, 0]) * wide + places[k, 1]
                    stack_block(flat, at, wide, stack, k)
                share = np.float32(1.0) / (1 + shrink_stack(stack, count, cuts[c]))
                for k in range(count):
                    at = (c * length + places[k, 0]) * wide + places[k, 1]
                    add_block(stack, k, share, flat_total, at, wide)
                    weight[c, places[k, 0], places[k, 1]] += share


def _starts(length: int, step: int, first: int) -> NDArray[np.int64]:
    """Return where blocks start along an axis: every `step`, and at both ends."""
    inner = np.arange(first % step, length - SIDE + 1, step)
    return np.unique(np.concatenate([[0], inner, [length - SIDE]])).astype(np.int64)


def _spread(weight: Array) -> Array:
    """Return on every sample (y, x) the sum of the weights of the blocks that cover it."""
    found = cv2.boxFilter(
        weight,
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
    totals = np.zeros((2, *picture.shape), dtype=np.float32)
    weights = np.zeros_like(totals)
    unlike = np.float32(ALIKE * sigma**2)

    def work(which: int, begin: int, end: int) -> None:
        added = totals[which], weights[which]
        _shrink(opponent, spare, cuts, unlike, reach, rows[begin:end], columns, *added)

    summed_in_bands(work, len(rows), (reach + SIDE / 2) / step)
    weight = np.stack([_spread(part) for part in weights[0] + weights[1]])
    mean = (totals[0] + totals[1]) / weight
    return np.ascontiguousarray(np.einsum("oc,oyx->cyx", mixing, mean, optimize=True))

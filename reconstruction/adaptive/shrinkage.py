"""Remove white noise from a picture: like blocks are shrunk together, in opponent colours.

Collaborative filtering (BM3D's first step, Dabov et al. 2007): around every reference block the
blocks most like it are found on a cleaner picture, stacked, and transformed (cosines in the block,
Walsh-Hadamard across the stack); coefficients below a threshold are dropped, and the blocks put
back, averaged with the inverse of the number of coefficients kept. What a scene repeats, along an
edge or in a texture, is so learned from the scene itself.

Operations of a reference block, 4 samples from the next: 3 x 16 + 3 per block searched, as blocks
share quarters, and 3 x 2 x 64 x 14 per block of the stack.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import summed_in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.lightfield import OPPONENT
from reconstruction.adaptive.stacks import (
    CELL,
    COSINES,
    INVERSE,
    SIDE,
    STACK,
    cells_apart,
    shrink_stack,
    transform,
)

Array = NDArray[np.floating]
REACH = 9
"""Blocks are searched within so many samples along each axis."""
ALIKE = 4.0
"""Mean square difference of blocks that are stacked, at most, over the noise's variance. 2x -0.03,
0.5x +0.02 dB."""
_OPPONENT = OPPONENT.astype(np.float32)


@njit(forceinline=True)
def _most_alike(squares, limit, reach, top, bottom, left, right, distances, found):
    """Set found (STACK,) to the displacements of the blocks most like one, its own first.

    squares: of how far blocks displaced by -reach to reach rows and columns are from it; found:
    counted alike. limit: squared distance that excludes a block. top to right:
    the displacements along both axes, counted from -reach, whose blocks lie in the picture. Returns
    how many are found, a power of two.
    """
    wide = 2 * reach + 1
    own = reach * wide + reach
    number, worst = 1, limit
    distances[0], found[0] = -1, own
    for row in range(top, bottom + 1):
        for n in range(row * wide + left, row * wide + right + 1):
            square = squares[n]
            if square >= worst or n == own:
                continue
            number = min(number + 1, STACK)
            at = number - 1
            while at > 1 and distances[at - 1] > square:
                distances[at], found[at] = distances[at - 1], found[at - 1]
                at -= 1
            distances[at], found[at] = square, n
            if number == STACK:
                worst = min(limit, distances[STACK - 1])
    count = 1
    while count * 2 <= number:
        count *= 2
    return count


@njit(cache=True, fastmath=True, nogil=True)
def _shrink(picture, guide, cuts, unlike, reach, starts_y, starts_x, cells, corners, total, weight):
    """Add the blocks' estimates of a picture to total (c, y, x), and their weights to weight.

    guide: padded by `reach` on all sides. cells: the columns
    where cells begin; corners (2, block): the number of the left and of the right ones of each
    block of starts_x. weight (c, y, x): where blocks begin.

    What two rows of blocks share of their distances, a row of cells, is computed once.
    """
    colours, length, wide = picture.shape
    row = 2 * reach + 1
    size = row * row
    above = np.empty((cells.size, row, row), np.float32)
    below = np.empty_like(above)
    known = np.int64(-1)
    stack = np.empty((SIDE, STACK * SIDE), np.float32)
    room = np.empty_like(stack)
    squares = np.empty(size, np.float32)
    distances, found = np.empty(STACK, np.float32), np.empty(STACK, np.int64)
    limit = unlike * SIDE * SIDE
    for y in starts_y:
        above, below = below, above
        for begin, apart in ((y, above), (y + CELL, below)):
            for n in range(cells.size if begin != known else 0):
                cells_apart(guide, begin, cells[n], reach, apart[n])
        known = y + CELL
        top, bottom = max(0, reach - y), min(2 * reach, length - SIDE - y + reach)
        for block in range(starts_x.size):
            x, (left, right) = starts_x[block], corners[:, block]
            p, q = above[left].reshape(-1), above[right].reshape(-1)
            r, s = below[left].reshape(-1), below[right].reshape(-1)
            for n in range(size):
                squares[n] = p[n] + q[n] + r[n] + s[n]
            first, last = max(0, reach - x), min(2 * reach, wide - SIDE - x + reach)
            count = _most_alike(squares, limit, reach, top, bottom, first, last, distances, found)
            width = count * SIDE
            for c in range(colours):
                for k in range(count):
                    at_y, at_x = y + found[k] // row - reach, x + found[k] % row - reach
                    for i in range(SIDE):
                        line, block = picture[c, at_y + i, at_x:], stack[i, k * SIDE :]
                        for n in range(SIDE):
                            block[n] = line[n]
                transform(COSINES, stack, room, width)
                share = np.float32(1.0) / (1 + shrink_stack(room, width, cuts[c]))
                transform(INVERSE, room, stack, width)
                scale = share / np.float32(count)
                for k in range(count):
                    at_y, at_x = y + found[k] // row - reach, x + found[k] % row - reach
                    weight[c, at_y, at_x] += share
                    for i in range(SIDE):
                        line, block = total[c, at_y + i, at_x:], stack[i, k * SIDE :]
                        for n in range(SIDE):
                            line[n] += scale * block[n]


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
    around = np.pad(luminance, reach)
    rows = _starts(picture.shape[1], step, first)
    columns = _starts(picture.shape[2], step, first)
    cuts = np.array([1, chroma, chroma], dtype=np.float32) * np.float32(threshold * sigma)
    cells = np.union1d(columns, columns + CELL)
    corners = np.searchsorted(cells, [columns, columns + CELL])
    totals = np.zeros((2, *picture.shape), dtype=np.float32)
    weights = np.zeros_like(totals)
    unlike = np.float32(ALIKE * sigma**2)

    def work(which: int, begin: int, end: int) -> None:
        added = totals[which], weights[which]
        starts = rows[begin:end], columns, cells, corners
        _shrink(opponent, around, cuts, unlike, reach, *starts, *added)

    summed_in_bands(work, len(rows), (reach + SIDE / 2) / step)
    weight = np.stack([_spread(part) for part in weights[0] + weights[1]])
    mean = (totals[0] + totals[1]) / weight
    return np.ascontiguousarray(np.einsum("oc,oyx->cyx", mixing, mean, optimize=True))

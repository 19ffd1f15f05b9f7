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
from emmc_rig.reconstruction.adaptive.stacks import (
    CELL,
    SIDE,
    STACK,
    add_block,
    cells_apart,
    shrink_stack,
    stack_block,
)

Array = NDArray[np.floating]
REACH = 9
"""Blocks are searched within so many samples along each axis."""
ALIKE = 4.0
"""Mean square difference of blocks that are stacked, at most, over the noise's variance. 2x -0.03,
0.5x +0.02 dB."""
_OPPONENT = OPPONENT.astype(np.float32)


@njit(forceinline=True)
def _row_apart(guide, y, cells, reach, wide, apart):
    """Set apart (cell, displacement) for the cells that begin at columns `cells` of row y.

    guide: flat, `wide` numbers a row, with `reach` rows and columns before the picture's first.
    """
    height = 2 * reach + 1
    for n in range(cells.size):
        first = y * wide + cells[n]
        own, vectors = first + reach * (wide + 1), _vectors(reach)
        cells_apart(guide, own, first, wide, apart, n * height * vectors * SIDE, height, vectors)


@njit(forceinline=True)
def _vectors(reach):
    """Return how many vectors hold the displacements along a row."""
    return (2 * reach + SIDE) // SIDE


@njit(forceinline=True)
def _most_alike(squares, limit, reach, top, bottom, left, right, distances, found):
    """Set found (STACK,) to the displacements of the blocks most like one, its own first.

    squares: distances of the block to blocks displaced by up to reach rows and columns, squared,
    rows of whole vectors; found: counted alike. limit: squared distance that excludes a block. top
    to right: the displacements along both axes, counted from -reach, whose blocks lie in the
    picture. Returns the number of blocks found, a power of two.
    """
    wide = _vectors(reach) * SIDE
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

    guide: with `reach` rows and columns before the picture's, and more behind. cells: the columns
    where cells begin; corners (2, block): the number of the left and of the right ones of each
    block of starts_x. weight: flat, where blocks begin.

    What two rows of blocks share of their distances, a row of cells, is computed once.
    """
    colours, length, wide = picture.shape
    flat, flat_total, flat_guide = picture.reshape(-1), total.reshape(-1), guide.reshape(-1)
    guide_wide, row = guide.shape[1], _vectors(reach) * SIDE
    size = (2 * reach + 1) * row
    above, below = np.empty(cells.size * size, np.float32), np.empty(cells.size * size, np.float32)
    known = np.int64(-1)
    stack, squares = np.empty(STACK * SIDE * SIDE, np.float32), np.empty(size, np.float32)
    distances, found = np.empty(STACK, np.float32), np.empty(STACK, np.int64)
    limit = unlike * SIDE * SIDE
    for y in starts_y:
        above, below = below, above
        if known != y:
            _row_apart(flat_guide, y, cells, reach, guide_wide, above)
        known = y + CELL
        _row_apart(flat_guide, known, cells, reach, guide_wide, below)
        top, bottom = max(0, reach - y), min(2 * reach, length - SIDE - y + reach)
        for block in range(starts_x.size):
            x, left, right = starts_x[block], corners[0, block] * size, corners[1, block] * size
            for n in range(size):
                squares[n] = above[left + n] + above[right + n] + below[left + n] + below[right + n]
            first, last = max(0, reach - x), min(2 * reach, wide - SIDE - x + reach)
            count = _most_alike(squares, limit, reach, top, bottom, first, last, distances, found)
            for k in range(count):
                found[k] = (y + found[k] // row - reach) * wide + x + found[k] % row - reach
            for c in range(colours):
                plane = c * length * wide
                for k in range(count):
                    stack_block(flat, plane + found[k], wide, stack, k)
                share = np.float32(1.0) / (1 + shrink_stack(stack, count, cuts[c]))
                for k in range(count):
                    add_block(stack, k, share, flat_total, plane + found[k], wide)
                    weight[plane + found[k]] += share


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
    around = np.pad(luminance, ((reach, reach), (reach, reach + SIDE)))
    rows = _starts(picture.shape[1], step, first)
    columns = _starts(picture.shape[2], step, first)
    cuts = np.array([1, chroma, chroma], dtype=np.float32) * np.float32(threshold * sigma)
    cells = np.union1d(columns, columns + CELL)
    corners = np.searchsorted(cells, [columns, columns + CELL])
    totals = np.zeros((2, *picture.shape), dtype=np.float32)
    weights = np.zeros_like(totals)
    unlike = np.float32(ALIKE * sigma**2)

    def work(which: int, begin: int, end: int) -> None:
        added = totals[which], weights[which].reshape(-1)
        starts = rows[begin:end], columns, cells, corners
        _shrink(opponent, around, cuts, unlike, reach, *starts, *added)

    summed_in_bands(work, len(rows), (reach + SIDE / 2) / step)
    weight = np.stack([_spread(part) for part in weights[0] + weights[1]])
    mean = (totals[0] + totals[1]) / weight
    return np.ascontiguousarray(np.einsum("oc,oyx->cyx", mixing, mean, optimize=True))

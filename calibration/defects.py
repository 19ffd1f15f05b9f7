"""Specks: dust and defects on the mask, and dust that moved on the sensor, seen in the residuals.

A defect takes the share delta off whatever passes a grain of the mask (half a cell), for every
view and wherever the stage moves it: a property of the mask, not of pixels. Residuals are linear
in the deltas. Grains are taken up only where the whiteboards support it (their own evidence beats
SUPPORT deviations), then solved for together with the prior N(0, SIZE^2), and looked for again:

    residual_p = - sum over grains g of  influence_pg delta_g + noise
    gradient_g = sum over p of  - influence_pg residual_p,    curvature_g = sum of influence_pg^2
    evidence_g = gradient_g / sqrt(curvature_g),    residuals and influences in deviations

Dust that came onto the sensor, or left it, between the references and the whiteboards is no such
defect: a whiteboard over its reference does not show how bright a pixel is. Its pixels are darker,
or brighter, by the same share in every whiteboard, whatever the mask casts there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_dilation
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from emmc_rig.calibration.boards import Board, Opening
from emmc_rig.calibration.choice import predicted_by_shadow
from emmc_rig.calibration.placement import Placement
from emmc_rig.calibration.robust import deviation_of
from emmc_rig.calibration.shadow import Shadow, ShadowMask
from emmc_rig.model.compiling import njit

Array = NDArray[np.floating]
SPLITS = 2
"""Grains along a cell."""
SUPPORT = 6.0
"""Deviations of a grain's loss, from which on it is taken up: of a million by chance none."""
SIZE = 0.4
"""Standard deviation of the prior of a loss, as a share of what the grain passes."""
ROUNDS = 3
"""Grains beside a large loss show only when that is known."""
CHUNK = 16_384
"""Pixels whose influences are held at once."""
LARGEST_SHARE = 0.02
"""Of the mask's grains; more are no defects but a wrong placement."""
FEWEST_BOARDS = 3
"""That show a pixel, to know a change alike in all."""
SURE_DUST, LEAST_DUST = 6.0, 0.01
"""Deviations, and share of the light, from which on a pixel's change is dust."""
LARGEST_CHI2 = 3.0
"""Of what a change alike in all whiteboards leaves of a pixel: more, and it is no dust."""
SKIRT_PX = 2
"""Around dusty pixels: the fainter rim of a speck's shadow."""
MOST_OF_SENSOR = 0.25
"""More pixels than these are not dusty: whatever it is, the model misses it."""


@dataclass(frozen=True, eq=False)
class Defects:
    """The mask with its defects: grains (row, column), the share each takes off, and the mask.

    covariance: of the losses, (grain, grain) over the flat mask; sparse, since specks lie apart.
    """

    lost: NDArray[np.float32]
    covariance: sparse.csr_array
    mask: ShadowMask

    @property
    def count(self) -> int:
        """How many grains were taken up."""
        return int(np.count_nonzero(self.lost))


def _grained(mask: ShadowMask) -> ShadowMask:
    cells = mask.cells.repeat(SPLITS, axis=1).repeat(SPLITS, axis=2)
    return replace(mask, cells=np.ascontiguousarray(cells), cell_um=mask.cell_um / SPLITS)


@njit(cache=True, parallel=True)
def _influence(corners, shares_y, shares_x, weights, starts, through, channels, out):
    """Set out (n, rows, columns) to how much each grain of a pixel's window adds to its reading.

    corners: (n, view, 2), first grain of each view; shares: (n, view, k); weights: (n, view);
    starts: (n, 2), of the window; through: (row, column, 4), what a grain passes.
    """
    for n in prange(out.shape[0]):
        out[n] = 0
        for view in range(corners.shape[1]):
            top, left = corners[n, view]
            for a in range(shares_y.shape[2]):
                for b in range(shares_x.shape[2]):
                    i, j = top + a - starts[n, 0], left + b - starts[n, 1]
                    row, column = top + a, left + b
                    if 0 <= row < through.shape[0] and 0 <= column < through.shape[1]:
                        out[n, i, j] += (
                            weights[n, view]
                            * shares_y[n, view, a]
                            * shares_x[n, view, b]
                            * through[row, column, channels[n]]
                        )


def _entries(
    shadow: Shadow, opening: Opening, pixels: NDArray[np.int64], channels: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return (pixel, grain) indices into the flat mask and their influences."""
    views_open, stage_um, shot = opening
    corners, shares_y, shares_x, weights = shadow.footprints(pixels, views_open, stage_um)
    count = shares_x.shape[2]
    starts = corners.min(axis=1)
    spans = (corners.max(axis=1) - starts).max(axis=0) + count
    placement = shadow.placement
    cells = shadow.mask.cells[shot % len(shadow.mask.cells)]
    through = placement.leak + (placement.clear - placement.leak) * cells.astype(np.float64)
    out = np.empty((len(pixels), *spans))
    _influence(corners, shares_y, shares_x, weights, starts, through, channels, out)
    rows = starts[:, :1] + np.arange(spans[0])
    columns = starts[:, 1:] + np.arange(spans[1])
    height, width = cells.shape[:2]
    index = (
        np.clip(rows, 0, height - 1)[:, :, None] * width
        + np.clip(columns, 0, width - 1)[:, None, :]
    )
    return index.reshape(len(pixels), -1), out.reshape(len(pixels), -1)


def find_defects(boards: Sequence[Board], mask: ShadowMask, placement: Placement) -> Defects:
    """Return the defects that these whiteboards support, under the placement fitted to them."""
    fine = _grained(mask)
    shadow, size = Shadow(fine, placement), fine.cells.shape[1:3]
    lost, count = np.zeros(size), int(np.prod(size))
    covariance = sparse.csr_array((count, count))
    for _ in range(ROUNDS):
        current = Shadow(_with_losses(fine, placement, lost), placement)
        residuals = [_residual(current, board) for board in boards]
        spread = max(1.0, deviation_of(np.concatenate(residuals)))
        gradient, curvature = np.zeros(count), np.zeros(count)
        for index, influence, deviations, residual in _influences(shadow, boards, residuals):
            scaled = influence / (deviations * spread)[:, None]
            pull = -scaled * (residual / spread)[:, None]
            gradient += np.bincount(index.ravel(), pull.ravel(), count)
            curvature += np.bincount(index.ravel(), (scaled**2).ravel(), count)
        evidence = gradient / np.sqrt(np.maximum(curvature, 1e-12))
        chosen = (np.abs(evidence) > SUPPORT) & (curvature > 1 / SIZE**2)
        chosen |= lost.ravel() != 0
        if not chosen.any() or chosen.mean() > LARGEST_SHARE:
            break
        losses, covariance = _solve_losses(boards, shadow, np.flatnonzero(chosen), spread)
        lost = losses.reshape(size)
    return Defects(lost.astype(np.float32), covariance, _with_losses(fine, placement, lost))


def mask_with_losses(mask: ShadowMask, placement: Placement, lost: Array) -> ShadowMask:
    """Return a mask whose grains (row, column) have lost so much, as `find_defects` gives it."""
    return _with_losses(_grained(mask), placement, lost)


def _residual(shadow: Shadow, board: Board) -> Array:
    pixels = np.argwhere(board.usable)
    predicted = shadow.readings(pixels, board.channels[board.usable], *board.opening)
    scale = np.sqrt(board.variance[board.usable].astype(np.float64))
    return (board.reading[board.usable] - predicted) / scale


def _influences(
    shadow: Shadow, boards: Sequence[Board], residuals: Sequence[Array]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64], Array, Array]]:
    """Yield `_entries` of CHUNK usable pixels, their deviations and residuals, board by board."""
    for board, residual in zip(boards, residuals, strict=True):
        pixels, channels = np.argwhere(board.usable), board.channels[board.usable]
        deviations = np.sqrt(board.variance[board.usable].astype(np.float64))
        for first in range(0, len(pixels), CHUNK):
            part = slice(first, first + CHUNK)
            entries = _entries(shadow, board.opening, pixels[part], channels[part])
            yield *entries, deviations[part], residual[part]


def _solve_losses(
    boards: Sequence[Board], shadow: Shadow, chosen: NDArray[np.intp], spread: float
) -> tuple[NDArray[np.float64], sparse.csr_array]:
    """Return the losses of the chosen grains and their covariance, on the flat mask."""
    place = np.full(shadow.mask.cells[0, :, :, 0].size, -1)
    place[chosen] = np.arange(len(chosen))
    matrix = sparse.csc_array(sparse.diags_array(np.full(len(chosen), 1 / SIZE**2)))
    right = np.zeros(len(chosen))
    residuals = [_residual(shadow, board) for board in boards]
    for index, influence, deviations, residual in _influences(shadow, boards, residuals):
        column = place[index]
        rows, entries = np.nonzero((column >= 0) & (influence > 0))
        values = influence[rows, entries] / (deviations * spread)[rows]
        shape = (len(index), len(chosen))
        slopes = sparse.csc_array((-values, (rows, column[rows, entries])), shape=shape)
        matrix = matrix + slopes.T @ slopes
        right += slopes.T @ (residual / spread)
    matrix = sparse.csc_array(matrix)
    lost = np.zeros(len(place))
    lost[chosen] = np.clip(np.ravel(np.asarray(spsolve(matrix, right))), -1, 1)
    blocks, rows, columns = [], [], []
    count, part_of = connected_components(matrix, directed=False)
    for part in range(count):
        grains = np.flatnonzero(part_of == part)
        blocks.append(np.linalg.inv(matrix[grains][:, grains].toarray()).ravel())
        rows.append(chosen[grains].repeat(len(grains)))
        columns.append(np.tile(chosen[grains], len(grains)))
    entries = np.concatenate(blocks), (np.concatenate(rows), np.concatenate(columns))
    return lost, sparse.csr_array(entries, shape=(len(place), len(place)))


def loss_variance(
    defects: Defects,
    mask: ShadowMask,
    placement: Placement,
    pixels: NDArray[np.int64],
    channels: NDArray[np.uint8],
    opening: Opening,
) -> NDArray[np.float64]:
    """Return what the losses' covariance makes of the variance of readings at pixels (n, 2).

    mask: without the defects.
    """
    if len(pixels) == 0:
        return np.zeros(0)
    index, influence = _entries(Shadow(_grained(mask), placement), opening, pixels, channels)
    rows = np.arange(len(pixels)).repeat(index.shape[1])
    shape = (len(pixels), defects.lost.size)
    slopes = sparse.csr_array((influence.ravel(), (rows, index.ravel())), shape=shape)
    spread = sparse.csr_array(slopes @ defects.covariance)
    return np.ravel(sparse.csr_array(spread.multiply(slopes)).sum(axis=1))


def _with_losses(fine: ShadowMask, placement: Placement, lost: Array) -> ShadowMask:
    """Return the mask whose grains pass so much less."""
    clear, leak = placement.clear, placement.leak
    through = leak + (clear - leak) * fine.cells
    passed = through * (1 - lost[None, :, :, None])
    return replace(fine, cells=((passed - leak) / (clear - leak)).astype(np.float32))


def moved_dust(shadow: Shadow, boards: Sequence[Board]) -> NDArray[np.bool_]:
    """Return the pixels, (pixel_y, pixel_x), under dust that moved after the references.

    With reading = (1 + change) shadow + noise, a pixel's change over all whiteboards is

        change = sum w shadow (reading - shadow) / sum w shadow^2,    w = 1 / variance

    Dusty: a change that is sure, large, and leaves residuals like the noise in every whiteboard.
    """
    shape = boards[0].reading.shape
    light, power, squares, count = (np.zeros(shape) for _ in range(4))
    for board in boards:
        weight = np.where(board.usable, 1 / board.variance.astype(np.float64), 0.0)
        predicted = predicted_by_shadow(shadow, board)
        off = board.reading - predicted
        light += weight * predicted * off
        power += weight * predicted**2
        squares += weight * off**2
        count += board.usable
    change = light / np.maximum(power, 1e-300)
    left = squares - change * light
    # All share the noise of the references, which the boards' own variances count anew each time.
    common = deviation_of(change[power > 0])
    sure = np.abs(change) > SURE_DUST * np.maximum(common, 1 / np.sqrt(np.maximum(power, 1e-300)))
    alike = left < LARGEST_CHI2 * np.maximum(count - 1, 1)
    dusty = sure & alike & (np.abs(change) > LEAST_DUST) & (count >= FEWEST_BOARDS)
    if not 0 < dusty.mean() < MOST_OF_SENSOR:
        return np.zeros(shape, bool)
    return np.asarray(binary_dilation(dusty, iterations=SKIRT_PX), bool)

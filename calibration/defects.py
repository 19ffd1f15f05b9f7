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

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import binary_dilation
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
    """The mask with its defects: grains (row, column), the share each takes off, and the mask."""

    lost: NDArray[np.float32]
    mask: ShadowMask

    @property
    def count(self) -> int:
        """How many grains were taken up."""
        return int(np.count_nonzero(self.lost))


def _grained(mask: ShadowMask) -> ShadowMask:
    cells = mask.cells.repeat(SPLITS, axis=1).repeat(SPLITS, axis=2)
    return replace(mask, cells=np.ascontiguousarray(cells), cell_um=mask.cell_um / SPLITS)


@njit(forceinline=True)
def _add_influences(window, corners, shares_y, shares_x, weights, start, through, channel):
    """Add to window (row, column) how much each grain there adds to one pixel's reading.

    corners: (view, 2), first grain of each view; shares: (view, k); weights: (view,). start: (2,),
    of the window. through: (row, column, 4), what a grain passes.
    """
    for view in range(corners.shape[0]):
        top, left = corners[view]
        for a in range(shares_y.shape[1]):
            row, down = top + a, weights[view] * shares_y[view, a]
            if not 0 <= row < through.shape[0]:
                continue
            for b in range(shares_x.shape[1]):
                column = left + b
                if 0 <= column < through.shape[1]:
                    seen = down * shares_x[view, b] * through[row, column, channel]
                    window[row - start[0], column - start[1]] += seen


@njit(cache=True, parallel=True)
def _influence(corners, shares_y, shares_x, weights, starts, through, channels, out):
    """Set out (n, rows, columns) to how much each grain of a pixel's window adds to its reading.

    starts: (n, 2), of the windows. Others are those of `_add_influences`, (n, ...).
    """
    for n in prange(out.shape[0]):
        out[n] = 0
        _add_influences(
            out[n],
            corners[n],
            shares_y[n],
            shares_x[n],
            weights[n],
            starts[n],
            through,
            channels[n],
        )


@njit(cache=True)
def _add_evidence(footprints, starts, window, through, channels, deviations, residuals, out):
    """Add to out, gradient and curvature of each grain (row, column), those of n pixels.

    footprints: (corners, shares_y, shares_x, weights), (n, ...), see `_add_influences`. window:
    scratch, of the size of each. deviations, residuals: (n,). Pixels in turn: they share grains.
    """
    corners, shares_y, shares_x, weights = footprints
    gradient, curvature = out
    for n in range(len(residuals)):
        window[:] = 0
        start = starts[n]
        _add_influences(
            window,
            corners[n],
            shares_y[n],
            shares_x[n],
            weights[n],
            start,
            through,
            channels[n],
        )
        for i in range(max(-start[0], 0), min(window.shape[0], through.shape[0] - start[0])):
            for j in range(max(-start[1], 0), min(window.shape[1], through.shape[1] - start[1])):
                influence = window[i, j] / deviations[n]
                gradient[start[0] + i, start[1] + j] -= influence * residuals[n]
                curvature[start[0] + i, start[1] + j] += influence * influence


def _through(shadow: Shadow, shot: int) -> NDArray[np.float64]:
    """Return what each grain of the mask passes, (row, column, 4)."""
    placement, cells = shadow.placement, shadow.mask.cells
    passing = placement.clear - placement.leak
    return placement.leak + passing * cells[shot % len(cells)].astype(np.float64)


def _entries(
    shadow: Shadow, opening: Opening, pixels: NDArray[np.int64], channels: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return (pixel, grain) indices into the flat mask and their influences."""
    views_open, stage_um, shot = opening
    corners, shares_y, shares_x, weights = shadow.footprints(pixels, views_open, stage_um)
    starts, spans = _windows(corners, shares_x.shape[2])
    through = _through(shadow, shot)
    out = np.empty((len(pixels), *spans))
    _influence(corners, shares_y, shares_x, weights, starts, through, channels, out)
    rows = starts[:, :1] + np.arange(spans[0])
    columns = starts[:, 1:] + np.arange(spans[1])
    height, width = through.shape[:2]
    index = (
        np.clip(rows, 0, height - 1)[:, :, None] * width
        + np.clip(columns, 0, width - 1)[:, None, :]
    )
    return index.reshape(len(pixels), -1), out.reshape(len(pixels), -1)


def _windows(corners: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the grains that pixels see begin, (n, 2), and over how many they span, (2,).

    corners: (n, view, 2), the first of each view's `count` rows and columns.
    """
    starts = corners.min(axis=1)
    return starts, (corners.max(axis=1) - starts).max(axis=0) + count


class _Part(NamedTuple):
    """Usable pixels of a whiteboard, CHUNK at most."""

    board: Board
    pixels: NDArray[np.int64]
    channels: NDArray[np.uint8]
    deviations: Array
    """(n,), of the readings."""
    place: slice
    """Among all usable pixels of all whiteboards."""


def _parts(boards: Sequence[Board]) -> Iterator[_Part]:
    """Yield the usable pixels of all whiteboards."""
    before = 0
    for board in boards:
        pixels, channels = np.argwhere(board.usable), board.channels[board.usable]
        deviations = np.sqrt(board.variance[board.usable].astype(np.float64))
        for first in range(0, len(pixels), CHUNK):
            part = slice(first, first + CHUNK)
            place = slice(before, before + len(pixels[part]))
            yield _Part(board, pixels[part], channels[part], deviations[part], place)
            before = place.stop


class _Evidence(NamedTuple):
    """Gradient and curvature of each grain, (row, column), see the module; for a spread of 1."""

    gradient: NDArray[np.float64]
    curvature: NDArray[np.float64]

    def add(self, shadow: Shadow, parts: Iterable[_Part], residuals: Array) -> None:
        """Add gradients and curvatures by all pixels that have a residual, in deviations."""
        for part in parts:
            there = residuals[part.place] != 0
            if not there.any():
                continue
            views_open, stage_um, shot = part.board.opening
            footprints = shadow.footprints(part.pixels[there], views_open, stage_um)
            starts, spans = _windows(footprints[0], footprints[2].shape[2])
            _add_evidence(
                footprints,
                starts,
                np.empty(spans),
                _through(shadow, shot),
                part.channels[there],
                part.deviations[there],
                residuals[part.place][there],
                self,
            )


def find_defects(boards: Sequence[Board], mask: ShadowMask, placement: Placement) -> Defects:
    """Return the defects that these whiteboards support, under the placement fitted to them.

    With S the influences of the grains taken up, over the deviations, (pixel, grain), losses change
    the residuals by S losses: of the few pixels that see these grains.
    """
    fine = _grained(mask)
    shadow, size = Shadow(fine, placement), fine.cells.shape[1:3]
    clean = np.concatenate([_residual(shadow, board) for board in boards])
    evidence = _Evidence(np.zeros(size), np.zeros(size))
    evidence.add(shadow, _parts(boards), clean)
    chosen, seen, losses = np.zeros(0, np.int64), sparse.csr_array((len(clean), 0)), np.zeros(0)
    for _ in range(ROUNDS):
        changes = seen @ losses
        spread = max(1.0, deviation_of(clean + changes))
        changed = _Evidence(evidence.gradient.copy(), np.zeros(size))
        changed.add(shadow, _parts(boards), changes)
        deviations = np.abs(changed.gradient) / (spread * np.sqrt(evidence.curvature + 1e-300))
        more = (deviations > SUPPORT) & (evidence.curvature > (spread / SIZE) ** 2)
        more.ravel()[chosen] = False
        taken = len(chosen) + int(more.sum())
        if taken == 0 or taken > LARGEST_SHARE * evidence.gradient.size:
            break
        if more.any():
            new = _Chosen.of(more)
            rows = [_seen_grains(shadow, part, new) for part in _parts(boards)]
            seen = sparse.csr_array(sparse.hstack([seen, sparse.vstack(rows)]))
            chosen = np.concatenate([chosen, np.flatnonzero(more)])
        losses = _solve_losses(seen, clean, spread)
    lost = np.zeros(size, np.float32)
    lost.ravel()[chosen] = losses
    return Defects(lost, _with_losses(fine, placement, lost))


def mask_with_losses(mask: ShadowMask, placement: Placement, lost: Array) -> ShadowMask:
    """Return a mask whose grains (row, column) have lost so much, as `find_defects` gives it."""
    return _with_losses(_grained(mask), placement, lost)


def _residual(shadow: Shadow, board: Board) -> Array:
    pixels = np.argwhere(board.usable)
    predicted = shadow.readings(pixels, board.channels[board.usable], *board.opening)
    scale = np.sqrt(board.variance[board.usable].astype(np.float64))
    return (board.reading[board.usable] - predicted) / scale


class _Chosen(NamedTuple):
    """Some grains of the mask, in the order of the flat mask."""

    count: int
    place: NDArray[np.intp]
    """(grain of the flat mask,), among those chosen; -1: not chosen."""
    sums: NDArray[np.intp]
    """(row + 1, column + 1): those chosen above and to the left."""

    @classmethod
    def of(cls, chosen: NDArray[np.bool_]) -> _Chosen:
        """Return grains that are True, (row, column)."""
        count = int(chosen.sum())
        place = np.full(chosen.size, -1)
        place[chosen.ravel()] = np.arange(count)
        return cls(count, place, np.pad(chosen.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))))

    def within(self, corners: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
        """Return whether some lie in `count` rows and columns from corners (n, view, 2) on."""
        top, left, bottom, right = (
            np.clip(edges[:, :, axis], 0, self.sums.shape[axis] - 1)
            for edges in (corners, corners + count)
            for axis in range(2)
        )
        sums = self.sums
        return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0


def _seen_grains(shadow: Shadow, part: _Part, chosen: _Chosen) -> sparse.csr_array:
    """Return the influences of the grains chosen over the pixels' deviations, (pixel, grain)."""
    views_open, stage_um, _ = part.board.opening
    corners, _, shares_x, _ = shadow.footprints(part.pixels, views_open, stage_um)
    touched = np.flatnonzero(chosen.within(corners, shares_x.shape[2]).any(axis=1))
    shape = (len(part.pixels), chosen.count)
    if len(touched) == 0:
        return sparse.csr_array(shape)
    how = part.board.opening, part.pixels[touched], part.channels[touched]
    index, influence = _entries(shadow, *how)
    column = chosen.place[index]
    rows, entries = np.nonzero((column >= 0) & (influence > 0))
    values = influence[rows, entries] / part.deviations[touched[rows]]
    return sparse.csr_array((values, (touched[rows], column[rows, entries])), shape=shape)


def _solve_losses(seen: sparse.csr_array, residual: Array, spread: float) -> NDArray[np.float64]:
    """Return the losses of the chosen grains.

        (S^T S / spread^2 + 1 / SIZE^2) losses = - S^T residual / spread^2

    seen: S. residual: without losses.
    """
    prior = sparse.diags_array(np.full(seen.shape[1], 1 / SIZE**2))
    matrix = sparse.csc_array(seen.T @ seen / spread**2 + prior)
    solved = np.ravel(np.asarray(spsolve(matrix, -(seen.T @ residual) / spread**2)))
    return np.clip(solved, -1, 1)


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

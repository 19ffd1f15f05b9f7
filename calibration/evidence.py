"""How well a Psi explains captured frames without knowing the scene: evidence of small blocks.

Prior of a block: a textured plane of one disparity d, so view (v, u) sees it moved by d (v, u).
Its brightness is a sum of cubic B-splines on two grids with independent normal coefficients, and
each colour adds a coarser one of its own; so the block's readings are normal with covariance
K = A diag(spread^2) A^T + floor^2, A the splines through Psi. The block's amplitude is not known:
profiled out, what is left is  -n/2 log(y^T K^-1 y) - 1/2 log|K|,  averaged over the disparities
(Bishop 2006, section 3.5). It peaks where the mask's modulation lies where the frames have it,
whatever the scene: evidence, not residual, because one to three shots leave any Psi able to
explain any frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import prange
from numpy.typing import NDArray

from emmc_rig.model.compiling import njit

Array = NDArray[np.floating]
FINE_PX, COARSE_PX = 2.0, 4.0
"""Knot distances of the splines, pixels."""
FINE_SPREAD, COARSE_SPREAD, MEAN_SPREAD, CHROMA_SPREAD = 0.15, 0.3, 1.0, 0.15
"""Of the splines' coefficients, as shares of the mean; only their ratios count."""
FLOOR_SHARE = 0.02
"""Of a block's mean reading: what the prior does not describe (occlusion, fine texture)."""


@dataclass(frozen=True, eq=False)
class Prior:
    """The planes' splines by disparity: the share of every grid point in every pixel of a view.

    Grids: fine, coarse, constant; coarse is also that of the colours.

    disparities_px: (disparity,), pixels per view step.
    down, across: (disparity, view, pixel, spline), of every grid in turn, along either axis.
    grids: (grid, 2), first spline and number.
    side: pixels along a block.
    """

    disparities_px: NDArray[np.float64]
    down: NDArray[np.float64]
    across: NDArray[np.float64]
    grids: NDArray[np.int64]
    side: int


def _spline(t: Array) -> Array:
    """Return the cubic B-spline of unit knot distance."""
    t = np.abs(t)
    inner = 2 / 3 - t**2 + t**3 / 2
    outer = np.clip(2 - t, 0, None) ** 3 / 6
    return np.where(t < 1, inner, outer)


def plane_prior(views: tuple[int, int], side: int, disparities_px: Array) -> Prior:
    """Return the prior of blocks of side x side pixels for the disparities given."""
    reach = float(np.abs(disparities_px).max()) * (max(views) - 1) / 2
    knots, grids = [], []
    for step in (FINE_PX, COARSE_PX):
        count = int(np.ceil((side - 1 + 2 * reach) / step)) + 3
        grids.append((sum(len(points) for points, _ in knots), count))
        knots.append(((np.arange(count) - (count - 1) / 2) * step, step))
    grids.append((sum(len(points) for points, _ in knots), 1))
    pixels = np.arange(side) - (side - 1) / 2

    def table(count: int) -> NDArray[np.float64]:
        at = np.arange(count) - (count - 1) / 2
        places = pixels[None, None, :] + disparities_px[:, None, None] * at[None, :, None]
        parts = [_spline((places[..., None] - points) / step) for points, step in knots]
        parts.append(np.ones((*places.shape, 1)))
        return np.concatenate(parts, axis=-1).astype(np.float64)

    return Prior(
        np.asarray(disparities_px, dtype=np.float64),
        table(views[0]),
        table(views[1]),
        np.array(grids, dtype=np.int64),
        side,
    )


@njit(forceinline=True)
def _add_grid(coefficients, down, across, first, count, matrix, at):
    """Add to matrix (n, ...) from column `at` the splines of one grid seen through coefficients.

    coefficients: (shot, side^2, v, u).
    """
    shots, area, views_v, views_u = coefficients.shape
    side = down.shape[1]
    line = np.empty(count)
    for shot in range(shots):
        for pixel in range(area):
            y, x = pixel // side, pixel % side
            row = shot * area + pixel
            for v in range(views_v):
                line[:] = 0
                for u in range(views_u):
                    weight = coefficients[shot, pixel, v, u]
                    for k in range(count):
                        line[k] += weight * across[u, x, first + k]
                for i in range(count):
                    share = down[v, y, first + i]
                    if share != 0:
                        for k in range(count):
                            matrix[row, at + i * count + k] += share * line[k]


@njit(forceinline=True)
def _block_covariances(coefficients, down, across, grids):
    """Return the covariance of a block's readings by brightness, and by each colour: (n, n) each.

        brightness: A diag(spread^2) A^T,    A = sum over colours of A_c
        colour: CHROMA_SPREAD^2 sum over colours of A_c A_c^T,  without the fine grid

    A_c: (n, spline), the splines through Psi of colour c. coefficients: (stored, shot, side^2, v,
    u). down, across: (view, pixel, spline) at one disparity.
    """
    stored, shots, area = coefficients.shape[:3]
    n = shots * area
    fine, coarse = grids[0, 1] ** 2, grids[1, 1] ** 2
    total = fine + coarse + 1
    # Loops, where expressions of arrays would do: these compile in four times the time.
    matrix = np.zeros((n, total))
    coloured = np.empty((n, stored * (total - fine)))
    for c in range(stored):
        own = np.zeros((n, total))
        at = 0
        for grid in range(3):
            first, count = grids[grid, 0], grids[grid, 1]
            _add_grid(coefficients[c], down, across, first, count, own, at)
            at += count**2
        for i in range(n):
            for k in range(total):
                matrix[i, k] += own[i, k]
            for k in range(fine, total):
                coloured[i, c * (total - fine) + k - fine] = own[i, k] * CHROMA_SPREAD
    for i in range(n):
        for k in range(total):
            spread = FINE_SPREAD if k < fine else COARSE_SPREAD
            matrix[i, k] *= spread if k < fine + coarse else MEAN_SPREAD
    return matrix @ matrix.T, coloured @ coloured.T


@njit(forceinline=True)
def _profiled_evidence(covariance, values):
    """Return -n/2 log(y^T K^-1 y) - 1/2 log|K|, by K = L L^T: |L^-1 y|^2 and the diagonal of L."""
    n = len(values)
    root = np.linalg.cholesky(covariance)
    logarithm, squares = 0.0, 0.0
    whitened = np.empty(n)
    for i in range(n):
        value = values[i]
        for j in range(i):
            value -= root[i, j] * whitened[j]
        whitened[i] = value / root[i, i]
        squares += whitened[i] ** 2
        logarithm += np.log(root[i, i])
    return -0.5 * n * np.log(max(squares, 1e-300)) - logarithm


@njit(cache=True, parallel=True)
def _compute_evidence(coefficients, colours, readings, noise, down, across, grids, chosen, found):
    """Set found (block, candidate) to each block's log evidence at its chosen disparities.

        K = brightness + chroma (between readings of one colour)
            + scale (FLOOR_SHARE^2 + noise / level^2) on the diagonal

    scale: mean variance by brightness; level: the block's mean reading. coefficients: (block,
    stored, shot, pixel, v, u); colours, readings, noise: (block, shot x pixel). chosen: (block,
    candidate), indices of disparities.
    """
    stored = coefficients.shape[1]
    blocks, n = readings.shape
    for block in prange(blocks):
        values, variances, colour = readings[block], noise[block], colours[block]
        level = 0.0
        for i in range(n):
            level += values[i] / n
        for candidate in range(chosen.shape[1]):
            d = chosen[block, candidate]
            covariance, chroma = _block_covariances(coefficients[block], down[d], across[d], grids)
            scale = 0.0
            for i in range(n):
                scale += covariance[i, i] / n
            scale = max(scale, 1e-12)
            for i in range(n):
                for j in range(n):
                    if stored > 1 or colour[i] == colour[j]:
                        covariance[i, j] += chroma[i, j]
                relative = variances[i] / max(level * level, 1e-12)
                covariance[i, i] += scale * (FLOOR_SHARE**2 + relative)
            found[block, candidate] = _profiled_evidence(covariance, values)


def log_evidence(
    prior: Prior,
    coefficients: Array,
    colours: NDArray[np.uint8],
    readings: Array,
    noise: Array,
    chosen: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the log evidence of every block at its disparities, (block, candidate).

    coefficients: (block, stored, shot, side^2, v, u), Psi's: stored 1, of the colour that each
    pixel sees, or 3, of all. colours, readings, noise: (block, shot, side^2), noise the variance of
    a reading. chosen: (block, candidate), indices into the prior's disparities.
    """
    found = np.empty(chosen.shape)
    flat = len(found), int(np.prod(readings.shape[1:]))
    _compute_evidence(
        np.ascontiguousarray(coefficients, dtype=np.float64),
        np.ascontiguousarray(colours).reshape(flat),
        np.ascontiguousarray(readings, dtype=np.float64).reshape(flat),
        np.ascontiguousarray(noise, dtype=np.float64).reshape(flat),
        prior.down,
        prior.across,
        prior.grids,
        np.ascontiguousarray(chosen, dtype=np.int64),
        found,
    )
    return found


def averaged(evidence: Array) -> NDArray[np.float64]:
    """Return the log of the mean evidence over candidates, (block,)."""
    top = evidence.max(axis=1)
    return top + np.log(np.mean(np.exp(evidence - top[:, None]), axis=1))

"""Psi as measured through the pinhole, made surer by the model as far as the model holds.

Every coefficient has two estimates: the pinhole's, with its noise, and that of the fitted mask,
whose misfit is not known beforehand. The misfit is what the two differ by beyond their deviations,
over what lies in a view alike close to the mask's edges, and around a pixel (empirical Bayes: Efron
2010, chapter 1); weighing both by their
variances, Psi is the model's where it holds and the pinhole's where it does not (dust, a bent mask,
glass), and its deviation says which.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from calibration.whiteboard import Calibration

Array = NDArray[np.floating]
AROUND_PX = 5
SURE = 3.0
LIKE_SLOPES = 6
TILE = 2
OUTLIER2 = 16.0
"""Squared deviations beyond which one coefficient is no longer the model's."""


def combined(free: Calibration, model: Calibration, good: NDArray[np.bool_]) -> Calibration:
    """Return both in one.

    good: (pixel_y, pixel_x), pixels whose frames count; elsewhere Psi is the model's.
    """
    weights, deviation = np.empty_like(free.psi.weights), np.empty_like(free.psi.weights)
    k = free.psi.binning
    usable = good.repeat(k, axis=0).repeat(k, axis=1)
    shots, views_v, views_u, _, stored, _ = weights.shape
    for shot, v, u, colour in np.ndindex(shots, views_v, views_u, stored):
        place = (shot, v, u, slice(None), colour)
        measured, expected = (one.psi.weights[place].astype(np.float64) for one in (free, model))
        noise = np.square(free.deviation[place], dtype=np.float64)
        inherent = np.square(model.deviation[place], dtype=np.float64)
        squares = (measured - expected) ** 2
        misfit = _misfit(squares, noise + inherent, _slopes(expected), usable)
        share = (inherent + misfit) / (inherent + misfit + noise)
        share = np.where(squares > OUTLIER2 * (noise + inherent + misfit), 1.0, share)
        share = np.where(usable, share, 0.0)
        weights[place] = expected + share * (measured - expected)
        variance = np.where(usable, share * noise, inherent + misfit)
        deviation[place] = np.sqrt(variance)
    return replace(free, psi=replace(free.psi, weights=weights), deviation=deviation, good=good)


def _misfit(
    squares: Array, variance: Array, slopes: Array, usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the variance of the model's misfit, (y, x): that of the view's coefficients of like
    slopes, or of a pixel's surroundings where they differ from it surely.
    """
    over = np.where(usable, squares - variance, 0.0)
    # One speck of dust says nothing of the rest of the view.
    calm = usable & (squares < OUTLIER2 * variance + np.median(squares[usable]))
    limits = np.quantile(slopes[calm], np.linspace(0, 1, LIKE_SLOPES + 1)[1:-1])
    like = np.digitize(slopes, limits)
    count = np.maximum(np.bincount(like[calm], minlength=LIKE_SLOPES), 1)
    sums = np.bincount(like[calm], over[calm], minlength=LIKE_SLOPES)
    view = np.maximum(sums / count, 0.0)[like]
    inside = uniform_filter(usable.astype(np.float64), AROUND_PX)
    more = uniform_filter(np.where(usable, over - view, 0.0), AROUND_PX) / np.maximum(inside, 1e-9)
    deviation = np.sqrt(2.0) / AROUND_PX * (variance + view)
    return np.where(np.abs(more) > SURE * deviation, np.maximum(view + more, 0.0), view)


def _slopes(plane: Array) -> NDArray[np.float64]:
    """Return the squared slope of a mosaic (y, x), between pixels of one colour of a Bayer tile."""
    found = np.zeros(plane.shape)
    for axis in (0, 1):
        if plane.shape[axis] > 2 * TILE:
            rise = np.roll(plane, -TILE, axis) - np.roll(plane, TILE, axis)
            found += rise**2
    return found

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

from calibration.misfit import OUTLIER2, measured_misfit
from calibration.whiteboard import Calibration

Array = NDArray[np.floating]
AROUND_PX = 7
SURE = 3.0


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
        view = measured_misfit(squares, noise + inherent, expected, usable)
        misfit = _around(squares, noise + inherent, view.variance(expected), usable)
        share = (inherent + misfit) / (inherent + misfit + noise)
        share = np.where(squares > OUTLIER2 * (noise + inherent + misfit), 1.0, share)
        share = np.where(usable, share, 0.0)
        weights[place] = expected + share * (measured - expected)
        variance = np.where(usable, share * noise, inherent + misfit)
        deviation[place] = np.sqrt(variance)
    return replace(free, psi=replace(free.psi, weights=weights), deviation=deviation, good=good)


def _around(
    squares: Array, variance: Array, misfit: Array, usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the misfit's variance (y, x), that of a pixel's surroundings where surely another."""
    over = np.where(usable, squares - variance - misfit, 0.0)
    inside = uniform_filter(usable.astype(np.float64), AROUND_PX)
    more = uniform_filter(over, AROUND_PX) / np.maximum(inside, 1e-9)
    deviation = np.sqrt(2.0) / AROUND_PX * (variance + misfit)
    return np.where(np.abs(more) > SURE * deviation, np.maximum(misfit + more, 0.0), misfit)

"""By how much a fitted mask misses what pinholes measure, as a variance that grows with its slopes.

A mask that sits a little elsewhere, or whose edges are softer than modelled, is missed where the
coefficients change from pixel to pixel; a speck of dust, or a transmittance that is a little off,
anywhere. So the misfit's variance is taken as level + per_slope x slope^2, by view, from the
squares that noise does not explain (variance components; medians of like slopes keep specks out).

Of a coefficient that the pinhole measured as well there are two estimates. The misfit is what the
two differ by beyond their deviations, over what lies in a view alike close to the mask's edges
(empirical Bayes: Efron 2010, chapter 1). With both weighed by their variances, Psi is the model's
where the misfit is small, and the pinhole's where it is large (a bent mask, glass) or where the two
lie far apart (dust).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.whiteboard import Calibration

Array = NDArray[np.floating]
LIKE_SLOPES = 6
"""Groups of coefficients alike in slope, of as many pixels each."""
SURE = 3.0
"""Standard deviations, from which on an excess over the noise is no chance."""
TILE = 2
"""Pixels from one to the next of the same colour in a Bayer mosaic."""
OUTLIER2 = 36.0
"""Squared deviations beyond which one coefficient is no longer the model's."""


@dataclass(frozen=True)
class Misfit:
    """Of one view's coefficients: a variance, and what a squared slope adds to it.

    evidence: deviations by which the squares exceed those of noise alone.
    """

    level: float = 0.0
    per_slope: float = 0.0
    evidence: float = 0.0

    def variance(self, plane: Array) -> NDArray[np.float64]:
        """Return the variance of coefficients (y, x) of the model."""
        return self.level + self.per_slope * slopes(plane)


def slopes(plane: Array) -> NDArray[np.float64]:
    """Return the squared slope of a mosaic (y, x), between pixels of one colour of a Bayer tile."""
    found = np.zeros(plane.shape)
    for axis in (0, 1):
        if plane.shape[axis] > 2 * TILE:
            rise = np.roll(plane, -TILE, axis) - np.roll(plane, TILE, axis)
            found += rise.astype(np.float64) ** 2
    return found


def measured_misfit(
    squares: Array, variance: Array, plane: Array, usable: NDArray[np.bool_]
) -> Misfit:
    """Return the misfit that squared differences (y, x) show beyond a variance.

        squares - variance = level + per_slope slope^2 + chance

    A line through the means of LIKE_SLOPES groups of coefficients alike in slope^2, weighed by
    their numbers; level and per_slope are not negative. Outliers (specks, bad pixels) are left out.
    plane: the model's coefficients, whose slopes count.
    """
    steep = slopes(plane)
    calm = usable & (squares < OUTLIER2 * (variance + np.median(squares[usable])))
    limits = np.quantile(steep[calm], np.linspace(0, 1, LIKE_SLOPES + 1)[1:-1])
    like = np.digitize(steep[calm], limits)
    count = np.bincount(like, minlength=LIKE_SLOPES)
    excess = np.bincount(like, (squares - variance)[calm], minlength=LIKE_SLOPES)
    mean = np.bincount(like, steep[calm], minlength=LIKE_SLOPES)
    there = count > 0
    excess, mean, weight = excess[there] / count[there], mean[there] / count[there], count[there]
    spread = float(np.cov(mean, aweights=weight)) if there.sum() > 1 else 0.0
    per_slope = 0.0
    if spread > 0:
        per_slope = max(float(np.cov(mean, excess, aweights=weight)[0, 1]) / spread, 0.0)
    level = float(np.average(excess - per_slope * mean, weights=weight))
    if level < 0:
        per_slope = max(
            float(np.average(excess, weights=weight) / np.average(mean, weights=weight)), 0.0
        )
    noise = float(variance[calm].mean()) * np.sqrt(2 / max(int(calm.sum()), 1))
    evidence = float(np.average(excess, weights=weight)) / max(noise, 1e-300)
    return Misfit(max(level, 0.0), per_slope, evidence)


def beyond_chance(misfits: Sequence[Misfit]) -> list[Misfit]:
    """Return the views' misfits, none where noise alone explains them.

    Estimates are at least zero: without any misfit half the views have one by chance. The noise's
    own variance, alike for all, is as sure as the squares of one view are.
    """
    if np.mean([misfit.evidence for misfit in misfits]) > SURE:
        return list(misfits)
    return [misfit if misfit.evidence > SURE * np.sqrt(2) else Misfit() for misfit in misfits]


def combined(free: Calibration, model: Calibration, good: NDArray[np.bool_]) -> Calibration:
    """Return Psi as pinhole and model know it together.

        share = (inherent + misfit) / (inherent + misfit + noise)
        weight = expected + share (measured - expected),    variance = share noise

    expected, inherent: the model's coefficient and variance; measured, noise: the pinhole's; misfit
    as measured over the view. An outlier is the pinhole's alone (share 1).
    good: (pixel_y, pixel_x), pixels whose frames count; elsewhere Psi is the model's.
    """
    weights, deviation = np.empty_like(free.psi.weights), np.empty_like(free.psi.weights)
    k = free.psi.binning
    usable = good.repeat(k, axis=0).repeat(k, axis=1)
    shots, views_v, views_u, _, stored, _ = weights.shape
    places = [
        (shot, v, u, slice(None), colour)
        for shot, v, u, colour in np.ndindex(shots, views_v, views_u, stored)
    ]

    def estimates_of(place: tuple[int, int, int, slice, int]) -> tuple[Array, ...]:
        """Return the pinhole's and the model's coefficients, and the variances of both."""
        both = free, model
        measured, expected = (known.psi.weights[place].astype(np.float64) for known in both)
        noise, inherent = (np.square(known.deviation[place], dtype=np.float64) for known in both)
        return measured, expected, noise, inherent

    views = []
    for place in places:
        measured, expected, noise, inherent = estimates_of(place)
        squares = (measured - expected) ** 2
        views.append(measured_misfit(squares, noise + inherent, expected, usable))
    for place, view in zip(places, beyond_chance(views), strict=True):
        measured, expected, noise, inherent = estimates_of(place)
        squares = (measured - expected) ** 2
        misfit = view.variance(expected)
        share = (inherent + misfit) / (inherent + misfit + noise)
        share = np.where(squares > OUTLIER2 * (noise + inherent + misfit), 1.0, share)
        share = np.where(usable, share, 0.0)
        weights[place] = expected + share * (measured - expected)
        variance = np.where(usable, share * noise, inherent + misfit)
        deviation[place] = np.sqrt(variance)
    return replace(free, psi=replace(free.psi, weights=weights), deviation=deviation, good=good)

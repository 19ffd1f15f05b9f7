"""By how much a fitted mask misses what pinholes measure, as a variance that grows with its slopes.

A mask that sits a little elsewhere, or whose edges are softer than modelled, is missed where the
coefficients change from pixel to pixel; a speck of dust, or a transmittance that is a little off,
anywhere. So the misfit's variance is taken as level + per_slope x slope^2, by view, from the
squares that noise does not explain (variance components; medians of like slopes keep specks out).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
LIKE_SLOPES = 6
TILE = 2
OUTLIER2 = 36.0
"""Squared deviations beyond which one coefficient is no longer the model's."""


@dataclass(frozen=True)
class Misfit:
    """Of one view's coefficients: a variance, and what a squared slope adds to it."""

    level: float = 0.0
    per_slope: float = 0.0

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
    """Return the misfit that squared differences (y, x) show beyond a variance."""
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
    return Misfit(max(level, 0.0), per_slope)

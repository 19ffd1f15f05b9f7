"""What a reconstruction leaves unexplained: its size against the noise, and whether it is white.

A quick look that needs no model of the scene. With one to three shots many light fields explain any
frames, so it is the scene that sets the level: one shot's total-variation residuals on three real
scenes are 0.10, 0.21 and 1.60 of the noise's variance with a Psi that fits, 2.22, 0.52 and 4.67
with one that is off by half a pixel (`benchmarks/calibration_checks.py drift`), and no whiter. Compare
captures of one scene with it; whether Psi fits at all is for the evidence of `drift` to say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.choice import neighbour_correlation
from calibration.errors import CalibrationError

Array = NDArray[np.floating]
FEWEST = 100


@dataclass(frozen=True)
class ResidualCheck:
    """chi2: mean squared residual over the noise's variance. correlation: of residuals two pixels
    apart, 0 if white. chi2_deviations, correlation_deviations: how far each is from noise alone, in
    standard deviations.
    """

    chi2: float
    correlation: float
    chi2_deviations: float
    correlation_deviations: float


def check_residuals(residual: Array, variance: Array, usable: NDArray[np.bool_]) -> ResidualCheck:
    """Return how residuals (shot, pixel_y, pixel_x) compare with noise of that variance.

    A fit to n readings that took m of their freedoms leaves chi2 near 1 - m / n: compare it with
    what a Psi that fits gives. Raises CalibrationError for too few usable pixels.
    """
    count = int(usable.sum())
    if count < FEWEST:
        raise CalibrationError(f"{count} usable pixels: too few to judge residuals by")
    scaled = np.where(usable, residual / np.sqrt(np.where(usable, variance, 1)), 0)
    chi2 = float(np.mean(scaled[usable] ** 2))
    correlations = [
        neighbour_correlation(one, good) for one, good in zip(scaled, usable, strict=True)
    ]
    correlation = float(np.mean(correlations))
    return ResidualCheck(
        chi2,
        correlation,
        (chi2 - 1) / np.sqrt(2 / count),
        # Each of 2 n products of white residuals has the variance of one.
        correlation * np.sqrt(2 * count),
    )

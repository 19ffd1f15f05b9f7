"""A lower bound on the error of any estimator of a disparity from readings: Ziv and Zakai's.

The readings are N(0, S_d), the texture integrated out. The bound knows that other disparities may
explain the readings as well, which decides where an estimator breaks. For a prior of d that is
uniform in [0, R] (Bell, Steinberg, Ephraim & Van Trees 1997, "Extended Ziv-Zakai Lower Bound for
Vector Parameter Estimation", eq. 1 for a uniform prior, without the valley filling):

    E (d' - d)^2 >= integral over h from 0 to R of  h  integral over d from 0 to R - h of
                    P(d, d + h) / R,

P the least probability of error of deciding between two disparities equally likely, at least
(1 - sqrt(1 - rho^2)) / 2, rho the Bhattacharyya coefficient of the two normal distributions
(Kailath 1967, "The Divergence and Bhattacharyya Distance Measures in Signal Selection").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def bhattacharyya(covariances: Sequence[Array]) -> NDArray[np.float64]:
    """Return the distances of normal distributions of these covariances around 0, (d, d)."""
    halves = [_log_det(one) / 2 for one in covariances]
    found = np.zeros((len(covariances), len(covariances)))
    for i in range(len(covariances)):
        for j in range(i):
            both = _log_det((covariances[i] + covariances[j]) / 2) / 2
            found[i, j] = found[j, i] = max(both - (halves[i] + halves[j]) / 2, 0.0)
    return found


def _log_det(matrix: Array) -> float:
    return 2 * float(np.log(np.diag(np.linalg.cholesky(matrix))).sum())


def ziv_zakai(disparities: Array, apart: Array) -> float:
    """Return the least mean squared error of a disparity uniform between the ends of a grid, px^2.

    disparities: evenly spaced (d,), at least 2. apart: their Bhattacharyya distances
    (d, d). The integrals are lower sums: of P, which falls as disparities part, each step of h
    takes the value at its end, and of the pairs of disparities those on the grid stand for all.
    """
    step = float(disparities[1] - disparities[0])
    count = len(disparities)
    errors = -0.5 * np.expm1(0.5 * np.log1p(-np.minimum(np.exp(-2 * apart), 1 - 1e-15)))
    bound = 0.0
    for lag in range(1, count):
        inner = float(np.diagonal(errors, lag).mean()) * (count - 1 - lag) / (count - 1)
        # The integral of h over the step that ends here.
        bound += inner * step**2 * (lag - 0.5)
    return bound

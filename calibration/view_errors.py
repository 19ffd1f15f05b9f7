"""What the placement cannot fit, view by view, and by how much that biases what it does fit.

Through a real lens every view sees the mask a little displaced and a little softer than the
placement has it (aberrations). Neighbouring views are coded nearly alike, so that a displacement of
one reads like weight moved between its neighbours: where whiteboards open several views at once it
biases the aperture's weights, alike over the whole picture, which no residual shows. Displacements
and softenings are taken as normal, of variances tau^2 that the whiteboards' residuals show (random
effects: Searle, Casella, McCulloch 1992, chapter 6); the placement's covariance C then grows by
C N diag(tau^2) N^T C, N the information between its parameters and the views' own.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from calibration.shadow import OF_VIEW

Array = NDArray[np.floating]
KINDS = (0, 0, 1, 1, 2)
"""Of a view's own derivatives: displacement, softening along an axis, softening across both."""
TAUS_UM = np.geomspace(0.002, 0.2, 6)
"""Of each kind: from far less than any whiteboard shows to a hundredth of a pixel. Beforehand tau
is uniform (Gelman 2006, Bayesian Analysis 1:515): there are too few views to determine it well."""


def bias_covariance(
    covariance: Array, mixed: Array, own: Array, pull: Array
) -> NDArray[np.float64]:
    """Return what the views' own displacements and softenings add to the placement's covariance.

    covariance: of the placement without them, (parameter, parameter). mixed: information between
    the placement and the views' own (see `Shadow.slopes_by_view`). own, pull: information of the
    latter, and the gradient of the log likelihood by them, at the placement fitted.
    """
    left = own - mixed.T @ covariance @ mixed
    kind = np.resize(KINDS, len(pull))
    assert len(pull) % OF_VIEW == 0
    evidence, squares = [], []
    for taus in product(TAUS_UM, repeat=max(KINDS) + 1):
        tau = np.array(taus)[kind]
        values, vectors = np.linalg.eigh(tau[:, None] * left * tau)
        values = 1 + np.maximum(values, 0)
        seen = vectors.T @ (tau * pull)
        likelihood = 0.5 * float(np.sum(seen**2 / values - np.log(values)))
        # Steps of the grid grow with tau.
        evidence.append(likelihood + float(np.log(taus).sum()))
        squares.append(np.square(taus))
    share = np.exp(np.array(evidence) - max(evidence))
    expected = share @ np.array(squares) / share.sum()
    moved = covariance @ mixed
    return np.asarray((moved * expected[kind]) @ moved.T, np.float64)

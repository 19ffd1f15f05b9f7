"""Whether the lens's pupil is round, and how large: from the views' light, as whiteboards show it.

Their shares of the light, measured without a prior, are l (sum 1, covariance C). A pupil predicts
shares o (sum 1). The bench's tolerances (see `placement.Tolerances`) add to the difference: weights
of the aperture, and a falloff f towards its rim. With P the projection that keeps the sum,

    residual r = l - o,    P = 1 - o (1 ... 1)
    V = C + P (diag(o weight)^2 + f^2 (o far)(o far)^T) P^T + stray^2
    log evidence = -1/2 r^T V^-1 r - 1/2 log|V|

A round pupil is taken where its evidence is clearly more than that of views open to their edges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.placement import SCALARS, Tolerances
from emmc_rig.calibration.shadow import ShadowMask, far_shares
from emmc_rig.model.pupil import Pupil, cell_openings

Array = NDArray[np.floating]
SIDES = np.geomspace(0.85, 1.41, 22)
"""Diameters tried, of the longer side of all views: steps of 2.4 %. Beyond sqrt(2) every view of a
square of views is open."""
CLEARLY_ROUND = 12.0
"""Difference of log evidence; three parameters more (centre, diameter) take about 10 of it."""
SURE_EVEN = 2.0
"""Deviations of chi^2 up to which views open to their edges are explanation enough."""
NO_BELIEF = 10.0
"""Deviation of a view's weight where nothing is believed of it."""


STRAY = 2e-4
"""Of all light, in a view: no view of a bench is darker than stray light makes it."""


class ViewLight(NamedTuple):
    """The views' shares of the light as whiteboards show them."""

    shares: NDArray[np.float64]
    """(view,), sum 1."""
    covariance: NDArray[np.float64]
    """(view, view)."""


def measured_light(
    falloff: float, vector: Array, matrix: Array, pull: Array, mask: ShadowMask
) -> ViewLight:
    """Return the views' shares of the light, by one Gauss-Newton step without the weights' prior.

    falloff, vector: of the placement, and all parameters. matrix, pull: normal equations, with the
    prior of the other parameters. The falloff is held: the weights take its place.
    """
    count = mask.views[0] * mask.views[1]
    weights = slice(len(SCALARS), len(SCALARS) + count)
    precision = np.zeros(len(vector))
    precision[weights] = 1 / NO_BELIEF**2
    precision[SCALARS.index("falloff")] = 1e12
    inverse = np.linalg.inv(matrix + np.diag(precision))
    through = 1 + falloff * far_shares(mask.views).ravel()
    light = through * (vector + inverse @ pull)[weights]
    # The common level is free: slopes of the shares, at the light of the present weights.
    present = through * vector[weights]
    slopes = (np.eye(count) - (present / present.sum())[:, None]) / present.sum() * through
    return ViewLight(light / light.sum(), slopes @ inverse[weights, weights] @ slopes.T)


def likeliest_pupil(seen: ViewLight, mask: ShadowMask) -> Pupil | None:
    """Return the round pupil that the views' light shows; None: the views are open to their edges.

    Diameters of SIDES before the middle of the views, then the best's centre and diameter by
    Nelder and Mead's simplex.
    """
    count = len(seen.shares)
    even, chi2 = _evidence(seen, mask, None)
    if count < 2 or chi2 < count + SURE_EVEN * np.sqrt(2 * count):
        return None
    side_mm = max(mask.views) * mask.aperture_cell_um / 1e3
    tried = {
        float(side): _evidence(seen, mask, Pupil(diameter_mm=side_mm * float(side)))[0]
        for side in SIDES
    }

    def pupil_of(values: Array) -> Pupil:
        x_mm, y_mm, share = (float(value) for value in values * side_mm)
        return Pupil(diameter_mm=max(share, 1e-3), centre_mm=(x_mm, y_mm))

    from scipy.optimize import minimize

    best = max(tried, key=lambda side: tried[side])
    start = np.array([0.0, 0.0, best])
    simplex = start + np.vstack([np.zeros(3), np.diag([0.02, 0.02, 0.02])])
    found = minimize(
        lambda values: -_evidence(seen, mask, pupil_of(values))[0],
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 5e-4, "fatol": 0.1, "maxiter": 150},
    )
    return pupil_of(found.x) if -found.fun > even + CLEARLY_ROUND else None


def _evidence(seen: ViewLight, mask: ShadowMask, pupil: Pupil | None) -> tuple[float, float]:
    """Return the log evidence of a pupil, see the module, and r^T V^-1 r."""
    fill = mask.aperture_um / mask.aperture_cell_um
    found = cell_openings(pupil, mask.views, mask.aperture_cell_um, fill, strips=1)
    opened = found.shares(mask.views).ravel()
    opened, tolerances = opened / opened.sum(), Tolerances()
    falling = tolerances.falloff * opened * far_shares(mask.views).ravel()
    project = np.eye(len(opened)) - opened[:, None]
    bench = np.diag(np.square(tolerances.aperture * opened)) + np.outer(falling, falling)
    variance = seen.covariance + project @ bench @ project.T + STRAY**2 * np.eye(len(opened))
    factor = np.linalg.cholesky(variance)
    left = np.linalg.solve(factor, seen.shares - opened)
    chi2 = float(left @ left)
    return -0.5 * chi2 - float(np.log(np.diag(factor)).sum()), chi2

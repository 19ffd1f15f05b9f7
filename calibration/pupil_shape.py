"""The lens's pupil, round or not, and its rim: from the views' light, as whiteboards show it.

Their shares of the light, measured without a prior, are l (sum 1, covariance C). A pupil predicts
shares o (sum 1). The bench's tolerances (see `placement.Tolerances`) add to the difference: weights
of the aperture, and a falloff f towards its rim. With P the projection that keeps the sum,

    residual r = l - o,    P = 1 - o (1 ... 1)
    V = C + P (diag(o weight)^2 + f^2 (o far)(o far)^T) P^T + stray^2
    log evidence = -1/2 r^T V^-1 r - 1/2 log|V|

A round pupil is taken where its evidence is clearly more than that of views open to their edges.

Behind a rim that moves over the pupil with the pixel (vignetting), a view's light grows to one side
of the picture and falls to the other: by g, relative, from the middle to the corner. Whiteboards of
single views show it, with the information S. The growth g' that pupil and rim predict adds

    g^T S g' - 1/2 g'^T S g'

to the log evidence.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.placement import SCALARS, Tolerances
from emmc_rig.calibration.shadow import ShadowMask, far_shares
from emmc_rig.model.pupil import Pupil, Rim, cell_openings

Array = NDArray[np.floating]
SIDES = np.geomspace(0.85, 1.41, 22)
"""Diameters tried, of the longer side of all views: steps of 2.4 %. Beyond sqrt(2) every view of a
square of views is open."""
CLEARLY_ROUND = 12.0
"""Difference of log evidence; three parameters more (centre, diameter) take about 10 of it."""
SURE_EVEN = 2.0
"""Deviations of chi^2 up to which views open to their edges are explanation enough."""
SURE_GROWTH = 8.0
"""Deviations of chi^2 from which on light that grows over the picture is looked at."""
MOVES = np.geomspace(0.005, 0.3, 7)
"""Of a rim, tried from the middle of the picture to its corner, of the longer side of all views."""
FIRST_STEP = 0.02
"""Of the simplex, of that side."""
WIDE = 1.5
"""Diameter of a pupil that cuts no view, of that side."""
LEAST_SEEN = 1e-3
"""Of all light, in a view behind a rim: growths of less are those of stray light."""
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


class LightGrowth(NamedTuple):
    """How the light of single views grows over the picture, relative, from middle to corner.

    views: (view, 2), row and column. pull, information: (view x 2,), (view x 2, view x 2), of the
    growths along x and y: S g, and S.
    """

    views: NDArray[np.int64]
    pull: NDArray[np.float64]
    information: NDArray[np.float64]

    @property
    def sure(self) -> bool:
        """Whether some view's light grows by more than chance."""
        count = len(self.pull)
        chi2 = float(self.pull @ np.linalg.solve(self.information, self.pull)) if count else 0.0
        return chi2 > count + SURE_GROWTH * np.sqrt(2 * count)

    def evidence(self, mask: ShadowMask, pupil: Pupil) -> float:
        """Return what the growth behind a pupil adds to the log evidence, see the module."""
        if pupil.rim is None:
            return 0.0
        half_um, logs = mask.corner_um / 2, []
        for place in ((half_um, 0.0), (-half_um, 0.0), (0.0, half_um), (0.0, -half_um)):
            opened = _opened(pupil, mask, place)
            opened = np.maximum(opened / opened.sum(), LEAST_SEEN)
            logs.append(np.log(opened[tuple(self.views.T)]))
        growth = np.stack([logs[0] - logs[1], logs[2] - logs[3]], axis=1).ravel()
        return float(growth @ self.pull - 0.5 * growth @ self.information @ growth)


def measured_light(
    through: Array, vector: Array, matrix: Array, pull: Array, mask: ShadowMask
) -> ViewLight:
    """Return the views' shares of the light, by one Gauss-Newton step without the weights' prior.

    through: (view,), light of the views by the placement, at weights of 1. vector: all parameters.
    matrix, pull: normal equations, with the prior of the other parameters. Falloff and pupil are
    held: the weights take their place.
    """
    count = mask.views[0] * mask.views[1]
    weights = slice(len(SCALARS), len(SCALARS) + count)
    precision = np.zeros(len(vector))
    precision[weights] = 1 / NO_BELIEF**2
    precision[SCALARS.index("falloff")] = 1e12
    inverse = np.linalg.inv(matrix + np.diag(precision))
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

    def evidence(values: Array) -> float:
        return _evidence(seen, mask, pupil_of(values))[0]

    start = np.array([0.0, 0.0, max(tried, key=lambda side: tried[side])])
    found, reached = _highest(evidence, start, np.full(3, FIRST_STEP), 150)
    return pupil_of(found) if reached > even + CLEARLY_ROUND else None


def likeliest_rim(
    seen: ViewLight, growth: LightGrowth, mask: ShadowMask, pupil: Pupil | None
) -> Pupil | None:
    """Return the pupil with the rim that the views' light and its growth show; None: no rim.

    pupil: as known without a rim. Diameters of SIDES and moves of MOVES on either side, before the
    pupil as known and before views open to their edges; then the best by the simplex.
    """
    if not growth.sure:
        return None
    side_mm = max(mask.views) * mask.aperture_cell_um / 1e3
    corner_mm = mask.corner_um / 1e3
    wide = Pupil(diameter_mm=side_mm * WIDE)

    def pupil_of(values: Array) -> Pupil:
        x, y, size, rim, move = (float(value) for value in values)
        return Pupil(
            diameter_mm=side_mm * max(size, 1e-3),
            centre_mm=(side_mm * x, side_mm * y),
            rim=Rim(diameter_mm=side_mm * max(rim, 1e-3), shift=side_mm * move / corner_mm),
        )

    def evidence(values: Array) -> float:
        tried = pupil_of(values)
        return _evidence(seen, mask, tried)[0] + growth.evidence(mask, tried)

    def start_of(base: Pupil, rim: float, move: float) -> Array:
        x_mm, y_mm = base.centre_mm
        return np.array([x_mm / side_mm, y_mm / side_mm, base.diameter_mm / side_mm, rim, move])

    starts = [
        start_of(base, float(rim), float(move))
        for base in ([wide] if pupil is None else [pupil, wide])
        for rim in SIDES
        for move in (*MOVES, *-MOVES)
    ]
    best = max(starts, key=evidence)
    found, reached = _highest(evidence, best, np.array([*[FIRST_STEP] * 4, 0.2 * best[-1]]), 300)
    return pupil_of(found) if reached > _evidence(seen, mask, pupil)[0] + CLEARLY_ROUND else None


def _highest(
    evidence: Callable[[Array], float], start: Array, steps: Array, most: int
) -> tuple[Array, float]:
    """Return where the evidence is highest about a start, by the simplex, and the evidence there.

    steps: of the first simplex. most: iterations.
    """
    from scipy.optimize import minimize

    simplex = start + np.vstack([np.zeros(len(start)), np.diag(steps)])
    options = {"initial_simplex": simplex, "xatol": 5e-4, "fatol": 0.1, "maxiter": most}
    found = minimize(lambda values: -evidence(values), start, method="Nelder-Mead", options=options)
    return found.x, -found.fun


def _opened(
    pupil: Pupil | None, mask: ShadowMask, pixel_um: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.float64]:
    """Return the open share of every view, (v, u), as a pixel at x and y sees it."""
    fill = mask.aperture_um / mask.aperture_cell_um
    found = cell_openings(pupil, mask.views, mask.aperture_cell_um, fill, pixel_um, strips=1)
    return found.shares(mask.views)


def _evidence(seen: ViewLight, mask: ShadowMask, pupil: Pupil | None) -> tuple[float, float]:
    """Return the log evidence of a pupil, see the module, and r^T V^-1 r."""
    opened = _opened(pupil, mask).ravel()
    opened, tolerances = opened / opened.sum(), Tolerances()
    falling = tolerances.falloff * opened * far_shares(mask.views).ravel()
    project = np.eye(len(opened)) - opened[:, None]
    bench = np.diag(np.square(tolerances.aperture * opened)) + np.outer(falling, falling)
    variance = seen.covariance + project @ bench @ project.T + STRAY**2 * np.eye(len(opened))
    factor = np.linalg.cholesky(variance)
    left = np.linalg.solve(factor, seen.shares - opened)
    chi2 = float(left @ left)
    return -0.5 * chi2 - float(np.log(np.diag(factor)).sum()), chi2

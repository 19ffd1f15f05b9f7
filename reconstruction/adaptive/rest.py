"""The light field of the residual, as far as readings kept from all fits speak for it.

With L the light field so far and r = I - Psi L, the rest is the light field R of least total
variation that explains r; L + a R is returned, a in [0, 1]. Readings that no fit has seen choose a:
it is the regression of their r on Psi R, and exactly 0 unless beyond chance. Where r is at its
noise already there is nothing to explain, and R would be noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]
UNEXPLAINED = 1.5
"""Root mean square residual, over the noise, above which a rest is looked for. 2x +0.05, 0.5x 0.00
dB."""
LIGHTER = 0.3
"""Of the weight that total variation alone would get: there is less to lose. On eight shots of
deep-occlusions without noise 0.1, 0.3, 1 and 3 gained 0.9, 0.9, 0.7 and 0.5 dB. 2x 0.00, 0.5x 0.00
dB."""
PROOF = 3.0
"""Standard errors by which the share of the rest must differ from none. 2x 0.00, 0.5x 0.00 dB."""
MIDDLE = 0.5
"""The solver's light fields lie in [0, 1], the rest about 0: it is solved for about this value. 2x
+0.05, 0.5x 0.00 dB."""
WINDOW_PX = 8.0
"""Deviation of the window in which the place of the largest residual is looked for. 2x 0.00, 0.5x
0.00 dB."""


@dataclass(frozen=True)
class Misfit:
    """times: root mean square of the residual over the noise; row, column: the pixel about which it
    is largest."""

    times: float
    row: int
    column: int


def misfit_of(residual: Array, noise: Array, fitted: NDArray[np.bool_]) -> Misfit:
    """Return how far readings are from being explained.

    residual: the frames less what is predicted; noise: variance of the readings; fitted: those that
    count, all (shot, pixel_y, pixel_x).
    """
    relative = np.where(fitted, np.square(residual) / np.maximum(noise, 1e-20), 0)
    around = cv2.GaussianBlur(relative.sum(axis=0, dtype=np.float64), (0, 0), WINDOW_PX)
    row, column = np.unravel_index(around.argmax(), around.shape)
    times = float(np.sqrt(relative.sum(dtype=np.float64) / max(int(fitted.sum()), 1)))
    return Misfit(times, int(row), int(column))


def rest(
    psi: ImagingMatrix,
    residual: Array,
    mu: float,
    typical: float,
    fitted: NDArray[np.bool_],
    held: NDArray[np.bool_],
    steps: int,
) -> Array | None:
    """Return what to add to a light field (v, u, y, x, c); None where nothing speaks for it.

    residual: the frames less what it predicts; fitted, held: readings that were fitted, and kept
    from it, all (shot, pixel_y, pixel_x). mu: weight that total variation alone would get. typical:
    deviation of the readings. steps: of the solver.
    """
    middle = np.full(psi.light_field_shape, MIDDLE, dtype=np.float32)
    settings = TVSettings(mu=LIGHTER * mu, max_steps=steps, objective_every=steps + 1)
    shifted = (residual + psi.forward(middle)).astype(np.float32)
    more = reconstruct_tv(psi, shifted, typical, settings, fitted, start=middle).light_field
    more -= MIDDLE
    seen = psi.forward(more)[held].astype(np.float64)
    share, error = _regression(residual[held].astype(np.float64), seen)
    return np.float32(min(share, 1.0)) * more if share > PROOF * error else None


def _regression(values: Array, on: Array) -> tuple[float, float]:
    """Return the slope of values on others, through 0, and its standard error."""
    square = float(on @ on)
    if len(values) < 2 or square <= 0:
        return 0.0, np.inf
    slope = float(values @ on) / square
    # Residuals differ in size from place to place: the error for alike ones may be too small.
    left = values - slope * on
    alike = float(np.sqrt(left @ left / (len(values) - 1) / square))
    unlike = float(np.sqrt(np.sum(np.square(on * left)))) / square
    return slope, max(alike, unlike)

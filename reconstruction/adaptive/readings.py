"""The readings that the adaptive method fits: checked, and at the scale of its settings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.errors import ReconstructionError
from reconstruction.inputs import checked_inputs, checked_noise

Array = NDArray[np.floating]
PASSED = 0.5
"""Share of the light that masks pass for which the settings were chosen."""


@dataclass(frozen=True, eq=False)
class Readings:
    """Psi, the frames, their typical deviation, the variance `noise` of each reading, and which are
    usable, all but Psi (shot, pixel_y, pixel_x)."""

    psi: ImagingMatrix
    frames: Array
    typical: float
    noise: Array
    usable: NDArray[np.bool_]

    def over(self, scale: float, of_psi: bool = False) -> Readings:
        """Return the same with readings divided by a scale: of a scene, or of Psi, so much dimmer.

        Psi, frames and noise so many times larger are the same problem.
        """
        if scale == 1:
            return self
        part = self.frames.dtype.type(scale)
        psi = replace(self.psi, weights=self.psi.weights / part) if of_psi else self.psi
        noise = (self.noise / scale**2).astype(np.float32)
        return Readings(psi, self.frames / part, self.typical / scale, noise, self.usable)

    def variance(self, misfit: float) -> Array:
        """Return the variance of the readings, with that of what no model explains."""
        return self.noise + np.float32(misfit**2)

    def precision(self, held: NDArray[np.bool_], misfit: float) -> Array:
        """Return the inverse variance of the readings fitted, 0 of the others."""
        return np.where(self.usable & ~held, 1 / self.variance(misfit), 0).astype(np.float32)


def checked(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float | Array,
    usable: NDArray[np.bool_] | None,
) -> Readings:
    """Return the inputs of a method, as if the masks passed half the light.

    Raises ReconstructionError for inputs that do not fit each other.
    """
    typical, noise = checked_noise(psi, noise_sigma, usable)
    frames, usable = checked_inputs(psi, frames, typical, usable)
    passed = max(psi.light_efficiency(), 1e-12)
    return Readings(psi, frames, typical, noise, usable).over(passed / PASSED, of_psi=True)


def checked_disparity(disparity: Array, psi: ImagingMatrix) -> Array:
    """Return a known disparity of the centre view as float32; raises ReconstructionError."""
    if disparity.shape != psi.size or not np.isfinite(disparity).all():
        raise ReconstructionError(
            f"a disparity of shape {disparity.shape} is given, Psi needs {psi.size}, all finite"
        )
    return np.asarray(disparity, dtype=np.float32)

"""Depth by disparity through a thin lens, and back.

The image x' of a point at depth z lies at z' from a lens of focal length f, 1/z' = 1/f - 1/z. A ray
to it through place u of the lens meets the sensor, at distance D, at x = u + (x' - u) D / z', so
that dx/du = 1 - D/z'. Views lie a apart on the lens and samples p on the sensor: a disparity of d
pixels per view is dx/du = d p / a. Points at depth z0 are sharp, 1/f = 1/D + 1/z0, hence

    d p / a = D (1/z - 1/z0),    z = 1 / (1/z0 + d p / (a D)).
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.arguments import refusal
from emmc_rig.model.errors import CameraError

if TYPE_CHECKING:
    from emmc_rig.model.camera import Camera

Array = NDArray[np.floating]
ABOVE_0 = "a distance from the lens above 0"


@dataclass(frozen=True)
class Optics:
    """The lens: depth of what is sharp, mm, and by how much 1/depth differs a pixel per view."""

    focus_mm: float
    per_px: float

    def depth_mm(self, disparity: Array) -> Array:
        """Return depths from the lens; infinite beyond infinity, as noise makes them."""
        nearness = 1 / self.focus_mm + np.asarray(disparity, float) * self.per_px
        with np.errstate(divide="ignore"):
            return np.where(nearness <= 0, np.inf, 1 / nearness)

    def sigma_mm(self, depth_mm: Array, disparity_sigma: Array) -> Array:
        """Return the deviation of depths by that of disparity."""
        return np.square(depth_mm) * self.per_px * disparity_sigma

    def disparity_of(self, depth_mm: float) -> float:
        """Return the disparity of a depth, pixels per view step; raises ArgumentError."""
        if depth_mm <= 0:
            raise refusal(depth_mm, "depth_mm", ABOVE_0)
        return (1 / depth_mm - 1 / self.focus_mm) / self.per_px


def optics_of(camera: Camera | None, focus_mm: float | None) -> Optics:
    """Return the optics of a camera, or with another focus; CameraError names what is missing."""
    if focus_mm is None and camera is not None:
        focus_mm = camera.lens.focus_mm
    if camera is None or focus_mm is None:
        of_camera = "lens.distance_mm, lens.aperture_cell_mm and sensor.sample_pitch_um, camera=..."
        sharp = (
            "the distance from the lens to what is sharp, focus_mm=... or lens.focus_mm of a file"
        )
        missing = [of_camera] * (camera is None) + [sharp] * (focus_mm is None)
        raise CameraError(f"depth in mm needs {'; and '.join(missing)}")
    if not (isinstance(focus_mm, Real) and focus_mm > 0):
        raise refusal(focus_mm, "focus_mm", ABOVE_0)
    lens, pitch_mm = camera.lens, camera.sensor.sample_pitch_um * 1e-3
    return Optics(focus_mm, pitch_mm / (lens.aperture_cell_mm * lens.distance_mm))

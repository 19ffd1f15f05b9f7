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
        """Return the deviation of depths by that of disparity, z^2 p / (a D) times as large."""
        return np.square(depth_mm) * self.per_px * disparity_sigma

    def disparity_of(self, depth_mm: float) -> float:
        """Return the disparity of a depth, pixels per view step."""
        return (1 / depth_mm - 1 / self.focus_mm) / self.per_px


def optics_of(camera: Camera | None, focus_mm: float | None) -> Optics:
    """Return the optics that a camera describes; raises CameraError, which says what is missing.

    focus_mm: in place of the camera's.
    """
    if focus_mm is None and camera is not None:
        focus_mm = camera.lens.focus_mm
    if camera is None or focus_mm is None:
        unknown = {
            "lens.distance_mm, lens.aperture_cell_mm and sensor.sample_pitch_um of a camera, "
            "camera=emmc_rig.camera(...)": camera is None,
            "the distance from the lens to what is sharp, focus_mm=... or lens.focus_mm of the "
            "camera's file": focus_mm is None,
        }
        missing = "; and ".join(name for name, is_missing in unknown.items() if is_missing)
        raise CameraError(f"depth in mm needs {missing}")
    if not (isinstance(focus_mm, Real) and focus_mm > 0):
        raise refusal(focus_mm, "focus_mm", "a distance from the lens above 0")
    lens, pitch_mm = camera.lens, camera.sensor.sample_pitch_um * 1e-3
    return Optics(focus_mm, pitch_mm / (lens.aperture_cell_mm * lens.distance_mm))

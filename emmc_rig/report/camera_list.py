"""The shipped cameras, a line each, without a drawing."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from emmc_rig.model.camera import (
    Camera,
    draw_plates,
    psi_layout,
    seen_of_white,
    shipped_cameras,
)

LISTING_SAMPLES = 24


@dataclass(frozen=True)
class CameraRow:
    """A camera's line in the listing; `sampling_rate` is a fraction such as "1/25"."""

    name: str
    title: str
    sensor: str
    shots: int
    masks: int
    sampling_rate: str
    light_percent: float


def camera_rows() -> list[CameraRow]:
    """Return the shipped cameras' lines of the listing, by name."""
    rows = []
    for name, camera in shipped_cameras().items():
        size = square_size(camera, LISTING_SAMPLES)
        layout = psi_layout(camera, size)
        seen = seen_of_white(camera, size, draw_plates(camera, size))
        light_percent = 100 * float(seen.sum() / np.prod(layout.frames_shape))
        masks, rate = len(camera.masks), str(Fraction(*layout.shape))
        sensor = sensor_name(camera)
        rows.append(CameraRow(name, camera.title, sensor, layout.shots, masks, rate, light_percent))
    return rows


def square_size(camera: Camera, samples: int) -> tuple[int, int]:
    """Return a square size near `samples` that the camera's pixels divide."""
    side = max(samples // camera.sensor.binning, 1) * camera.sensor.binning
    return side, side


def sensor_name(camera: Camera) -> str:
    """Return the colour filters of a camera's sensor, and its binning."""
    cfa = camera.sensor.cfa
    name = cfa if isinstance(cfa, str) else "/".join(cfa)
    k = camera.sensor.binning
    return name if k == 1 else f"{name}, {k} x {k} binned"

"""How a mask lies before the sensor, from one frame: its rotation, and how far it has moved."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.raw import RawFrame
from emmc_rig.rig.registration import registered, without_tile

LONGEST_PX = 2048
"""Figures are taken from the middle of the frame: a mask is as askew there as elsewhere."""
NOISE_QUANTILE = 0.9
"""Of the gradients, the strongest tenth: edges of cells, hardly noise."""


@dataclass(frozen=True)
class Alignment:
    """rotation_deg: of straight edges against the sensor's rows, -45 to 45, counterclockwise.

    straightness: 0, edges in all directions, to 1, all along one grid: how far to believe the
    rotation. shift_px: (x, y), of the picture since the reference frame, in sensor pixels, and
    match, how alike the two are (0 to 1); None without a reference.
    """

    rotation_deg: float
    straightness: float
    shift_px: tuple[float, float] | None = None
    match: float | None = None


def grid_direction(plane: NDArray[np.float32]) -> tuple[float, float]:
    """Return rotation in degrees and straightness of the edges in a picture (y, x).

    The mean of (g_x + i g_y)^4 over the strongest gradients g: the fourth power makes the four
    directions of a square grid one (the structure tensor's idea, for four-fold symmetry).
    """
    smooth = cv2.GaussianBlur(plane, (0, 0), 1.0)
    along_x = cv2.Scharr(smooth, cv2.CV_32F, 1, 0)[1:-1, 1:-1].ravel()
    along_y = cv2.Scharr(smooth, cv2.CV_32F, 0, 1)[1:-1, 1:-1].ravel()
    strength = np.hypot(along_x, along_y)
    if not strength.size or not strength.max() > 0:
        return 0.0, 0.0
    strong = strength >= np.quantile(strength, NOISE_QUANTILE)
    unit = (along_x[strong] + 1j * along_y[strong]) / strength[strong]
    mean = np.average(unit**4, weights=strength[strong].astype(np.float64) ** 2)
    # Rows count downwards: a positive angle from x to y looks clockwise.
    return float(-np.degrees(np.angle(mean)) / 4), float(np.abs(mean))


def measure(frame: RawFrame, reference: RawFrame | None = None) -> Alignment:
    """Return a frame's alignment; a reference of another size or colour phase is none."""
    plane, _ = without_tile(frame, LONGEST_PX)
    rotation_deg, straightness = grid_direction(plane)
    if reference is None or (reference.mosaic.shape, reference.cfa) != (
        frame.mosaic.shape,
        frame.cfa,
    ):
        return Alignment(rotation_deg, straightness)
    shift = registered(frame, reference, LONGEST_PX)
    match = max(0.0, shift.likeness)
    return Alignment(rotation_deg, straightness, (shift.x_px, shift.y_px), match)

"""The length of an axis's step, from places read along it: by a ruler, or by the mask's shadow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.repeats import repeats_of

FEWEST_PLACES = 3
CLEAR_RESPONSE = 0.1
"""Least share of the correlation's energy at its peak: two unrelated frames give 0.02 to 0.05."""

SELF_ALIKE = 0.5
"""Correlation of a shadow with itself, shifted, that noise lowers and only a mask that repeats has
beyond a cell."""


@dataclass(frozen=True)
class StepLength:
    """um of one step, its standard deviation, and the largest distance of a reading from the line.

    um_per_step is positive; `reversed` says that readings fell while the axis counted up.
    """

    um_per_step: float
    deviation_um: float
    worst_um: float
    reversed: bool


def fit_step_length(steps: Sequence[float], readings_um: Sequence[float]) -> StepLength:
    """Return the slope of a straight line through the places, least squares.

    Raises CalibrationError for fewer than three places, places that do not differ, or readings
    that a line does not explain.
    """
    if len(steps) < FEWEST_PLACES or len(steps) != len(readings_um):
        raise CalibrationError(
            f"{len(steps)} places and {len(readings_um)} readings: read at least {FEWEST_PLACES}"
        )
    x, y = np.array(steps, dtype=np.float64), np.array(readings_um, dtype=np.float64)
    spread = ((x - x.mean()) ** 2).sum()
    if not (spread > 0 and np.isfinite(y).all()):
        raise CalibrationError("the places do not differ, or a reading is no number")
    slope = float(((x - x.mean()) * (y - y.mean())).sum() / spread)
    residual = y - y.mean() - slope * (x - x.mean())
    deviation = float(np.sqrt((residual**2).sum() / (len(x) - 2) / spread))
    if not abs(slope) > 3 * deviation:
        raise CalibrationError(
            f"the readings do not follow the axis ({slope:g} um a step, deviation {deviation:g}): "
            "check that it moved what was measured"
        )
    return StepLength(abs(slope), deviation, float(np.abs(residual).max()), slope < 0)


def shadow_shift_px(before: NDArray[np.uint16], after: NDArray[np.uint16]) -> tuple[float, float]:
    """Return how far the mask's shadow moved between two frames (y, x), as (x, y) in pixels.

    By phase correlation with a Hann window. Good to tenths of a pixel for moves below a quarter
    of the frame. Raises CalibrationError for frames that show no common shadow, or one that
    repeats: by how many of its periods it moved is not seen.
    """
    if before.shape != after.shape:
        raise CalibrationError(f"frames of {before.shape} and {after.shape} pixels")
    first, second = (_flattened(one) for one in (before, after))
    window = cv2.createHanningWindow(first.shape[::-1], cv2.CV_32F)
    shift, response = cv2.phaseCorrelate(first, second, window)
    if response < CLEAR_RESPONSE:
        raise CalibrationError(
            f"no common shadow in two frames (correlation {response:.2f}): light a whiteboard, "
            "fit the mask, and move less between frames"
        )
    repeats = repeats_of(first[..., None], 1.0, min(first.shape) / 4, SELF_ALIKE)
    if repeats.words:
        raise CalibrationError(
            "the mask's shadow repeats, or shows nothing along one direction, so that several "
            "moves look the same: fit a mask that does not repeat, or read a ruler (leave --camera "
            "out)"
        )
    return float(shift[0]), float(shift[1])


def _flattened(frame: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Return a frame without the colours of its filter and the slow fall of its light."""
    image = cv2.blur(frame.astype(np.float32), (2, 2))
    light = np.maximum(cv2.GaussianBlur(image, (0, 0), min(frame.shape) / 8), 1.0)
    return (image / light - 1.0).astype(np.float32)

"""Averages of repeated frames, and what they say of the sensor's gain and noise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError

Frame = NDArray[np.floating] | NDArray[np.integer]
BAND_PIXELS = 2**20
"""Worked on at once: a dozen temporary arrays of them take 100 MB."""
LARGEST_CLIPPED_SHARE = 1e-3
LARGEST_FLICKER = 0.02
SURE = 6.0
"""Deviations that noise alone hardly reaches."""


@dataclass(frozen=True)
class MeanFrame:
    """The mean of `count` frames of one exposure.

    mean_dn: (y, x) float32. variance_dn2: variance of one frame, averaged over the pixels, from
    the spread between repeats; NaN with one frame. taken_s: when, on any clock of the capture.
    extra_variance_dn2: of the mean beyond its own noise, from what was subtracted of it.
    """

    mean_dn: NDArray[np.float32]
    variance_dn2: float
    count: int
    exposure_s: float
    taken_s: float = 0.0
    extra_variance_dn2: float = 0.0


def average(
    frames: Iterable[NDArray[np.uint16]],
    exposure_s: float,
    white_level_dn: int,
    what: str,
    taken_s: float = 0.0,
    lit: bool = True,
) -> MeanFrame:
    """Return the mean of repeated frames (y, x), uint16; lit: they are no darks.

    Raises CalibrationError when there are none, when they differ in size, when more than
    LARGEST_CLIPPED_SHARE of the pixels of one are saturated, and when their brightness differs by
    more than LARGEST_FLICKER of the brightest, and more than noise explains.
    """
    total: NDArray[np.float64] | None = None
    count, squares = 0, 0.0
    levels: list[float] = []
    for frame in frames:
        clipped = float(np.mean(frame >= white_level_dn))
        if clipped > LARGEST_CLIPPED_SHARE:
            raise CalibrationError(
                f"{what}: {clipped:.1%} of the pixels are saturated; shorten the exposure "
                f"({exposure_s:g} s) or dim the lamp"
            )
        if total is None:
            total = np.zeros(frame.shape)
        if frame.shape != total.shape:
            raise CalibrationError(f"{what}: frames of {frame.shape} and {total.shape} differ")
        total += frame
        squares += _sum_of_squares(frame)
        count += 1
        levels.append(float(frame.mean(dtype=np.float64)))
    if total is None:
        raise CalibrationError(f"{what}: no frame was taken")
    spread = np.nan
    if count > 1:
        spread = (squares - _sum_of_squares(total) / count) / total.size / (count - 1)
        _check_steady(levels, float(np.sqrt(spread / total.size)), what, lit)
    return MeanFrame((total / count).astype(np.float32), spread, count, exposure_s, taken_s)


def bands(frame: Frame) -> list[slice]:
    """Return the rows of a frame (y, x) in bands of BAND_PIXELS; a small sensor is one."""
    rows, columns = frame.shape
    step = max(BAND_PIXELS // columns, 1)
    return [slice(first, min(first + step, rows)) for first in range(0, rows, step)]


def _sum_of_squares(values: Frame) -> float:
    parts = (values[rows].astype(np.float64).ravel() for rows in bands(values))
    return sum(float(np.einsum("i,i", part, part)) for part in parts)  # BLAS would start threads


def before_and_after(before: MeanFrame, after: MeanFrame) -> MeanFrame:
    """Return the mean of darks taken before and after, sure to what they differ by."""
    count = before.count + after.count
    share = before.count / count
    mean = share * before.mean_dn + (1 - share) * after.mean_dn
    difference = (after.mean_dn - before.mean_dn).astype(np.float64)
    change = float(np.mean(difference))
    variance = share * before.variance_dn2 + (1 - share) * after.variance_dn2
    if np.isnan(variance):
        # Single frames: their difference has the noise of both.
        variance = float(np.var(difference)) / (1 / before.count + 1 / after.count)
    # Anywhere between the two with the same chance.
    return MeanFrame(
        mean.astype(np.float32),
        variance,
        count,
        before.exposure_s,
        (before.taken_s + after.taken_s) / 2,
        change**2 / 12,
    )


def _check_steady(levels: list[float], noise: float, what: str, lit: bool) -> None:
    """Raise CalibrationError when frames differ in brightness; noise: deviation of a level."""
    difference, most = max(levels) - min(levels), max(levels)
    if difference > max(LARGEST_FLICKER * most, SURE * noise):
        why = "the lamp flickers: let it warm up, run it on direct current, or expose for whole "
        why += "periods of the mains"
        if not lit:
            why = "the sensor warms up, or light comes in: wait, and cover the camera"
        raise CalibrationError(
            f"{what}: repeats differ by {difference / most:.1%} in brightness; {why}"
        )


@dataclass(frozen=True)
class SensorGain:
    """What the noise of a frame follows from: DN per electron, and the variance in the dark."""

    gain_dn_per_electron: float
    dark_variance_dn2: float

    def variance_dn2(self, signal_dn: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the variance of one frame whose mean signal above the dark is `signal_dn`."""
        return self.gain_dn_per_electron * np.maximum(signal_dn, 0) + self.dark_variance_dn2


def photon_transfer(dark: MeanFrame, flat: MeanFrame) -> SensorGain:
    """Return the gain from repeated dark and flat frames (mean-variance method, EMVA 1288, 6.6).

    Raises CalibrationError when either was not repeated, or the flat is not brighter.
    """
    if dark.count < 2 or flat.count < 2:
        raise CalibrationError("the gain needs at least two dark and two bright frames")
    signal = float(np.mean(flat.mean_dn - dark.mean_dn))
    if signal <= 0:
        raise CalibrationError("the whiteboard is no brighter than the dark: is the lamp on?")
    gain = max((flat.variance_dn2 - dark.variance_dn2) / signal, 1e-9)
    return SensorGain(gain, dark.variance_dn2)

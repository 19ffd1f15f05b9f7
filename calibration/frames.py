"""Averages of repeated frames, and what they say of the sensor's gain and noise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.errors import CalibrationError

Frame = NDArray[np.floating] | NDArray[np.integer]
BAND_PIXELS = 2**20
"""Worked on at once: a dozen temporary arrays of them take 100 MB."""
LARGEST_CLIPPED_SHARE = 1e-3
LARGEST_FLICKER = 0.02
SAME_EXPOSURE = 0.02
"""Relative: exposures that differ by less have one dark frame."""
DARK_ELECTRONS_PER_S = 100.0
"""Standard deviation of a dark current that no dark frame shows: uncooled sensors have as much."""
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


def dark_shares(darks: Sequence[MeanFrame], exposure_s: float) -> NDArray[np.float64]:
    """Return of which darks that of an exposure is the sum, and by which share of each, (dark,).

    The one of that exposure; else a line through the shortest and the longest, whose slope is the
    dark current; where all are of one exposure, the first.
    """
    shares = np.zeros(len(darks))
    times_s = np.array([one.exposure_s for one in darks])
    own = np.flatnonzero(np.isclose(times_s, exposure_s, rtol=SAME_EXPOSURE))
    first, last = int(np.argmin(times_s)), int(np.argmax(times_s))
    if own.size or not dark_current_known(times_s, exposure_s):
        shares[own[0] if own.size else first] = 1.0
        return shares
    shares[last] = (exposure_s - times_s[first]) / (times_s[last] - times_s[first])
    shares[first] = 1 - shares[last]
    return shares


def dark_at(darks: Sequence[MeanFrame], exposure_s: float) -> MeanFrame:
    """Return the dark frame of an exposure: black level and dark current of every pixel."""
    shares = dark_shares(darks, exposure_s)
    if shares.max() == 1:
        return darks[int(np.argmax(shares))]
    used = [(share, one) for share, one in zip(shares, darks, strict=True) if share]
    mean = sum(share * one.mean_dn for share, one in used)
    spread = max(float(sum(share * one.variance_dn2 for share, one in used)), 0.0)
    noise = float(sum(share**2 * one.variance_dn2 / one.count for share, one in used))
    count = min(one.count for _, one in used)
    extra = max(noise - spread / count, 0.0)
    mean_dn = np.asarray(mean, dtype=np.float32)
    return MeanFrame(mean_dn, spread, count, exposure_s, extra_variance_dn2=extra)


def dark_current_known(darks_s: ArrayLike, exposure_s: float) -> bool:
    """Return whether darks of these exposures tell the dark current that an exposure collects."""
    times_s = np.asarray(darks_s)
    apart = not np.allclose(times_s, times_s[0], rtol=SAME_EXPOSURE, atol=0)
    return apart or bool(np.isclose(times_s[0], exposure_s, rtol=SAME_EXPOSURE))


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

"""Averages of repeated frames, and what they say of the sensor's gain and noise."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.robust import deviation_of

Frame = NDArray[np.floating] | NDArray[np.integer]
BAND_PIXELS = 2**20
"""Worked on at once: a dozen temporary arrays of them take 100 MB."""
LARGEST_CLIPPED_SHARE = 1e-3
"""Of the pixels: hot ones are fewer, a saturated frame has far more."""
NEARLY_WHITE = 0.7
"""Of white, that a pixel reads beside one that light saturates."""
LARGEST_FLICKER = 0.02
"""Relative, between the repeats of a frame."""
LARGEST_ROLLING = 0.007
"""Of the brightness: standard deviation of rows against their frame, between repeats."""
SAME_EXPOSURE = 0.02
"""Relative: exposures that differ by less have one dark frame."""
DARK_ELECTRONS_PER_S = 100.0
"""Standard deviation of a dark current that no dark frame shows: uncooled sensors have as much."""
SURE = 6.0
"""Deviations that noise alone hardly reaches."""
QUANTISATION = 1 / 12
"""Variance of rounding to whole steps, in squares of the step."""
NEIGHBOURING_SHARE = 0.01
"""Of the pixels, that lie beside the gaps between values where noise shows the steps."""
USUAL_SHARE = 0.9
"""Of the gaps between values, that are of one width where steps are: the rest lack a value."""
HOT_DEVIATIONS = 10.0
"""Robust ones of all pixels, from which on a dark pixel is hot: of normal noise none is."""


@dataclass(frozen=True)
class MeanFrame:
    """The mean of `count` frames of one exposure.

    mean_dn: (y, x) float32. variance_dn2: variance of one frame, averaged over the pixels, from
    the spread between repeats; NaN with one frame. taken_s: when, on any clock of the capture.
    extra_variance_dn2: of the mean, by the errors of frames that were subtracted from it.
    level_variance_dn2: of a frame's mean between repeats. rows_dn2: of a row's mean between them:
    lamp and shutter change whole rows alike, which is no noise of single pixels. step_dn: between
    the values that the frames use.
    """

    mean_dn: NDArray[np.float32]
    variance_dn2: float
    count: int
    exposure_s: float
    taken_s: float = 0.0
    extra_variance_dn2: float = 0.0
    level_variance_dn2: float = 0.0
    rows_dn2: float = 0.0
    step_dn: float = 1.0

    def noise_dn2(self, dark_dn: NDArray[np.floating] | float) -> float:
        """Return the variance of a pixel of one frame without what whole rows do alike.

        dark_dn: what the mean reads in the dark.
        """
        return self.variance_dn2 - float(np.mean(self._of_rows(dark_dn)))

    def unsteady2(self, dark_dn: NDArray[np.floating] | float) -> float:
        """Return the relative variance of the brightness between repeats, beyond the pixels' noise.

        By chance it may be negative: average that of several, by their degrees of freedom.
        """
        if self.count < 2:
            return 0.0
        light = float(np.mean(self.mean_dn - dark_dn))
        alike = self.level_variance_dn2 - self.variance_dn2 / self.mean_dn.size
        return alike / max(light, 1e-9) ** 2

    def _of_rows(self, dark_dn: NDArray[np.floating] | float) -> NDArray[np.float64]:
        """Return the variance of pixels by what their rows do alike, (y,)."""
        if not self.rows_dn2:
            return np.zeros(len(self.mean_dn))
        light = (self.mean_dn - dark_dn).astype(np.float64)
        mean, columns = light.mean(axis=1), light.shape[1]
        alike = len(mean) * (self.rows_dn2 - self.variance_dn2 / columns)
        # A pixel that is brighter than others changes by more. Rows that see no light, as under a
        # lamp of another colour, tell nothing.
        relative = alike / max(float(np.sum(np.square(mean))), 1e-12)
        return relative * np.square(light).mean(axis=1)


def average(
    frames: Iterable[NDArray[np.uint16]],
    exposure_s: float,
    white_level_dn: int,
    what: str,
    taken_s: float = 0.0,
    lit: bool = True,
) -> MeanFrame:
    """Return the mean of repeated frames (y, x), uint16; lit: they are no darks.

    Raises CalibrationError when there are none, when they differ in size, when light saturates
    more than LARGEST_CLIPPED_SHARE of the pixels of one, and when their brightness differs by
    more than LARGEST_FLICKER of the brightest, or that of their rows by LARGEST_ROLLING, and more
    than noise explains.
    """
    total: NDArray[np.float64] | None = None
    count, squares, step_dn = 0, 0.0, np.nan
    levels: list[float] = []
    rows: list[NDArray[np.float64]] = []
    for frame in frames:
        clipped = _saturated_share(frame, white_level_dn)
        if clipped > LARGEST_CLIPPED_SHARE:
            raise CalibrationError(
                f"{what}: {clipped:.1%} of the pixels are saturated; shorten the exposure "
                f"({exposure_s:g} s) or dim the lamp"
            )
        if total is None:
            total = np.zeros(frame.shape)
            # The steps matter where there is little noise, and the first frame shows them.
            # Values that are no whole numbers are no sensor's, and have no step.
            whole = frame.dtype.kind == "u"
            step_dn = 1.0 if lit or not whole else step_of_values([frame])
        if frame.shape != total.shape:
            raise CalibrationError(
                f"{what}: frames of {frame.shape} and {total.shape} pixels; capture all alike"
            )
        total += frame
        squares += _sum_of_squares(frame)
        count += 1
        rows.append(frame.mean(axis=1, dtype=np.float64))
        levels.append(float(rows[-1].mean()))
    if total is None:
        raise CalibrationError(f"{what}: no frame was taken; capture one")
    spread, of_levels, of_rows = np.nan, 0.0, 0.0
    if count > 1:
        of_levels = float(np.var(levels, ddof=1))
        of_rows = float(np.mean(np.var(rows, axis=0, ddof=1)))
        spread = (squares - _sum_of_squares(total) / count) / total.size / (count - 1)
        _check_steady(levels, float(np.sqrt(spread / total.size)), what, lit)
        if lit:
            _check_rows(np.array(rows), spread / total.shape[1], what)
    mean = (total / count).astype(np.float32)
    step_dn = 1.0 if np.isnan(step_dn) else step_dn
    return MeanFrame(mean, spread, count, exposure_s, taken_s, 0.0, of_levels, of_rows, step_dn)


def step_of_values(frames: Iterable[NDArray[np.uint16]]) -> float:
    """Return the step in DN between the values that frames (y, x) of one level use.

    The usual gap between values in use, weighted by the rarer value of each two: wide gaps among
    the few values far off do not count. 16 where 12 bits stand left-aligned in 16, whatever the
    black level. Of gaps of two widths, as a digital gain makes by rounding, their mean. Where
    nearly all pixels read alike, the least gap; NaN where all do. Where noise is so wide that
    values are left out by chance, the step comes out too large, by far less than the noise.
    """
    counts = np.zeros(2**16, dtype=np.int64)
    for frame in frames:
        for rows in bands(frame):
            counts += np.bincount(frame[rows].ravel(), minlength=len(counts))
    used = np.flatnonzero(counts)
    gaps, weights = np.diff(used), np.minimum(counts[used[1:]], counts[used[:-1]])
    if weights.sum() < NEIGHBOURING_SHARE * counts.sum():
        return float(gaps.min()) if len(gaps) else np.nan
    order = np.argsort(gaps)
    half = np.searchsorted(np.cumsum(weights[order]), weights.sum() / 2)
    usual = gaps[order[half]]
    near = gaps <= 2 * usual
    if weights[gaps == usual].sum() > USUAL_SHARE * weights[near].sum():
        return float(usual)
    return float(np.average(gaps[near], weights=weights[near]))


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
        rows_dn2=float(np.var(difference.mean(axis=1))) / (1 / before.count + 1 / after.count),
        step_dn=max(before.step_dn, after.step_dn),
    )


def dark_shares(darks: Sequence[MeanFrame], exposure_s: float) -> NDArray[np.float64]:
    """Return the share of every dark in the dark frame of an exposure, (dark,).

    The one of that exposure; else a line through the shortest and the longest, whose slope is the
    dark current; where all are of one exposure, the first.
    """
    shares = np.zeros(len(darks))
    times_s = np.array([dark.exposure_s for dark in darks])
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
    used = [(share, dark) for share, dark in zip(shares, darks, strict=True) if share]
    mean = sum(share * dark.mean_dn for share, dark in used)
    spread = max(float(sum(share * dark.variance_dn2 for share, dark in used)), 0.0)
    noise = float(sum(share**2 * dark.variance_dn2 / dark.count for share, dark in used))
    count = min(dark.count for _, dark in used)
    extra = max(noise - spread / count, 0.0)
    mean_dn = np.asarray(mean, dtype=np.float32)
    of_rows = sum(share * dark.rows_dn2 for share, dark in used)
    step_dn = max(dark.step_dn for _, dark in used)
    return MeanFrame(
        mean_dn, spread, count, exposure_s, 0.0, extra, rows_dn2=of_rows, step_dn=step_dn
    )


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


def _saturated_share(frame: NDArray[np.uint16], white_level_dn: int) -> float:
    """Return the share of pixels that light saturates: hot ones among dark neighbours do not count.

    Of pixels of the same colour, which lie two apart in a Bayer mosaic.
    """
    saturated = frame >= white_level_dn
    if not saturated.any():
        return 0.0
    bright = np.pad(frame >= NEARLY_WHITE * white_level_dn, 2)
    sides = (bright[:-4, 2:-2], bright[4:, 2:-2], bright[2:-2, :-4], bright[2:-2, 4:])
    return float(np.mean(saturated & np.logical_or.reduce(sides)))


def _check_rows(rows: NDArray[np.float64], noise_dn2: float, what: str) -> None:
    """Raise CalibrationError when rows differ apart from the brightness of their frames.

    rows: mean of each, (repeat, y). noise_dn2: variance of a row's mean by the noise of its pixels.
    """
    levels = rows.mean(axis=1, keepdims=True)
    alone = np.var(rows / levels * levels.mean(), axis=0, ddof=1).mean() - noise_dn2
    rolling = float(np.sqrt(max(alone, 0.0))) / float(levels.mean())
    sure = alone > SURE * noise_dn2 * np.sqrt(2 / (rows.size - rows.shape[1]))
    if sure and rolling > LARGEST_ROLLING:
        raise CalibrationError(
            f"{what}: the rows of repeats differ by {rolling:.1%} in brightness: the lamp flickers "
            "while the sensor's rows are read; run it on direct current, or expose for whole "
            "periods of the mains"
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

    The dark variance is at least that of rounding to the dark's steps: pixels with less noise read
    alike in every repeat, and are off all the same.

    Raises CalibrationError when either was not repeated, or the flat is not brighter.
    """
    if dark.count < 2 or flat.count < 2:
        raise CalibrationError("the gain needs at least two dark and two bright frames")
    signal = float(np.mean(flat.mean_dn - dark.mean_dn))
    if signal <= 0:
        raise CalibrationError("the whiteboard is no brighter than the dark: is the lamp on?")
    noise_dn2 = flat.noise_dn2(dark.mean_dn) - dark.variance_dn2
    gain = max(noise_dn2 / signal, 1e-9)
    return SensorGain(gain, max(dark.variance_dn2, QUANTISATION * dark.step_dn**2))


def hot_pixels(dark_dn: NDArray[np.floating], step_dn: float) -> NDArray[np.bool_]:
    """Return the pixels of a mean dark (y, x) apart from most others: hot ones, and cold ones.

    By HOT_DEVIATIONS robust deviations of all pixels; where most pixels read alike, of half a step.
    """
    off = dark_dn - np.median(dark_dn)
    return np.abs(off) > HOT_DEVIATIONS * max(deviation_of(off), step_dn / 2)

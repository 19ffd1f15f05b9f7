"""Raw values of anybody's sensor to readings with their deviation; what is not given is estimated.

The estimates are of what frames themselves tell. Saturated pixels share one value, far more of them
than the values below. Of raw values, which are whole numbers, the darkest see hardly any light.
Noise is what neighbours of one colour differ by where a frame is smoothest: its variance over the
signal is a line whose slope is the gain (mean-variance method, EMVA 1288, 6.6). A coded mask leaves
no part of a frame smooth, so that this is the most that noise can be.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls
from scipy.signal import convolve2d

from emmc_rig.errors import AppError
from emmc_rig.model.arguments import numbers_of, refusal
from emmc_rig.model.frames import Frames

Array = NDArray[np.floating]
FULL_RANGES = tuple(2.0**bits - 1 for bits in (8, 10, 12, 14, 16))
DARKEST = 0.001
"""Share of the pixels whose level is taken for the black level."""
BLOCK_PX = 16
SECOND = np.array([1.0, 0, -2, 0, 1]) / np.sqrt(6)
"""Second difference of every other pixel, of one colour in a Bayer mosaic; it keeps the variance of
noise. Source: Immerkaer, "Fast noise variance estimation", CVIU 64 (1996) 300."""
SMOOTHEST = 0.1
SMOOTHEST_READS = 1 - 1.2816 * np.sqrt(2 * (70 / 36) ** 2) / BLOCK_PX
"""Of the true variance, that the 10 % quantile of blocks without structure has: 1.28 deviations
below, of which BLOCK_PX^2 values have sqrt(2 / their number), less what neighbours share by SECOND,
whose squared autocorrelations sum to 70 / 36 along each axis."""
LEAST_ELECTRONS = 1.0
"""Of read noise: few sensors have less, and a line through brighter parts hardly tells."""
LEVELS, FEWEST_BLOCKS, ROUNDS = 8, 16, 4
MOST_LOOKED_AT = 2**20
"""Pixels among whose values codes are looked for."""
FEW_CODES = 32
"""Of 8 bits; fewer different ones may be a drawing."""
REPEATED, NARROWED = 8, 3.0
"""How often each value has to be there at least, so that none between two was only missed; and how
many times closer values lie, from which on they are codes: those of gamma 2.2 an eighth of the
range from black and from white 12, evenly spaced ones 1."""
STEADY, BETWEEN, QUANTISED, TEXTURED = 0.85, 20.0, 0.25, 4.0
"""Variance of darker parts over that of the brightest, from which on noise does not grow; how many
deviations the two are apart at least; the variance, DN^2, that may be rounding alone; and the ratio
above which what differs is texture. Noise of a linear sensor that grows by 15 % over 20 deviations
has a read noise above 100 electrons, which none has; of codes of gamma 2.2 it falls by a fifth of
what light grows."""
MOST_LAST = 16
"""Longest last axis that is taken for shots or colours, if both others are longer: no sensor has so
few columns."""
CLIPPED = 4
"""Times as many pixels as at each of as many levels below read the level where they saturate."""


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredFrames(Frames):
    """Frames made of raw values by `emmc_rig.frames`; see `Frames` for the other fields.

    estimates: black level, white level, noise and gamma, each in words, where they were estimated
    or assumed instead of given.
    """

    estimates: tuple[str, ...]

    def __repr__(self) -> str:
        told = f"; estimated: {'; '.join(self.estimates)}" if self.estimates else ""
        return super().__repr__().removesuffix(")") + told + ")"


def frames(
    dn: ArrayLike,
    dark: ArrayLike | None = None,
    white_level: float | None = None,
    gain: float | None = None,
    read_noise: float | None = None,
    *,
    white: ArrayLike | None = None,
    gamma: float | None = None,
    exposure_s: ArrayLike | None = None,
) -> MeasuredFrames:
    """Return the readings of raw frames, the standard deviation of each, and which are usable.

    With the black level b, the white board w, the slope g and floor f of the noise's variance, and
    an exposure n times the shortest,

        reading = (dn - b) / (w - b) / n
        deviation = sqrt(g (dn - b) + f + var b + reading^2 var (w - b)) / (w - b) / n

    Missing arguments are estimated from the frames; `estimates` of the frames returned lists them.
    The deviation includes the error of an estimated black level. Estimated noise is an upper bound:
    the structure of mask and scene adds to it.

    Args:
        dn: raw values of the sensor, DN, (shot, y, x), or (y, x) of one shot. Masked values of a
            masked array are not usable.
        dark: frames with the lamp off or the lens covered, at the same exposure, (y, x) or
            (repeat, y, x), or the black level, a number. DN. None: estimated.
        white_level: the value at which the sensor saturates, DN. None: estimated.
        gain: DN per electron. None: estimated.
        read_noise: standard deviation in the dark, electrons. None: estimated.
        white: a white board through the open aperture without masks, (y, x) or (repeat, y, x), or
            one number; it reads 1. Default: the white level does. DN.
        gamma: exponent of codes light ** (1 / gamma), about 2.2 for pictures. None: 1, and
            `estimates` warns if the values look like such codes.
        exposure_s: exposure of every shot in seconds, if they differ; readings are scaled to the
            shortest exposure, at which `white` must be taken. Default: all alike.

    Returns:
        Arrays (shot, y, x): `readings`, `deviation` and `usable`; and `estimates`, in words.

    Raises:
        AppError: axes in another order; values that are not finite, of another size, below 0
            without a dark, or above the white level; darks that are brighter than the frames;
            frames too small to estimate their noise; exposures that are not positive, or more or
            fewer than shots.
        ArgumentError: an argument of another type.

    >>> import emmc_rig as emmc
    >>> rng = np.random.default_rng(0)
    >>> electrons = np.broadcast_to(np.linspace(100, 3000, 256), (2, 128, 256))
    >>> read = rng.normal(0, 2.5, electrons.shape)
    >>> dn = np.round(64 + 0.8 * (rng.poisson(electrons) + read))
    >>> emmc.frames(dn, dark=64, white_level=4095, gain=0.8, read_noise=2.5)
    MeasuredFrames(2 shots of 128x256 pixels, noise 0.0078, 100.0% usable)
    >>> emmc.frames(dn, dark=64, white_level=4095).estimates
    ('noise (at most): variance 0.819 DN per DN of signal and 13.4 DN^2',)
    """
    taken, masked = _raw_values(dn)
    for name, number in (("white_level", white_level), ("gain", gain), ("gamma", gamma)):
        if number is not None and not (isinstance(number, Real) and 0 < number < np.inf):
            raise refusal(number, name, "a number above 0")
    if read_noise is not None and not (isinstance(read_noise, Real) and 0 <= read_noise < np.inf):
        raise refusal(read_noise, "read_noise", "electrons, 0 or more")
    if dark is None and taken.min() < 0:
        raise AppError(
            f"dn: values down to {taken.min():g} DN: a sensor reads none below 0; where a black "
            "level was subtracted before, give dark=0"
        )
    longer = _longer(exposure_s, len(taken))
    estimates: list[str] = []
    whole, top = not np.mod(taken, 1).any(), float(taken.max())
    saturates = white_level
    if white_level is None:
        white_level, saturates, words = _white_level(taken, whole)
        estimates.append(words)
    elif top > white_level:
        raise AppError(f"dn: values up to {top:g} DN, above the white level, {white_level:g}")
    usable = (taken < (np.inf if saturates is None else saturates)) & ~masked
    if not usable.any():
        raise AppError(f"dn: every pixel reads the white level, {saturates:g} DN, or more")
    if gamma is None:
        gamma = 1.0
        if looks := _looks_coded(taken, usable, np.asarray(dn).dtype == np.uint8):
            estimates.append(f"gamma 1 (assumed, although {looks}: for a picture give gamma=2.2)")
    linear = partial(_linear, gamma=gamma, white_level=white_level)
    taken, raw = linear(taken), whole and gamma == 1
    black, black_variance, dark_variance = _black(dark, taken, raw, linear, estimates)
    signal = taken - black
    if signal[usable].mean() < 0:
        raise AppError("dn: darker than dark on average: are frames and darks swapped?")
    slope, floor = _noise(signal, usable, gain, read_noise, dark_variance, raw, estimates)
    variance = slope * np.maximum(signal, 0) + floor + black_variance
    span, span_variance = white_level - float(np.mean(black)), 0.0
    if white is not None:
        board, repeats = _stacked(white, "white", taken.shape[1:])
        if saturates is not None and (board >= saturates).mean() > 0.5:
            raise AppError(f"white: most of it reads the white level, {saturates:g} DN, or more")
        span = linear(board).mean(axis=0) - black
        span_variance = (slope * np.maximum(span, 0) + floor) / repeats + black_variance
    lit = np.broadcast_to(np.asarray(span) > 0, taken.shape)
    if not lit.mean() > 0.5:
        raise AppError("white, or the white level, is no brighter than the dark: was the lamp on?")
    safe = np.where(span > 0, span, 1)
    readings = np.where(lit & ~masked, signal / safe, 0)
    deviation = np.sqrt(variance + np.square(readings) * span_variance) / safe
    readings, deviation = (values / longer for values in (readings, deviation))
    return MeasuredFrames(
        readings.astype(np.float32), deviation.astype(np.float32), usable & lit, tuple(estimates)
    )


def _raw_values(dn: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Return raw values (shot, y, x), DN, and which are masked; masked ones have the median.

    Raises AppError for axes in another order, values that are not finite, or all masked.
    """
    takes = "raw values, an array (shot, y, x) or (y, x) of real numbers"
    taken = numbers_of(np.ma.getdata(dn) if np.ma.isMaskedArray(dn) else dn, "dn", takes)
    if taken.ndim not in (2, 3) or not taken.size:
        raise refusal(dn, "dn", takes)
    _refuse_other_axes(taken.shape)
    masked = np.broadcast_to(np.ma.getmask(dn), taken.shape)
    if masked.any():
        if masked.all():
            raise AppError("dn: all values are masked: none of them is usable")
        # Estimates of noise and levels must not see the masked values.
        taken = np.where(masked, np.median(taken[~masked]).astype(taken.dtype), taken)
    taken, masked = (values.reshape(-1, *taken.shape[-2:]) for values in (taken, masked))
    return _finite(taken, "dn"), masked


def _linear(values: Array, gamma: float, white_level: float) -> Array:
    """Return codes as values proportional to light, with the same white level."""
    if gamma == 1:
        return values
    return white_level * (np.maximum(values, 0) / white_level) ** gamma


def _noise(
    signal: Array,
    usable: NDArray[np.bool_],
    gain: float | None,
    read_noise: float | None,
    dark_variance: float | None,
    raw: bool,
    estimates: list[str],
) -> tuple[float, float]:
    """Return slope (DN) and floor (DN^2) of the noise's variance, slope * signal + floor.

    gain, read_noise: as given; what is missing is estimated. dark_variance: of a dark frame, where
    known. raw: the values are whole numbers, whose rounding has the variance 1/12 DN^2.
    """
    if gain is not None and read_noise is not None:
        return gain, (gain * read_noise) ** 2 + raw / 12
    slope, floor = _noise_line(signal, usable, gain, dark_variance)
    if read_noise is not None:
        floor = (slope * read_noise) ** 2 + raw / 12
    elif dark_variance is None:
        floor = max(floor, (LEAST_ELECTRONS * slope) ** 2, raw / 12)
    estimates.append(
        f"noise (at most): variance {slope:.3g} DN per DN of signal and {floor:.3g} DN^2"
    )
    return slope, floor


def _refuse_other_axes(shape: tuple[int, ...]) -> None:
    """Raise AppError for frames that look like (y, x, shot), or like a picture's colours."""
    *size, last = shape
    if len(size) < 2 or last > MOST_LAST or last >= min(size):
        return
    if last in (3, 4):
        raise AppError(
            f"dn: shape {shape} looks like a picture (y, x, colour), where a sensor's mosaic is "
            "meant: give one colour, dn[..., 1], of a monochrome sensor; or like (y, x, shot), "
            "where shots come first: np.moveaxis(dn, -1, 0)"
        )
    raise AppError(
        f"dn: shape {shape} looks like (y, x, shot), where shots come first: np.moveaxis(dn, -1, 0)"
    )


def _longer(exposure_s: ArrayLike | None, shots: int) -> Array:
    """Return how many times the shortest exposure each is, (shot, 1, 1)."""
    if exposure_s is None:
        return np.ones((1, 1, 1))
    times_s = numbers_of(exposure_s, "exposure_s", "seconds, one number a shot")
    if times_s.shape != (shots,):
        raise AppError(f"exposure_s: {times_s.size} exposures of {shots} shots: give one a shot")
    if not (np.isfinite(times_s) & (times_s > 0)).all():
        raise AppError("exposure_s: an exposure is a number of seconds above 0")
    return (times_s / times_s.min())[:, None, None]


def _finite(values: NDArray, name: str) -> Array:
    """Return floating values; raises AppError where one is not finite, and says where."""
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        place = tuple(int(i) for i in wrong[0])
        raise AppError(
            f"{name}: {len(wrong)} values are not finite, the first at {place}: of frames mask "
            "them, by numpy.ma.masked_invalid; elsewhere put numbers there"
        )
    return values.astype(np.float64)


def _stacked(given: ArrayLike, name: str, size: tuple[int, ...]) -> tuple[Array, int]:
    """Return frames (repeat, y, x) of a size, given so, as one frame, or as one number."""
    takes = "DN: an array (y, x) or (repeat, y, x), or a number"
    array = numbers_of(np.atleast_1d(given), name, takes)  # pyright: ignore[reportArgumentType]
    if isinstance(given, Real):
        array = np.full((1, 1, 1), array[0])
    if array.ndim not in (2, 3) or not array.size:
        raise refusal(given, name, takes)
    array = _finite(array.reshape(-1, *array.shape[-2:]), name)
    if not isinstance(given, Real) and array.shape[1:] != size:
        raise AppError(f"{name}: frames of {array.shape[1:]} pixels, dn has {size}")
    return array, len(array)


def _black(
    dark: ArrayLike | None,
    dn: Array,
    raw: bool,
    linear: Callable[[Array], Array],
    estimates: list[str],
) -> tuple[Array, float, float | None]:
    """Return the black level, (1, 1) or (y, x), its variance, and that of a dark frame if known."""
    if dark is not None:
        darks, repeats = _stacked(dark, "dark", dn.shape[1:])
        darks = linear(darks)
        if repeats == 1:
            return darks[0], 0.0, None
        spread = float(darks.var(axis=0, ddof=1).mean())
        return darks.mean(axis=0), spread / repeats, spread
    level = max(float(np.quantile(dn, DARKEST)), 0.0) if raw else 0.0
    why = "what the darkest pixels read" if raw else "none assumed: these are no raw values"
    estimates.append(f"black level {level:.4g} DN ({why})")
    # Anywhere between nothing and the darkest pixels.
    return np.full((1, 1), level), level**2 / 12, None


def _white_level(dn: Array, whole: bool) -> tuple[float, float | None, str]:
    """Return the white level, the level of saturated pixels (None without any), and a sentence."""
    top = float(dn.max())
    step = 1.0 if whole else (top - float(dn.min())) / FULL_RANGES[1]
    below = np.count_nonzero((dn >= top - CLIPPED * step) & (dn < top)) / CLIPPED
    if np.count_nonzero(dn == top) > CLIPPED * (1 + below):
        return top, top, f"white level {top:.5g} DN (where values pile up)"
    fitting = [level for level in FULL_RANGES if level >= top] if whole else []
    level = fitting[0] if fitting else top
    what = "the range of the values" if fitting else "the brightest value"
    return level, None, f"white level {level:.5g} DN ({what}; none looks saturated)"


def _noise_line(
    signal: Array, usable: NDArray[np.bool_], slope: float | None, floor: float | None
) -> tuple[float, float]:
    """Return the variance of noise over the signal, as a line: slope and floor, DN and DN^2.

    slope, floor: where known. Raises AppError where frames are too small to tell.
    """
    blocks = _blocks(signal, usable)
    if len(blocks) < FEWEST_BLOCKS:
        raise AppError(
            f"dn: too few pixels that are not saturated to estimate their noise ({len(blocks)} "
            f"blocks of {BLOCK_PX}^2): give gain and read_noise"
        )
    level, mean_squares = blocks.T
    groups = _by_level(level)
    x = np.array([level[group].mean() for group in groups])
    columns = [item for item, known in ((x, slope), (np.ones_like(x), floor)) if known is None]
    line, expected = (slope or 0.0, floor or 0.0), np.ones_like(level)
    for _ in range(ROUNDS if columns else 0):
        # Over the variance expected of each block, or the smoothest would be the darkest blocks.
        low = [np.quantile(mean_squares[group] / expected[group], SMOOTHEST) for group in groups]
        y = np.array(low) / SMOOTHEST_READS * [expected[group].mean() for group in groups]
        # A variance is sure to a share of itself.
        weight = 1 / np.maximum(y, 1e-12 + 1e-6 * y.max())
        left = np.maximum(y - (slope or 0) * x - (floor or 0), 0)
        found = list(nnls(np.stack(columns, axis=1) * weight[:, None], left * weight)[0])
        line = (
            float(found.pop(0)) if slope is None else slope,
            float(found.pop(0)) if floor is None else floor,
        )
        expected = np.maximum(line[0] * level + line[1], 1e-12 + 1e-6 * y.max())
    return line


def _looks_coded(dn: Array, usable: NDArray[np.bool_], eight_bits: bool) -> str:
    """Return what of values (shot, y, x) looks like a picture's codes, in words; "" for nothing."""
    flat = dn[0].ravel()
    values, counts = np.unique(flat[:: 1 + flat.size // MOST_LOOKED_AT], return_counts=True)
    whole, top = not np.mod(values, 1).any(), float(values[-1])
    steps = [256, 257] if whole else [1 / 255]
    on_steps = any(np.abs(values / step - np.round(values / step)).max() < 1e-3 for step in steps)
    if eight_bits or (on_steps and len(values) > FEW_CODES and top <= 255 * steps[-1]):
        return "these are codes of 8 bits"
    # Linear values of a sensor, turned into codes, lie ever closer towards white.
    ends = np.linspace(values[0], top, LEVELS + 1)
    apart = [
        np.diff(inside).min()
        for inside, count in (
            (values[chosen], counts[chosen].sum())
            for chosen in ((values >= a) & (values <= b) for a, b in itertools.pairwise(ends))
        )
        if len(inside) >= FEWEST_BLOCKS and count >= REPEATED * len(inside)
    ]
    falling = all(later <= before + whole for before, later in itertools.pairwise(apart))
    if len(apart) > 1 and falling and apart[0] > NARROWED * apart[-1]:
        return f"its values lie {apart[0] / apart[-1]:.0f} times closer towards white"
    level, mean_squares = _blocks(dn, usable).T
    if len(level) < LEVELS * FEWEST_BLOCKS // 2:
        return ""
    groups = _by_level(level)
    low = np.array([np.quantile(mean_squares[group], SMOOTHEST) for group in groups])
    between = level[groups[-1]].mean() - level[groups[0]].mean()
    if low.min() <= whole * QUANTISED or between < BETWEEN * np.sqrt(low[-1]):
        return ""
    low /= low[-1]
    return "its noise does not grow with light" if STEADY < low.min() < low.max() < TEXTURED else ""


def _by_level(level: Array) -> list[NDArray[np.intp]]:
    """Return which blocks are alike bright, groups from dark to bright."""
    return np.array_split(np.argsort(level), min(LEVELS, 2 * len(level) // FEWEST_BLOCKS))


def _blocks(signal: Array, usable: NDArray[np.bool_]) -> Array:
    """Return mean and mean square of the second difference of every block, (block, 2)."""
    found = []
    for frame, good in zip(signal, usable, strict=True) if min(signal.shape[1:]) >= 5 else ():
        apart = convolve2d(convolve2d(frame, SECOND[None], "valid"), SECOND[:, None], "valid")
        for y, x in np.ndindex(*(side // BLOCK_PX for side in apart.shape)):
            rows, columns = (slice(i * BLOCK_PX, (i + 1) * BLOCK_PX) for i in (y, x))
            beside = slice(rows.start, rows.stop + 4), slice(columns.start, columns.stop + 4)
            if good[beside].all():
                square = np.mean(np.square(apart[rows, columns]))
                found.append((max(frame[beside].mean(), 0.0), square))
    return np.array(found).reshape(-1, 2)

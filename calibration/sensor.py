"""What the sensor does to light: the linear model of EMVA 1288 from dark and flat frames.

Two frames per exposure give mean and temporal variance (the variance of their difference, so that
pixels' own differences cancel). Their line, variance against signal, is the photon transfer curve:
its slope is the gain K in DN per electron. Every figure's deviation is a jackknife over BLOCKS
groups of rows. Under a colour filter each of its 2 x 2 phases has its own level; all lie on one
curve.

Source: EMVA Standard 1288, release 3.1, sections 2 to 8.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError

Array = NDArray[np.floating]
Frame = NDArray[np.uint16]
BLOCKS = 12
FIT_SHARE = 0.7
LINEAR_RANGE = (0.05, 0.95)
CLIPPED_SHARE = 0.01
FALLEN_SHARE = 0.8
"""Of the greatest variance: beyond what noise makes of the variance of a frame of any size."""
QUANTISATION_DN2 = 1 / 12
BRIGHTER_DEVIATIONS = 10.0
HOT_DEVIATIONS = 8.0
DEAD_SHARE = 0.5


@dataclass(frozen=True)
class Pair:
    """Two frames (y, x) of one exposure."""

    exposure_s: float
    first: Frame
    second: Frame


@dataclass(frozen=True, eq=False)
class Curve:
    """The photon transfer curve of all rows: signal above the dark, variance, exposure."""

    mean_dn: Array
    variance_dn2: Array
    exposure_s: Array


@dataclass(frozen=True, eq=False)
class SensorSheet:
    """The EMVA 1288 quantities; `deviations` by their names.

    linearity_residual: percent, per point of the curve. good: (y, x), neither hot nor dead.
    saturated: the flats reach saturation; else what follows from it is a lower bound.
    """

    gain_dn_per_electron: float
    read_noise_electrons: float
    dark_current_electrons_per_s: float
    black_level_dn: float
    dark_variance_dn2: float
    full_well_electrons: float
    saturation_dn: float
    linearity_error_percent: float
    dsnu_electrons: float
    prnu_percent: float
    snr_max_db: float
    dynamic_range_db: float
    hot_pixels: int
    dead_pixels: int
    curve: Curve
    linearity_residual: Array
    good: NDArray[np.bool_]
    deviations: dict[str, float] = field(default_factory=dict)
    saturated: bool = True

    def rows(self) -> list[tuple[str, float, float | None, str]]:
        """Return (quantity, value, standard deviation or None, unit) for a table."""
        return [
            (
                words if self.saturated or name not in OF_SATURATION else f"{words}, at least",
                float(getattr(self, name)),
                self.deviations.get(name),
                unit,
            )
            for name, (words, unit) in QUANTITIES.items()
        ]


QUANTITIES = {
    "gain_dn_per_electron": ("Overall system gain K", "DN/e"),
    "black_level_dn": ("Black level", "DN"),
    "read_noise_electrons": ("Temporal dark noise", "e"),
    "dark_current_electrons_per_s": ("Dark current", "e/s"),
    "full_well_electrons": ("Saturation capacity", "e"),
    "saturation_dn": ("Saturation", "DN above dark"),
    "linearity_error_percent": ("Linearity error", "%"),
    "dsnu_electrons": ("DSNU", "e"),
    "prnu_percent": ("PRNU", "%"),
    "snr_max_db": ("Greatest signal-to-noise ratio", "dB"),
    "dynamic_range_db": ("Dynamic range", "dB"),
    "hot_pixels": ("Hot pixels", ""),
    "dead_pixels": ("Dead pixels", ""),
}
OF_SATURATION = ("full_well_electrons", "saturation_dn", "snr_max_db", "dynamic_range_db")


@dataclass(frozen=True, eq=False)
class _Level:
    """Statistics of one pair by block of rows and phase of the filter: (block, phase)."""

    exposure_s: float
    mean: Array
    variance: Array
    clipped: Array


def _phases(frame: NDArray) -> list[NDArray]:
    return [frame[y::2, x::2] for y in range(2) for x in range(2)]


def _level(pair: Pair, good: NDArray[np.bool_], white_level_dn: int) -> _Level:
    if pair.first.shape != pair.second.shape or pair.first.shape != good.shape:
        raise CalibrationError(
            f"exposure of {pair.exposure_s:g} s: frames of {pair.first.shape} and "
            f"{pair.second.shape} differ from {good.shape}: are they of one camera?"
        )
    mean, variance, clipped = (np.empty((BLOCKS, 4)) for _ in range(3))
    planes = zip(*(_phases(one) for one in (pair.first, pair.second, good)), strict=True)
    for phase, (a, b, use) in enumerate(planes):
        rows = np.array_split(np.arange(a.shape[0]), BLOCKS)
        for block, part in enumerate(rows):
            chosen = use[part]
            x, y = a[part][chosen].astype(np.float64), b[part][chosen].astype(np.float64)
            mean[block, phase] = (x.mean() + y.mean()) / 2
            variance[block, phase] = 0.5 * np.var(x - y)
            clipped[block, phase] = np.mean(x >= white_level_dn)
    return _Level(pair.exposure_s, mean, variance, clipped)


def _line(x: Array, y: Array, weight: Array) -> tuple[float, float]:
    """Return slope and intercept of the weighted line."""
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    slope = (weight * (x - mean_x) * (y - mean_y)).sum() / (weight * (x - mean_x) ** 2).sum()
    return float(slope), float(mean_y - slope * mean_x)


def characterise(darks: Sequence[Pair], flats: Iterable[Pair], white_level_dn: int) -> SensorSheet:
    """Return the sensor's figures from pairs of dark and of evenly lit frames.

    darks: at two exposures or more, for the dark current. flats: from dim to saturated, at least
    four below saturation; only one pair is held at a time. Raises CalibrationError for too few
    exposures, flats no brighter than the dark, and sizes that differ.
    """
    if len({pair.exposure_s for pair in darks}) < 2:
        raise CalibrationError("the dark current needs dark pairs at two exposures at least")
    hot = _hot(darks)
    good = ~hot
    dark_levels = [_level(pair, good, white_level_dn) for pair in darks]
    levels = []
    lit, loudest = None, 0.0
    for pair in sorted(flats, key=lambda one: one.exposure_s):
        level = _level(pair, good, white_level_dn)
        levels.append(level)
        # A phase that saturates loses its variance: the brightest pair before that shows the
        # pixels' own response best.
        quietest = float(level.variance.mean(axis=0).min())
        if level.clipped.max() < CLIPPED_SHARE and quietest > loudest:
            lit, loudest = pair, quietest
    if len(levels) < 4 or lit is None:
        raise CalibrationError(
            f"{len(levels)} flat exposures: the photon transfer curve needs four at least, and "
            "some below saturation"
        )
    dead = _dead(lit, darks[0])
    good &= ~dead
    spatial = _spatial(lit, darks[0], good)
    everything = _figures(dark_levels, levels, np.arange(BLOCKS), spatial)
    without = [
        _figures(dark_levels, levels, np.delete(np.arange(BLOCKS), block), spatial)
        for block in range(BLOCKS)
    ]
    factor = (BLOCKS - 1) / np.sqrt(BLOCKS)
    deviations = {
        name: float(factor * np.std([one[name] for one in without]))
        for name in everything
        if name not in ("prnu_percent", "dsnu_electrons")
    }
    used = int(good.sum())
    # A deviation from n independent pixels is known to 1 / sqrt(2 n) of itself.
    for name in ("prnu_percent", "dsnu_electrons"):
        deviations[name] = everything[name] / np.sqrt(2 * used)
    curve, residual = _curve(dark_levels, levels)
    return SensorSheet(
        **everything,
        hot_pixels=int(hot.sum()),
        dead_pixels=int(dead.sum()),
        curve=curve,
        linearity_residual=residual,
        good=good,
        deviations=deviations,
        saturated=_saturated(levels),
    )


def _dark_line(darks: Sequence[_Level], blocks: NDArray[np.intp]) -> tuple[float, float, float]:
    """Return the dark signal's slope in DN/s, the black level, and the variance at no exposure."""
    times = np.array([one.exposure_s for one in darks])
    means = np.array([one.mean[blocks].mean() for one in darks])
    variances = np.array([one.variance[blocks].mean() for one in darks])
    slope, black = _line(times, means, np.ones_like(times))
    _, variance = _line(times, variances, 1 / np.maximum(variances, 1e-9) ** 2)
    return slope, black, max(variance, 1e-9)


def _points(
    darks: Sequence[_Level], flats: Sequence[_Level], blocks: NDArray[np.intp]
) -> tuple[Array, Array, Array, Array, float, float, float]:
    """Return signal, variance, exposure, clipped share (all level x phase) and the dark line."""
    slope, black, variance = _dark_line(darks, blocks)
    times = np.array([[one.exposure_s] * 4 for one in flats])
    signal = np.array([one.mean[blocks].mean(axis=0) for one in flats]) - black - slope * times
    spread = np.array([one.variance[blocks].mean(axis=0) for one in flats])
    clipped = np.array([one.clipped[blocks].max(axis=0) for one in flats])
    return signal, spread, times, clipped, slope, black, variance


def _saturation(signal: Array, spread: Array, clipped: Array) -> float:
    """Return the signal at which the variance is greatest: EMVA 1288's saturation point."""
    free = np.where(clipped < CLIPPED_SHARE, spread, 0)
    return float(max(signal[np.argmax(free[:, phase]), phase] for phase in range(4)))


def _saturated(flats: Sequence[_Level]) -> bool:
    """Return whether the brightest flat lies past saturation: clipped, or of less variance."""
    brightest = max(flats, key=lambda one: one.exposure_s)
    most = np.max([one.variance.mean(axis=0) for one in flats], axis=0)
    fell = brightest.variance.mean(axis=0) < FALLEN_SHARE * most
    return bool(brightest.clipped.max() >= CLIPPED_SHARE or fell.any())


def _figures(
    darks: Sequence[_Level], flats: Sequence[_Level], blocks: NDArray[np.intp], spatial: Array
) -> dict[str, float]:
    signal, spread, times, clipped, slope, black, dark = _points(darks, flats, blocks)
    saturation = _saturation(signal, spread, clipped)
    if saturation < BRIGHTER_DEVIATIONS * np.sqrt(dark):
        raise CalibrationError("the flats are no brighter than the dark: is the lamp on?")
    below = (signal <= FIT_SHARE * saturation) & (signal > 0)
    if below.sum() < 3:
        raise CalibrationError(
            "fewer than three flats lie below 70 % of saturation: add shorter exposures"
        )
    weight = 1 / np.maximum(spread[below], 1e-9) ** 2
    # The dark point anchors the line.
    x, y = np.append(signal[below], 0.0), np.append(spread[below], dark)
    gain, _ = _line(x, y, np.append(weight, 1 / dark**2))
    read2 = max(dark - QUANTISATION_DN2, 0)
    well = saturation / gain if gain > 0 else 0.0
    read = np.sqrt(read2) / gain if gain > 0 else 0.0
    least = np.sqrt(read**2 + QUANTISATION_DN2 / gain**2) + 0.5 if gain > 0 else 1.0
    dsnu_dn, prnu = spatial
    residual = _linearity(signal, times, saturation)
    return {
        "gain_dn_per_electron": gain,
        "read_noise_electrons": float(read),
        "dark_current_electrons_per_s": slope / gain if gain > 0 else 0.0,
        "black_level_dn": black,
        "dark_variance_dn2": dark,
        "full_well_electrons": well,
        "saturation_dn": saturation,
        "linearity_error_percent": float((np.nanmax(residual) - np.nanmin(residual)) / 2),
        "dsnu_electrons": float(dsnu_dn / gain) if gain > 0 else 0.0,
        "prnu_percent": float(100 * prnu),
        "snr_max_db": float(10 * np.log10(max(well, 1e-9))),
        "dynamic_range_db": float(20 * np.log10(max(well / least, 1e-9))),
    }


def _linearity(signal: Array, times: Array, saturation: float) -> Array:
    """Return deviations from the line through 5 to 95 % of saturation, percent; NaN outside."""
    residual = np.full(signal.shape, np.nan)
    for phase in range(4):
        y, t = signal[:, phase], times[:, phase]
        low, high = (share * saturation for share in LINEAR_RANGE)
        inside = (y >= low) & (y <= high)
        if inside.sum() < 3:
            continue
        slope, zero = _line(t[inside], y[inside], 1 / y[inside] ** 2)
        line = slope * t[inside] + zero
        residual[inside, phase] = 100 * (y[inside] - line) / line
    if np.isnan(residual).all():
        raise CalibrationError(
            "fewer than three flats lie between 5 and 95 % of saturation: add exposures"
        )
    return residual


def _curve(darks: Sequence[_Level], flats: Sequence[_Level]) -> tuple[Curve, Array]:
    """Return every phase's points in one curve, and its deviations from the line."""
    signal, spread, times, clipped, *_ = _points(darks, flats, np.arange(BLOCKS))
    residual = _linearity(signal, times, _saturation(signal, spread, clipped))
    return Curve(signal.ravel(), spread.ravel(), times.ravel()), residual.ravel()


def _hot(darks: Sequence[Pair]) -> NDArray[np.bool_]:
    """Return pixels whose longest dark frame stands out."""
    longest = max(darks, key=lambda one: one.exposure_s)
    mean = (longest.first.astype(np.float64) + longest.second) / 2
    off = mean - np.median(mean)
    return np.abs(off) > HOT_DEVIATIONS * max(1.4826 * float(np.median(np.abs(off))), 0.5)


def _dead(flat: Pair, dark: Pair) -> NDArray[np.bool_]:
    """Return pixels that see less than half of what their colour's do."""
    signal = (flat.first.astype(np.float64) + flat.second - dark.first - dark.second) / 2
    dead = np.zeros(signal.shape, dtype=bool)
    for y in range(2):
        for x in range(2):
            part = signal[y::2, x::2]
            dead[y::2, x::2] = part < DEAD_SHARE * np.median(part)
    return dead


def _spatial(flat: Pair, dark: Pair, good: NDArray[np.bool_]) -> Array:
    """Return DSNU in DN and PRNU as a share: spatial deviations less what noise makes of them.

    A smooth quadratic is taken out of each phase first: the lamp's falloff is not the pixels'.
    """
    found = []
    for pair, minus in ((dark, None), (flat, dark)):
        squares, count, level = 0.0, 0, 0.0
        first, second = pair.first.astype(np.float64), pair.second.astype(np.float64)
        if minus is not None:
            black = (minus.first.astype(np.float64) + minus.second) / 2
            first, second = first - black, second - black
        for a, b, use in zip(_phases(first), _phases(second), _phases(good), strict=True):
            mean = (a + b) / 2
            smooth = _quadratic(mean, use)
            off = ((mean - smooth) / (smooth if minus is not None else 1))[use]
            noise = 0.5 * np.var((a - b)[use] / (smooth[use] if minus is not None else 1)) / 2
            if minus is not None:
                # The dark frame subtracted is a mean of two as well.
                both = (minus.first.astype(np.float64) - minus.second)[good]
                noise += 0.25 * np.var(both) / float(np.mean(smooth)) ** 2
            squares += max(float(np.var(off)) - noise, 0.0) * off.size
            count += off.size
            level += float(smooth.mean())
        found.append(np.sqrt(squares / count))
    return np.array(found)


def _quadratic(values: Array, use: NDArray[np.bool_]) -> Array:
    """Return the quadratic surface through the pixels to use, (y, x)."""
    y, x = (np.linspace(-1, 1, count) for count in values.shape)
    yy, xx = np.meshgrid(y, x, indexing="ij")
    terms = np.stack([np.ones_like(xx), xx, yy, xx * xx, xx * yy, yy * yy], axis=-1)
    basis = terms[use]
    found = np.linalg.solve(basis.T @ basis, basis.T @ values[use])
    return terms @ found

"""What the sensor does to light: the linear model of EMVA 1288 from dark and flat frames.

Two frames per exposure give mean and temporal variance (the variance of their difference, so that
pixels' own differences cancel). Their line, variance against signal, is the photon transfer curve:
its slope is the gain K in DN per electron. Every figure's deviation is a jackknife over BLOCKS
groups of rows. Under a colour filter each of its 2 x 2 phases has its own level; all lie on one
curve. Where light falls off to the corners, saturation is read where it is brightest.

What differs from pixel to pixel is separated from noise by the covariance of the two frames.

Source: EMVA Standard 1288, release 4.0, linear (sections 2 to 8).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.robust import deviation_of

Array = NDArray[np.floating]
Frame = NDArray[np.uint16]
BLOCKS = 12
TILES = 8
"""Across: with BLOCKS down, the parts of a frame of which the brightest show saturation."""
BRIGHTEST_SHARE = 0.95
CLIPPED_BLACK = 1e-3
"""Share of the pixels of the shortest dark that read 0, from which on the black level clips."""
FIT_SHARE = 0.7
LINEAR_RANGE = (0.05, 0.95)
CLIPPED_SHARE = 0.01
FALLEN_SHARE = 0.8
"""Of the greatest variance: beyond what noise makes of the variance of a frame of any size."""
COLLAPSED_SHARE = 0.1
"""Of the greatest variance, where every pixel is full: then the mean is where they saturate."""
PRNU_SHARE, HELD_SHARE = 0.5, 0.4
"""Of saturation, where PRNU is measured; of the brightest flat, what is held till that is known."""
QUANTISATION_DN2 = 1 / 12
QUANTISED_DN2, QUANTISED_DN = 0.24, 0.40
"""A dark variance below the first is that of the steps: the read noise is below the second."""
ROUNDED_DN = 0.2
"""What rounding may add to a mean of pixels that hardly differ: 1/pi at most, 0.2 at 0.16 DN."""
BRIGHTER_DEVIATIONS = 10.0
EVERY = np.arange(BLOCKS)
HOT_DEVIATIONS = 8.0
DEAD_SHARE = 0.5


@dataclass(frozen=True)
class Pair:
    """Two frames (y, x) of one exposure."""

    exposure_s: float
    first: Frame
    second: Frame


@dataclass(frozen=True, eq=False)
class TransferCurve:
    """The photon transfer curve of all rows: signal above the dark, variance, exposure."""

    mean_dn: Array
    variance_dn2: Array
    exposure_s: Array


@dataclass(frozen=True)
class Nonuniformity:
    """What differs between pixels, without noise: its variance, and the variance of that."""

    variance: float
    uncertainty: float

    def figure(self, scale: float) -> tuple[float, float]:
        """Return the deviation between pixels and how sure it is, times a scale."""
        value, sure = float(np.sqrt(max(self.variance, 0.0))), float(np.sqrt(self.uncertainty))
        spread = sure / (2 * value) if self.variance > sure else float(np.sqrt(sure))
        return scale * value, scale * spread


@dataclass(frozen=True, eq=False)
class SensorSheet:
    """The EMVA 1288 quantities; `deviations` by their names.

    linearity_residual: percent, per point of the curve. good: (y, x), neither hot nor dead.
    saturated: the flats reach saturation; else what follows from it is a lower bound. quantised:
    the read noise is below what the steps of the converter tell, and an upper bound. black_clipped:
    the darks reach 0, and what differs in the dark is a lower bound. dsnu, prnu: in DN and as
    shares.
    """

    gain_dn_per_electron: float
    read_noise_electrons: float
    dark_current_electrons_per_s: float
    black_level_dn: float
    dark_variance_dn2: float
    full_well_electrons: float
    saturation_dn: float
    linearity_error_percent: float
    exposures: int
    dsnu: Nonuniformity
    prnu: Nonuniformity
    snr_max_db: float
    dynamic_range_db: float
    hot_pixels: int
    dead_pixels: int
    curve: TransferCurve
    linearity_residual: Array
    good: NDArray[np.bool_]
    deviations: dict[str, float] = field(default_factory=dict)
    saturated: bool = True
    quantised: bool = False
    black_clipped: bool = False

    def bound(self, name: str) -> str:
        """Return which kind of bound a quantity or "dsnu" is, in words; empty where it is none."""
        if name in OF_SATURATION and not self.saturated:
            return ", at least"
        if name in OF_DARK and self.black_clipped:
            return ", at least (the darks are clipped at 0 DN: raise the camera's black level)"
        hidden = name == "read_noise_electrons" or (name == "dsnu" and self.dsnu.figure(1.0)[0] < 1)
        if hidden and self.quantised:
            return ", at most (below the steps of the converter: raise the camera's gain)"
        return ""

    def rows(self) -> list[tuple[str, float, float | None, str]]:
        """Return (quantity, value, standard deviation or None, unit) for a table."""
        found = []
        for name, (words, unit) in QUANTITIES.items():
            words += self.bound(name)
            found.append((words, float(getattr(self, name)), self.deviations.get(name), unit))
        for words, one, scale, unit in (
            ("DSNU", self.dsnu, 1 / self.gain_dn_per_electron, "e"),
            ("PRNU", self.prnu, 100.0, "%"),
        ):
            bound, (value, deviation) = self.bound(words.lower()), one.figure(scale)
            if "at most" in bound:
                value, deviation = max(value, scale * QUANTISED_DN), 0.0
            found.append((words + bound, value, deviation or None, unit))
        return found


QUANTITIES = {
    "gain_dn_per_electron": ("Overall system gain K", "DN/e"),
    "black_level_dn": ("Black level", "DN"),
    "read_noise_electrons": ("Temporal dark noise", "e"),
    "dark_current_electrons_per_s": ("Dark current", "e/s"),
    "full_well_electrons": ("Saturation capacity", "e"),
    "saturation_dn": ("Saturation", "DN above dark"),
    "linearity_error_percent": ("Linearity error", "%"),
    "exposures": ("Exposures of the linearity", ""),
    "snr_max_db": ("Greatest signal-to-noise ratio", "dB"),
    "dynamic_range_db": ("Dynamic range", "dB"),
    "hot_pixels": ("Hot pixels", ""),
    "dead_pixels": ("Dead pixels", ""),
}
OF_DARK = ("read_noise_electrons", "black_level_dn", "dark_current_electrons_per_s", "dsnu")
OF_SATURATION = ("full_well_electrons", "saturation_dn", "snr_max_db", "dynamic_range_db")


@dataclass(frozen=True, eq=False)
class _Level:
    """Statistics of one pair by block of rows, tile across and phase of the filter."""

    exposure_s: float
    mean: Array
    variance: Array
    clipped: Array

    def of(self, blocks: NDArray[np.intp], name: str) -> Array:
        """Return the mean over blocks of a statistic, by phase."""
        return np.nanmean(getattr(self, name)[blocks], axis=(0, 1))

    def brightest(self, blocks: NDArray[np.intp], bright: NDArray[np.bool_], name: str) -> Array:
        """Return the mean over the bright tiles, by phase."""
        chosen = np.zeros_like(bright)
        chosen[blocks] = bright[blocks]
        return np.nanmean(getattr(self, name)[chosen if chosen.any() else bright], axis=0)


def _phases(frame: NDArray) -> list[NDArray]:
    return [frame[y::2, x::2] for y in range(2) for x in range(2)]


def _level(pair: Pair, good: NDArray[np.bool_], white_level_dn: int) -> _Level:
    if pair.first.shape != pair.second.shape or pair.first.shape != good.shape:
        raise CalibrationError(
            f"exposure of {pair.exposure_s:g} s: frames of {pair.first.shape} and "
            f"{pair.second.shape} differ from {good.shape}: are they of one camera?"
        )
    mean, variance, clipped = (np.full((BLOCKS, TILES, 4), np.nan) for _ in range(3))
    planes = zip(*(_phases(one) for one in (pair.first, pair.second, good)), strict=True)
    for phase, (a, b, use) in enumerate(planes):
        rows, columns = (
            np.linspace(0, length, count + 1).astype(int)
            for length, count in zip(a.shape, (BLOCKS, TILES), strict=True)
        )
        for block, tile in np.ndindex(BLOCKS, TILES):
            part = (
                slice(rows[block], rows[block + 1]),
                slice(columns[tile], columns[tile + 1]),
            )
            x, y = (one[part][use[part]].astype(np.float64) for one in (a, b))
            if len(x) < 2:
                continue
            mean[block, tile, phase] = (x.mean() + y.mean()) / 2
            variance[block, tile, phase] = 0.5 * np.var(x - y, ddof=1)
            clipped[block, tile, phase] = np.mean(x >= white_level_dn)
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
    four below saturation; few pairs are held at a time. Raises CalibrationError for too few
    exposures, flats no brighter than the dark, and sizes that differ.
    """
    if len({pair.exposure_s for pair in darks}) < 2:
        raise CalibrationError("the dark current needs dark pairs at two exposures at least")
    hot = _hot(darks)
    good = ~hot
    dark_levels = [_level(pair, good, white_level_dn) for pair in darks]
    levels: list[_Level] = []
    unsaturated: list[tuple[float, Pair]] = []
    loudest, light = 0.0, np.zeros(0)
    for pair in flats:
        level = _level(pair, good, white_level_dn)
        levels.append(level)
        # A phase that saturates loses its variance.
        quietest = float(level.of(EVERY, "variance").min())
        if np.nanmax(level.clipped) < CLIPPED_SHARE and quietest > loudest:
            mean, loudest = float(level.of(EVERY, "mean").mean()), quietest
            light = level.mean
            unsaturated = [one for one in unsaturated if one[0] > HELD_SHARE * mean]
            unsaturated.append((mean, pair))
    if len(levels) < 4 or not unsaturated:
        raise CalibrationError(
            f"{len(levels)} flat exposures: the photon transfer curve needs four at least, and "
            "some below saturation"
        )
    brightest_dn, brightest = unsaturated[-1]
    dead = _dead(brightest, darks[0])
    good &= ~dead
    bright = _brightest(light - min(one.of(EVERY, "mean").mean() for one in dark_levels))
    everything = _figures(dark_levels, levels, EVERY, bright)
    without = [
        _figures(dark_levels, levels, np.delete(EVERY, block), bright) for block in range(BLOCKS)
    ]
    factor = (BLOCKS - 1) / np.sqrt(BLOCKS)
    deviations = {
        name: float(factor * np.std([one[name] for one in without])) for name in everything
    }
    quantised = everything["dark_variance_dn2"] < QUANTISED_DN2
    if quantised:
        # Without noise to spread them, mean darks are rounded alike.
        times_s = [pair.exposure_s for pair in darks]
        rounded = ROUNDED_DN / (max(times_s) - min(times_s)) / everything["gain_dn_per_electron"]
        for name, more in (
            ("black_level_dn", ROUNDED_DN), ("dark_current_electrons_per_s", rounded)
        ):  # fmt: skip
            deviations[name] = float(np.hypot(deviations[name], more))
    black_dn = everything["black_level_dn"]
    half_dn = black_dn + PRNU_SHARE * (brightest_dn - black_dn)
    lit = min(unsaturated, key=lambda one: abs(one[0] - half_dn))[1]
    points = _points(levels, EVERY, bright, _dark_line(dark_levels, EVERY))
    saturation, step = points.saturation
    share = step / np.sqrt(3) / saturation
    for name, slope in (
        ("full_well_electrons", everything["full_well_electrons"]),
        ("saturation_dn", saturation),
        ("snr_max_db", 10 / np.log(10)),
        ("dynamic_range_db", 20 / np.log(10)),
    ):
        deviations[name] = float(np.hypot(deviations[name], share * slope))
    shortest = min(darks, key=lambda one: one.exposure_s)
    black_clipped = np.mean([np.mean(one == 0) for one in (shortest.first, shortest.second)])
    return SensorSheet(
        **everything,
        exposures=len(levels),
        dsnu=_nonuniformity(darks[0], None, good),
        prnu=_nonuniformity(lit, darks[0], good),
        hot_pixels=int(hot.sum()),
        dead_pixels=int(dead.sum()),
        curve=TransferCurve(
            points.signal.ravel(), points.variance.ravel(), points.exposure_s.ravel()
        ),
        linearity_residual=_linearity(points).ravel(),
        good=good,
        deviations=deviations,
        saturated=_saturated(levels, bright),
        quantised=quantised,
        black_clipped=bool(black_clipped > CLIPPED_BLACK),
    )


def _brightest(light: Array) -> NDArray[np.bool_]:
    """Return which tiles have nearly as much light as the brightest, (block, tile)."""
    share = np.nanmean(light / np.nanmax(light, axis=(0, 1)), axis=2)
    return share >= BRIGHTEST_SHARE * np.nanmax(share)


def _dark_line(darks: Sequence[_Level], blocks: NDArray[np.intp]) -> tuple[float, float, float]:
    """Return the dark signal's slope in DN/s, the black level, and the variance at no exposure."""
    times = np.array([one.exposure_s for one in darks])
    means = np.array([one.of(blocks, "mean").mean() for one in darks])
    variances = np.array([one.of(blocks, "variance").mean() for one in darks])
    slope, black = _line(times, means, np.ones_like(times))
    _, variance = _line(times, variances, 1 / np.maximum(variances, 1e-9) ** 2)
    return slope, black, max(variance, 1e-9)


@dataclass(frozen=True, eq=False)
class _Points:
    """Signal, variance, exposure and clipped share of the flats, all (level, phase).

    bright_signal, bright_variance: of the brightest tiles.
    """

    signal: Array
    variance: Array
    exposure_s: Array
    clipped: Array
    bright_signal: Array
    bright_variance: Array

    @property
    def saturation(self) -> tuple[float, float]:
        """The signal where all pixels are full, else that of the greatest variance; the step.

        Between two exposures the latter, EMVA 1288's saturation point, is known to their step: by
        so much it may be higher.
        """
        found = []
        for phase in range(self.signal.shape[1]):
            signal, variance = self.bright_signal[:, phase], self.bright_variance[:, phase]
            free = np.where(self.clipped[:, phase] < CLIPPED_SHARE, variance, 0)
            loudest = int(np.argmax(free))
            full = (signal > signal[loudest]) & (variance < COLLAPSED_SHARE * free[loudest])
            brighter = signal[signal > signal[loudest]]
            if full.any():
                found.append((float(signal[full].mean()), 0.0))
            else:
                step = brighter.min() - signal[loudest] if brighter.size else 0.0
                found.append((float(signal[loudest]), float(step)))
        return max(found)


def _points(
    flats: Sequence[_Level],
    blocks: NDArray[np.intp],
    bright: NDArray[np.bool_],
    dark_line: tuple[float, float, float],
) -> _Points:
    slope, black, _ = dark_line
    times = np.array([[one.exposure_s] * 4 for one in flats])
    dark = black + slope * times
    return _Points(
        np.array([one.of(blocks, "mean") for one in flats]) - dark,
        np.array([one.of(blocks, "variance") for one in flats]),
        times,
        np.array([np.nanmax(one.clipped[blocks], axis=(0, 1)) for one in flats]),
        np.array([one.brightest(blocks, bright, "mean") for one in flats]) - dark,
        np.array([one.brightest(blocks, bright, "variance") for one in flats]),
    )


def _saturated(flats: Sequence[_Level], bright: NDArray[np.bool_]) -> bool:
    """Return whether the brightest flat lies past saturation: clipped, or of less variance."""
    brightest = max(flats, key=lambda one: one.exposure_s)
    most = np.max([one.brightest(EVERY, bright, "variance") for one in flats], axis=0)
    fell = brightest.brightest(EVERY, bright, "variance") < FALLEN_SHARE * most
    return bool(np.nanmax(brightest.clipped) >= CLIPPED_SHARE or fell.any())


def _figures(
    darks: Sequence[_Level],
    flats: Sequence[_Level],
    blocks: NDArray[np.intp],
    bright: NDArray[np.bool_],
) -> dict[str, float]:
    slope, black, dark = dark_line = _dark_line(darks, blocks)
    points = _points(flats, blocks, bright, dark_line)
    saturation, _ = points.saturation
    if saturation < BRIGHTER_DEVIATIONS * np.sqrt(dark):
        raise CalibrationError("the flats are no brighter than the dark: is the lamp on?")
    below = (points.bright_signal <= FIT_SHARE * saturation) & (points.signal > 0)
    if below.sum() < 3:
        raise CalibrationError(
            "fewer than three flats lie below 70 % of saturation: add shorter exposures"
        )
    # The dark point anchors the line.
    x, y = np.append(points.signal[below], 0.0), np.append(points.variance[below], dark)
    expected = y
    for _ in range(2):
        # By the measured variance a level that is low by chance would count more.
        gain, zero = _line(x, y, 1 / np.maximum(expected, 1e-9) ** 2)
        expected = gain * x + zero
    if gain <= 0:
        raise CalibrationError(
            "the variance does not grow with the light: are these frames as the sensor gave them?"
        )
    read_dn = np.sqrt(max(dark - QUANTISATION_DN2, 0))
    if dark < QUANTISED_DN2:
        read_dn = QUANTISED_DN
    well, read = saturation / gain, read_dn / gain
    least = np.sqrt(read**2 + QUANTISATION_DN2 / gain**2) + 0.5
    residual = _linearity(points)
    return {
        "gain_dn_per_electron": gain,
        "read_noise_electrons": float(read),
        "dark_current_electrons_per_s": slope / gain,
        "black_level_dn": black,
        "dark_variance_dn2": dark,
        "full_well_electrons": well,
        "saturation_dn": saturation,
        "linearity_error_percent": float((np.nanmax(residual) - np.nanmin(residual)) / 2),
        "snr_max_db": float(10 * np.log10(max(well, 1e-9))),
        "dynamic_range_db": float(20 * np.log10(max(well / least, 1e-9))),
    }


def _linearity(points: _Points) -> Array:
    """Return deviations from the line through 5 to 95 % of saturation, percent; NaN outside."""
    residual = np.full(points.signal.shape, np.nan)
    low, high = (share * points.saturation[0] for share in LINEAR_RANGE)
    for phase in range(4):
        y, t = points.signal[:, phase], points.exposure_s[:, phase]
        inside = (y >= low) & (points.bright_signal[:, phase] <= high)
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


def _hot(darks: Sequence[Pair]) -> NDArray[np.bool_]:
    """Return pixels whose longest dark frame stands out."""
    longest = max(darks, key=lambda one: one.exposure_s)
    mean = (longest.first.astype(np.float64) + longest.second) / 2
    off = mean - np.median(mean)
    return np.abs(off) > HOT_DEVIATIONS * max(deviation_of(off), 0.5)


def _dead(flat: Pair, dark: Pair) -> NDArray[np.bool_]:
    """Return pixels that see less than half of what their colour's do."""
    signal = (flat.first.astype(np.float64) + flat.second - dark.first - dark.second) / 2
    dead = np.zeros(signal.shape, dtype=bool)
    for y in range(2):
        for x in range(2):
            part = signal[y::2, x::2]
            dead[y::2, x::2] = part < DEAD_SHARE * np.median(part)
    return dead


def _nonuniformity(pair: Pair, dark: Pair | None, good: NDArray[np.bool_]) -> Nonuniformity:
    """Return what differs between pixels, in DN, or with a dark pair as a share of the signal.

    A smooth quadratic is taken out of each phase of each frame first: the lamp's falloff and its
    flicker are not the pixels'.
    """
    rows, columns = (count // 2 * 2 for count in good.shape)
    frames = [one.astype(np.float64) for one in (pair.first, pair.second)]
    if dark is not None:
        # One dark each, so that their noise does not vary together.
        frames = [one - black for one, black in zip(frames, (dark.first, dark.second), strict=True)]
    variances, uncertainties = [], []
    planes = (_phases(one[:rows, :columns]) for one in (*frames, good))
    for first, second, use in zip(*planes, strict=True):
        # Each frame's own surface: the lamp may differ between them.
        surfaces = [_quadratic(one, use) for one in (first, second)]
        a, b = (
            np.where(use, (one - smooth) / (smooth if dark is not None else 1.0), 0)
            for one, smooth in zip((first, second), surfaces, strict=True)
        )
        variances.append(float(np.sum(a * b) / use.sum()))
        uncertainties.append(_uncertainty(a, b, float(use.sum())))
    return Nonuniformity(
        float(np.mean(variances)), float(np.sum(uncertainties)) / len(uncertainties) ** 2
    )


def _uncertainty(a: Array, b: Array, count: float) -> float:
    """Return the variance of the mean product of two frames' values (y, x), `count` of them.

    Rows and columns that differ from frame to frame make it less sure than pixels alone do.
    """

    def of_product(one: Array, other: Array, count: float) -> float:
        both, noise = float(np.mean(one * other)), float(np.mean((one - other) ** 2) / 2)
        return (both**2 + (max(both, 0.0) + noise) ** 2) / count

    # Two phases of the filter share each row and each column.
    lines = [2 * of_product(a.mean(k), b.mean(k), a.shape[1 - k]) for k in (0, 1)]
    return of_product(a, b, count) + sum(lines)


def _quadratic(values: Array, use: NDArray[np.bool_]) -> Array:
    """Return the quadratic surface through the pixels to use, (y, x)."""
    y, x = (np.linspace(-1, 1, count) for count in values.shape)
    yy, xx = np.meshgrid(y, x, indexing="ij")
    terms = np.stack([np.ones_like(xx), xx, yy, xx * xx, xx * yy, yy * yy], axis=-1)
    basis = terms[use]
    found = np.linalg.solve(basis.T @ basis, basis.T @ values[use])
    return terms @ found

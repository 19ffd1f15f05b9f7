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

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.robust import deviation_of

Array = NDArray[np.floating]
Frame = NDArray[np.uint16]
Flags = NDArray[np.bool_]
BLOCKS = 12
"""Of rows: a deviation of so many is known to a fifth."""
TILES = 8
"""Across: with BLOCKS down, the parts of a frame of which the brightest show saturation."""
BRIGHTEST_SHARE = 0.95
"""Of the brightest tile's light, from which on a tile shows saturation."""
CLIPPED_BLACK = 1e-3
"""Share of the pixels of the shortest dark that read 0, from which on the black level clips."""
FIT_SHARE, LINEAR_RANGE = 0.7, (0.05, 0.95)
"""Of saturation, where gain and linearity are fitted, as EMVA 1288 has it."""
CLIPPED_SHARE = 0.01
"""Of a tile's pixels at the white level, from which on it saturates."""
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
"""Of the dark's noise, by which flats at saturation are brighter at least."""
EVERY = np.ones((BLOCKS, TILES), dtype=bool)
HOT_DEVIATIONS = 8.0
"""Robust ones of all pixels, from which on a dark pixel is hot: of normal noise none is."""
DEAD_SHARE = 0.5
"""Of the median of a pixel's colour, below which it is dead."""


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
    """The variance of what differs between pixels without noise, and the estimate's variance."""

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
    good: Flags
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
        for words, differences, scale, unit in (
            ("DSNU", self.dsnu, 1 / self.gain_dn_per_electron, "e"),
            ("PRNU", self.prnu, 100.0, "%"),
        ):
            bound, (value, deviation) = self.bound(words.lower()), differences.figure(scale)
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
class _Levels:
    """Statistics of pairs by block of rows, tile across and phase of the filter.

    exposure_s: (pair,). mean, variance, clipped: (pair, block, tile, phase), NaN without pixels.
    """

    exposure_s: Array
    mean: Array
    variance: Array
    clipped: Array

    def over(self, tiles: Flags, name: str) -> Array:
        """Return the mean of a statistic over the tiles flagged, (pair, phase)."""
        return np.nanmean(getattr(self, name)[:, tiles], axis=1)


def _phases(frame: NDArray) -> list[NDArray]:
    return [frame[y::2, x::2] for y in range(2) for x in range(2)]


def _measure_pair(
    pair: Pair, good: Flags, white_level_dn: int
) -> tuple[float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return exposure, mean, variance and clipped share of a pair, see `_Levels`."""
    if pair.first.shape != pair.second.shape or pair.first.shape != good.shape:
        raise CalibrationError(
            f"exposure of {pair.exposure_s:g} s: frames of {pair.first.shape} and "
            f"{pair.second.shape} differ from {good.shape}: are they of one camera?"
        )
    mean, variance, clipped = (np.full((BLOCKS, TILES, 4), np.nan) for _ in range(3))
    for phase, planes in enumerate(
        zip(*map(_phases, (pair.first, pair.second, good)), strict=True)
    ):
        rows, columns = (
            np.linspace(0, length, count + 1).astype(int)
            for length, count in zip(planes[0].shape, (BLOCKS, TILES), strict=True)
        )
        for block, tile in np.ndindex(BLOCKS, TILES):
            down = slice(rows[block], rows[block + 1])
            x, y, use = (plane[down, columns[tile] : columns[tile + 1]] for plane in planes)
            x, y = x[use].astype(np.float64), y[use].astype(np.float64)
            if len(x) < 2:
                continue
            mean[block, tile, phase] = (x.mean() + y.mean()) / 2
            variance[block, tile, phase] = 0.5 * np.var(x - y, ddof=1)
            clipped[block, tile, phase] = np.mean(x >= white_level_dn)
    return pair.exposure_s, mean, variance, clipped


def _fit_line(x: Array, y: Array, weight: Array) -> tuple[float, float]:
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
    times_s = [pair.exposure_s for pair in darks]
    if len(set(times_s)) < 2:
        raise CalibrationError("the dark current needs dark pairs at two exposures at least")
    hot = _hot_pixels(darks[int(np.argmax(times_s))])
    good = ~hot
    dark = _stack_levels(_measure_pair(pair, good, white_level_dn) for pair in darks)
    flat, unsaturated = _read_flats(flats, good, white_level_dn)
    brightest_dn, light, brightest = unsaturated[-1]
    dead = _dead_pixels(brightest, darks[0])
    good &= ~dead
    light = light - dark.over(EVERY, "mean").mean(axis=1).min()
    share = np.nanmean(light / np.nanmax(light, axis=(0, 1)), axis=2)
    bright = share >= BRIGHTEST_SHARE * np.nanmax(share)
    points = _transfer_points(dark, flat, EVERY, bright)
    figures = points.figures()
    quantised = points.dark_variance_dn2 < QUANTISED_DN2
    deviations = _deviations(dark, flat, bright)
    if quantised:
        _add_rounding(deviations, figures["gain_dn_per_electron"], max(times_s) - min(times_s))
    _add_saturation_step(deviations, figures, *points.saturation)
    half_dn = points.black_dn + PRNU_SHARE * (brightest_dn - points.black_dn)
    lit = min(unsaturated, key=lambda held: abs(held[0] - half_dn))[2]
    shortest = darks[int(np.argmin(times_s))]
    black_clipped = np.mean([np.mean(frame == 0) for frame in (shortest.first, shortest.second)])
    variance, last = flat.over(bright, "variance"), int(np.argmax(flat.exposure_s))
    fell = variance[last] < FALLEN_SHARE * variance.max(axis=0)
    return SensorSheet(
        **figures,
        exposures=len(flat.exposure_s),
        dsnu=_nonuniformity(darks[0], None, good),
        prnu=_nonuniformity(lit, darks[0], good),
        hot_pixels=int(hot.sum()),
        dead_pixels=int(dead.sum()),
        curve=TransferCurve(
            points.signal.ravel(), points.variance.ravel(), points.exposure_s.ravel()
        ),
        linearity_residual=points.linearity().ravel(),
        good=good,
        deviations=deviations,
        saturated=bool(np.nanmax(flat.clipped[last]) >= CLIPPED_SHARE or fell.any()),
        quantised=quantised,
        black_clipped=bool(black_clipped > CLIPPED_BLACK),
    )


def _stack_levels(levels: Iterable[tuple]) -> _Levels:
    return _Levels(*(np.array(values) for values in zip(*levels, strict=True)))


def _read_flats(
    flats: Iterable[Pair], good: Flags, white_level_dn: int
) -> tuple[_Levels, list[tuple[float, Array, Pair]]]:
    """Return the flats' levels, and (mean in DN, by tile, pair) of those bright and unsaturated."""
    levels: list[tuple] = []
    unsaturated: list[tuple[float, Array, Pair]] = []
    loudest = 0.0
    for pair in flats:
        level = _measure_pair(pair, good, white_level_dn)
        levels.append(level)
        _, means, variances, clipped = level
        # A phase that saturates loses its variance.
        quietest = float(np.nanmean(variances, axis=(0, 1)).min())
        if np.nanmax(clipped) < CLIPPED_SHARE and quietest > loudest:
            mean, loudest = float(np.nanmean(means, axis=(0, 1)).mean()), quietest
            unsaturated = [held for held in unsaturated if held[0] > HELD_SHARE * mean]
            unsaturated.append((mean, means, pair))
    if len(levels) < 4 or not unsaturated:
        raise CalibrationError(
            f"{len(levels)} flat exposures: the photon transfer curve needs four at least, and "
            "some below saturation"
        )
    return _stack_levels(levels), unsaturated


def _deviations(dark: _Levels, flat: _Levels, bright: Flags) -> dict[str, float]:
    """Return the figures' deviations by a jackknife over blocks of rows."""
    without = []
    for block in range(BLOCKS):
        tiles = EVERY.copy()
        tiles[block] = False
        without.append(_transfer_points(dark, flat, tiles, bright).figures())
    factor = (BLOCKS - 1) / np.sqrt(BLOCKS)
    return {
        name: float(factor * np.std([figures[name] for figures in without])) for name in without[0]
    }


def _add_rounding(deviations: dict[str, float], gain_dn_per_electron: float, span_s: float) -> None:
    """Add what rounding makes of mean darks, over exposures that differ by span_s.

    Without noise to spread them, all pixels are rounded alike.
    """
    current_dn_per_s = ROUNDED_DN / span_s
    for name, rounded in (
        ("black_level_dn", ROUNDED_DN),
        ("dark_current_electrons_per_s", current_dn_per_s / gain_dn_per_electron),
    ):
        deviations[name] = float(np.hypot(deviations[name], rounded))


def _add_saturation_step(
    deviations: dict[str, float], figures: dict[str, float], saturation_dn: float, step_dn: float
) -> None:
    """Add what a step between exposures leaves open of saturation: uniform, of deviation / sqrt 3.

    Each figure grows by its slope times a relative change of the saturation.
    """
    for name, slope in (
        ("full_well_electrons", figures["full_well_electrons"]),
        ("saturation_dn", saturation_dn),
        ("snr_max_db", 10 / np.log(10)),
        ("dynamic_range_db", 20 / np.log(10)),
    ):
        of_step = step_dn / np.sqrt(3) / saturation_dn * slope
        deviations[name] = float(np.hypot(deviations[name], of_step))


@dataclass(frozen=True, eq=False)
class _Points:
    """Signal, variance, exposure and clipped share of the flats, all (level, phase).

    bright_signal, bright_variance: of the brightest tiles. dark_dn_per_s, black_dn: slope and
    start of the dark signal. dark_variance_dn2: at no exposure.
    """

    signal: Array
    variance: Array
    exposure_s: Array
    clipped: Array
    bright_signal: Array
    bright_variance: Array
    dark_dn_per_s: float
    black_dn: float
    dark_variance_dn2: float

    @property
    def saturation(self) -> tuple[float, float]:
        """The signal where all pixels are full, else that of the greatest variance; the step.

        Between two exposures the latter, EMVA 1288's saturation point, may be higher by their
        step.
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

    def figures(self) -> dict[str, float]:
        """Return the quantities of `SensorSheet` that follow from the curve."""
        dark = self.dark_variance_dn2
        saturation, _ = self.saturation
        if saturation < BRIGHTER_DEVIATIONS * np.sqrt(dark):
            raise CalibrationError("the flats are no brighter than the dark: is the lamp on?")
        below = (self.bright_signal <= FIT_SHARE * saturation) & (self.signal > 0)
        if below.sum() < 3:
            raise CalibrationError(
                "fewer than three flats lie below 70 % of saturation: add shorter exposures"
            )
        # The dark point anchors the line.
        x, y = np.append(self.signal[below], 0.0), np.append(self.variance[below], dark)
        expected = y
        for _ in range(2):
            # By the measured variance a level that is low by chance would count more.
            gain, zero = _fit_line(x, y, 1 / np.maximum(expected, 1e-9) ** 2)
            expected = gain * x + zero
        if gain <= 0:
            raise CalibrationError(
                "the variance does not grow with the light: are these frames as the sensor gave "
                "them?"
            )
        read_dn = np.sqrt(max(dark - QUANTISATION_DN2, 0))
        if dark < QUANTISED_DN2:
            read_dn = QUANTISED_DN
        well, read = saturation / gain, read_dn / gain
        least = np.sqrt(read**2 + QUANTISATION_DN2 / gain**2) + 0.5
        residual = self.linearity()
        return {
            "gain_dn_per_electron": gain,
            "read_noise_electrons": float(read),
            "dark_current_electrons_per_s": self.dark_dn_per_s / gain,
            "black_level_dn": self.black_dn,
            "dark_variance_dn2": dark,
            "full_well_electrons": well,
            "saturation_dn": saturation,
            "linearity_error_percent": float((np.nanmax(residual) - np.nanmin(residual)) / 2),
            "snr_max_db": float(10 * np.log10(max(well, 1e-9))),
            "dynamic_range_db": float(20 * np.log10(max(well / least, 1e-9))),
        }

    def linearity(self) -> Array:
        """Return deviations from the line through 5 to 95 % of saturation, percent; NaN outside."""
        residual = np.full(self.signal.shape, np.nan)
        low, high = (share * self.saturation[0] for share in LINEAR_RANGE)
        for phase in range(4):
            y, t = self.signal[:, phase], self.exposure_s[:, phase]
            inside = (y >= low) & (self.bright_signal[:, phase] <= high)
            if inside.sum() < 3:
                continue
            slope, zero = _fit_line(t[inside], y[inside], 1 / y[inside] ** 2)
            line = slope * t[inside] + zero
            residual[inside, phase] = 100 * (y[inside] - line) / line
        if np.isnan(residual).all():
            raise CalibrationError(
                "fewer than three flats lie between 5 and 95 % of saturation: add exposures"
            )
        return residual


def _transfer_points(dark: _Levels, flat: _Levels, tiles: Flags, bright: Flags) -> _Points:
    """Return the photon transfer curve of some tiles, (block, tile) flags."""
    means = dark.over(tiles, "mean").mean(axis=1)
    variances = dark.over(tiles, "variance").mean(axis=1)
    slope, black = _fit_line(dark.exposure_s, means, np.ones_like(means))
    _, variance = _fit_line(dark.exposure_s, variances, 1 / np.maximum(variances, 1e-9) ** 2)
    times_s = flat.exposure_s[:, None].repeat(4, axis=1)
    dark_dn = black + slope * times_s
    lit = tiles & bright if (tiles & bright).any() else bright
    return _Points(
        flat.over(tiles, "mean") - dark_dn,
        flat.over(tiles, "variance"),
        times_s,
        np.nanmax(flat.clipped[:, tiles], axis=1),
        flat.over(lit, "mean") - dark_dn,
        flat.over(lit, "variance"),
        slope,
        black,
        max(variance, 1e-9),
    )


def _hot_pixels(longest: Pair) -> Flags:
    """Return pixels whose longest dark frame stands out."""
    mean = (longest.first.astype(np.float64) + longest.second) / 2
    off = mean - np.median(mean)
    return np.abs(off) > HOT_DEVIATIONS * max(deviation_of(off), 0.5)


def _dead_pixels(flat: Pair, dark: Pair) -> Flags:
    """Return pixels that see less than half of what their colour's do."""
    signal = (flat.first.astype(np.float64) + flat.second - dark.first - dark.second) / 2
    dead = np.zeros(signal.shape, dtype=bool)
    for part, below in zip(_phases(signal), _phases(dead), strict=True):
        below[...] = part < DEAD_SHARE * np.median(part)
    return dead


def _nonuniformity(pair: Pair, dark: Pair | None, good: Flags) -> Nonuniformity:
    """Return what differs between pixels, in DN, or with a dark pair as a share of the signal.

    A smooth quadratic is taken out of each phase of each frame first: the lamp's falloff and its
    flicker are not the pixels'.
    """
    rows, columns = (count // 2 * 2 for count in good.shape)
    frames = [pair.first.astype(np.float64), pair.second.astype(np.float64)]
    if dark is not None:
        # A dark of its own each, so that their noise does not vary together.
        frames = [frames[0] - dark.first, frames[1] - dark.second]
    variances, uncertainties = [], []
    planes = (_phases(plane[:rows, :columns]) for plane in (*frames, good))
    for *both, use in zip(*planes, strict=True):
        # Each frame's own surface: the lamp may differ between them.
        surfaces = [_fit_quadratic(plane, use) for plane in both]
        a, b = (
            np.where(use, (plane - smooth) / (smooth if dark is not None else 1.0), 0)
            for plane, smooth in zip(both, surfaces, strict=True)
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

    def of_product(first: Array, second: Array, count: float) -> float:
        both, noise = float(np.mean(first * second)), float(np.mean((first - second) ** 2) / 2)
        return (both**2 + (max(both, 0.0) + noise) ** 2) / count

    # Two phases of the filter share each row and each column.
    lines = [2 * of_product(a.mean(k), b.mean(k), a.shape[1 - k]) for k in (0, 1)]
    return of_product(a, b, count) + sum(lines)


def _fit_quadratic(values: Array, use: Flags) -> Array:
    """Return the quadratic surface through the pixels to use, (y, x)."""
    y, x = (np.linspace(-1, 1, count) for count in values.shape)
    yy, xx = np.meshgrid(y, x, indexing="ij")
    terms = np.stack([np.ones_like(xx), xx, yy, xx * xx, xx * yy, yy * yy], axis=-1)
    basis = terms[use]
    found = np.linalg.solve(basis.T @ basis, basis.T @ values[use])
    return terms @ found

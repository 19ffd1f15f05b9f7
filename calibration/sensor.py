"""What the sensor does to light: the linear model of EMVA 1288 from dark and flat frames.

Two frames per exposure give mean and temporal variance, see `sensor_levels`. Their line, variance
against signal, is the photon transfer curve:

    variance = dark variance + K signal + step^2 / 12,

its slope is the gain K in DN per electron, step: of the converter. Every figure's deviation is a
jackknife over BLOCKS groups of rows, and what effects outside the model leave open, see
`sensor_effects`. Under a colour filter each of its 2 x 2 phases has its own level; all lie on one
curve. Where light falls off to the corners, saturation is read where it is brightest.

What differs from pixel to pixel is separated from noise by the covariance of the two frames.

Source: EMVA Standard 1288, release 4.0, linear (sections 2 to 8).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import QUANTISATION, hot_pixels, step_of_values
from emmc_rig.calibration.robust import deviation_of
from emmc_rig.calibration.sensor_effects import (
    Effect,
    bend_of_curve,
    bend_of_response,
    black_drift_dn,
    by_blocks,
    carried_charge,
    combined,
    lag_and_creep,
    shared_charge,
)
from emmc_rig.calibration.sensor_levels import (
    BLOCKS,
    PHASES,
    TILES,
    Flags,
    Levels,
    Pair,
    measure_pair,
    phases_of,
    stacked,
)

Array = NDArray[np.floating]
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
LEAST_VARIANCE, LEAST_NOISE = 0.24, 0.40
"""In squares of the step, and steps: a variance below the first is that of the steps, and the noise
is below the second (EMVA 1288, 6.7)."""
LEAST_WIDE = 0.01
"""Share of the pixels that change by two steps: of noise of 0.4 steps as many do at least. Less
noise midway between two values has a variance of 0.25 squared steps."""
BRIGHTER_DEVIATIONS = 10.0
"""Of the dark's noise, by which flats at saturation are brighter at least."""
EVERY = np.ones((BLOCKS, TILES), dtype=bool)
DEAD_SHARE = 0.5
"""Of the median of a pixel's colour, below which it is dead."""
DEAD_DEVIATIONS = 6.0
"""Robust ones of a colour's pixels, below its median: noise is no dead pixel in a dim flat."""
CODED_STEPS, CODED_VARIANCE = 1.5, 0.01
"""Of the dark's step, and of the variance: a flat's larger step and its rounding show a code."""
NOTABLE_BEND, NOTABLE_LAG = 0.01, 0.001
"""From which on figures are marked; a smaller bend or lag only makes them less sure."""
LEAST_SURE_LAG = 0.005
"""Deviation of a lag, up to which it counts: a flickering lamp and few pixels show none."""


@dataclass(frozen=True, eq=False)
class TransferCurve:
    """The photon transfer curve of all rows: signal above the dark, variance, exposure.

    variance_dn2: without the converter's rounding and the dark current's noise.
    """

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
        # Three deviations of the root reach as far as three of the variance, on either side.
        low, high = (np.sqrt(max(self.variance + reach * sure, 0.0)) for reach in (-3, 3))
        return scale * value, scale * float(max(value - low, high - value)) / 3


class SheetRow(NamedTuple):
    """A quantity in its unit; deviation: the standard one, None of counts and bounds."""

    quantity: str
    value: float
    deviation: float | None
    unit: str
    remark: str

    @property
    def title(self) -> str:
        """The quantity with its remark."""
        return f"{self.quantity}, {self.remark}" if self.remark else self.quantity


class Remark(NamedTuple):
    """A limit of some quantities, by their names: a bound, or an effect outside the model."""

    names: tuple[str, ...]
    words: str


@dataclass(frozen=True, eq=False)
class SensorSheet:
    """The EMVA 1288 quantities; `deviations` by their names.

    linearity_residual: percent, per point of the curve. good: (y, x), neither hot nor dead. dsnu,
    prnu: in DN and as shares. step_dn: between the values of the darks. remarks: which quantities
    are bounds, or measured although the sensor departs from the linear model.
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
    step_dn: float
    deviations: dict[str, float] = field(default_factory=dict)
    remarks: tuple[Remark, ...] = ()

    def remark(self, name: str) -> str:
        """Return the remarks on a quantity, "dsnu" or "prnu", in words; empty where none is."""
        return "; ".join(remark.words for remark in self.remarks if name in remark.names)

    def between_pixels(self, name: str) -> float:
        """Return "dsnu" in electrons or "prnu" as a share."""
        if name == "prnu":
            return self.prnu.figure(1.0)[0]
        value = self.dsnu.figure(1 / self.gain_dn_per_electron)[0]
        if self.remark(name).startswith(BELOW_STEPS):
            return max(value, LEAST_NOISE * self.step_dn / self.gain_dn_per_electron)
        return value

    def rows(self) -> list[SheetRow]:
        """Return the quantities as rows of a table."""
        found = []
        for name, (quantity, unit) in QUANTITIES.items():
            value = self.between_pixels(name) if name in PATTERNS else float(getattr(self, name))
            remark, deviation = self.remark(name), self.deviations.get(name) or None
            if name == "prnu":
                value, deviation = 100 * value, deviation and 100 * deviation
            if remark.startswith(BELOW_STEPS):
                deviation = None
            found.append(SheetRow(quantity, value, deviation, unit, remark))
        return found


QUANTITIES = {
    "gain_dn_per_electron": ("Overall system gain K", "DN/e"),
    "step_dn": ("Step between values", "DN"),
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
    "dsnu": ("DSNU", "e"),
    "prnu": ("PRNU", "%"),
}
OF_DARK = ("read_noise_electrons", "dark_current_electrons_per_s", "dsnu")
OF_SATURATION = ("full_well_electrons", "saturation_dn", "snr_max_db", "dynamic_range_db")
OF_GAIN = (
    "gain_dn_per_electron", "read_noise_electrons", "dark_current_electrons_per_s",
    "full_well_electrons", "snr_max_db", "dynamic_range_db", "dsnu", "prnu",
)  # fmt: skip
PATTERNS = ("dsnu", "prnu")
BELOW_STEPS = "at most"


class _Line(NamedTuple):
    """A weighted line; lever: (n,), what the slope gains from a unit more of each value."""

    slope: float
    intercept: float
    lever: Array


def _fit_line(x: Array, y: Array, weight: Array) -> _Line:
    total = weight.sum()
    mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
    lever = weight * (x - mean_x) / (weight * (x - mean_x) ** 2).sum()
    slope = float((lever * (y - mean_y)).sum())
    return _Line(slope, float(mean_y - slope * mean_x), lever)


def characterise(
    darks: Sequence[Pair], flats: Iterable[Pair], white_level_dn: int, monochrome: bool = False
) -> SensorSheet:
    """Return the sensor's figures from pairs of dark and of evenly lit frames.

    darks: at two exposures or more, for the dark current. flats: from dim to saturated, in the
    order taken, at least four below saturation; few pairs are held at a time. monochrome: no
    colour filters: PRNU includes even and odd columns and rows. Raises
    CalibrationError for too few exposures, flats no brighter than the dark, noise below the steps
    of the converter in the light too, and sizes that differ.
    """
    darks = sorted(darks, key=lambda pair: pair.exposure_s)
    if len({pair.exposure_s for pair in darks}) < 2:
        raise CalibrationError("the dark current needs two darks at each of two exposures at least")
    flats = iter(flats)
    dimmest = list(islice(flats, 1))
    step_dn = _step_dn([*darks, *dimmest])
    longest = (darks[-1].first.astype(np.float64) + darks[-1].second) / 2
    hot = hot_pixels(longest, step_dn)
    # Those dead already in the dimmest flat do not count in any level.
    good = ~hot & ~(_dead_pixels(dimmest[0], darks[0]) if dimmest else hot)
    dark = stacked(measure_pair(pair, good, white_level_dn, lit=False) for pair in darks)
    flat, unsaturated, carried = _read_flats(chain(dimmest, flats), good, white_level_dn, darks[0])
    flat = flat._replace(step_dn=np.where(np.isnan(flat.step_dn), step_dn, flat.step_dn))
    brightest_dn, light, brightest = unsaturated[-1]
    dead = _dead_pixels(brightest, darks[0])
    good &= ~dead
    light = light - dark.over(EVERY, "mean").mean(axis=1).min()
    share = np.nanmean(light / np.nanmax(light, axis=(0, 1)), axis=2)
    frames = _Frames(dark, flat, share >= BRIGHTEST_SHARE * np.nanmax(share), step_dn, good)
    points = frames.points(EVERY)
    points.figures(0.0)  # refuses flats that show no light
    effects = _effects(frames, points, carried)
    half_dn = points.black_dn + PRNU_SHARE * (brightest_dn - points.black_dn)
    lit = min(unsaturated, key=lambda held: abs(held[0] - half_dn))[2]
    dsnu = _nonuniformity(darks[0], None, good, phases_alike=True)
    prnu = _nonuniformity(lit, darks[0], good, phases_alike=monochrome)
    bounds = _bounds(frames, points, darks[0], dsnu)
    return SensorSheet(
        **points.figures(effects.shared.correction),
        exposures=len(flat.exposure_s),
        dsnu=dsnu,
        prnu=prnu,
        hot_pixels=int(hot.sum()),
        dead_pixels=int(dead.sum()),
        curve=TransferCurve(
            points.signal.ravel(), points.variance.ravel(), points.exposure_s.ravel()
        ),
        linearity_residual=points.linearity().ravel(),
        good=good,
        step_dn=step_dn,
        deviations=_deviations(frames, points, effects, dsnu, prnu),
        remarks=tuple(bounds + _departures(effects)),
    )


def _step_dn(pairs: Iterable[Pair]) -> float:
    """Return the step between values; 1 DN where all pixels of every pair read alike."""
    steps = [step_of_values((pair.first, pair.second)) for pair in pairs]
    return min((step for step in steps if not np.isnan(step)), default=1.0)


def _read_flats(
    flats: Iterable[Pair], good: Flags, white_level_dn: int, dark: Pair
) -> tuple[Levels, list[tuple[float, Array, Pair]], dict[int, Array]]:
    """Return the flats' levels, those bright and unsaturated, and what their noise carries over.

    The second as (mean in DN, by tile, pair); the last of every two pairs, by the brighter one's
    number, see `carried_charge`.
    """
    carried: dict[int, Array] = {}
    single: Pair | None = None
    levels: list[Levels] = []
    unsaturated: list[tuple[float, Array, Pair]] = []
    loudest = 0.0
    for pair in flats:
        level = measure_pair(pair, good, white_level_dn, lit=True)
        levels.append(level)
        # A phase that saturates loses its variance.
        quietest = float(np.nanmean(level.variance, axis=(0, 1)).min())
        if np.nanmax(level.clipped) < CLIPPED_SHARE and quietest > loudest:
            mean, loudest = float(np.nanmean(level.mean, axis=(0, 1)).mean()), quietest
            unsaturated = [held for held in unsaturated if held[0] > HELD_SHARE * mean]
            unsaturated.append((mean, level.mean, pair))
            if single is not None:
                carried[len(levels) - 1] = carried_charge(single, pair, dark, good)
            single = pair if single is None else None
    if len(levels) < 4 or not unsaturated:
        raise CalibrationError(
            f"{len(levels)} flat exposures: the photon transfer curve needs four at least, and "
            "some below saturation"
        )
    return stacked(levels), unsaturated, carried


@dataclass(frozen=True, eq=False)
class _Frames:
    """Levels of all pairs; bright: (block, tile), the brightest tiles, which show saturation."""

    dark: Levels
    flat: Levels
    bright: Flags
    step_dn: float
    good: Flags

    def points(self, tiles: Flags) -> _Points:
        """Return the photon transfer curve of some tiles, (block, tile) flags."""
        dark, flat, bright = self.dark, self.flat, self.bright
        means = dark.over(tiles, "mean").mean(axis=1)
        variances = dark.over(tiles, "variance").mean(axis=1)
        current, black, _ = _fit_line(dark.exposure_s, means, np.ones_like(means))
        of_current, dark_variance, _ = _fit_line(
            dark.exposure_s, variances, 1 / np.maximum(variances, 1e-9) ** 2
        )
        times_s = flat.exposure_s[:, None].repeat(PHASES, axis=1)
        dark_dn = black + current * times_s
        # What is no noise of the light: rounding, and the dark current's electrons.
        other_dn2 = QUANTISATION * flat.step_dn[:, None] ** 2 + max(of_current, 0.0) * times_s
        variance = flat.over(tiles, "variance")
        lit = tiles & bright if (tiles & bright).any() else bright
        return _Points(
            signal=flat.over(tiles, "mean") - dark_dn,
            variance=variance - other_dn2,
            exposure_s=times_s,
            clipped=np.nanmax(flat.clipped[:, tiles], axis=1),
            above_steps=_above_steps(variance, flat.step_dn[:, None], flat.over(tiles, "wide")),
            bright_signal=flat.over(lit, "mean") - dark_dn,
            bright_variance=flat.over(lit, "variance") - other_dn2,
            pixels=float(self.good.sum()) / PHASES,
            dark_dn_per_s=current,
            black_dn=black,
            dark_variance_dn2=max(dark_variance, 1e-9),
            step_dn=self.step_dn,
            below_steps=not _above_steps(
                dark_variance, self.step_dn, dark.over(tiles, "wide")[0].mean()
            ),
        )


def _above_steps(variance: ArrayLike, step_dn: ArrayLike, wide: ArrayLike) -> Flags:
    """Return where the noise is wide enough for its variance to come through the rounding."""
    above = np.asarray(variance) >= LEAST_VARIANCE * np.square(step_dn)
    return above & (np.asarray(wide) >= LEAST_WIDE)


@dataclass(frozen=True, eq=False)
class _Points:
    """The photon transfer curve: of the flats all (level, phase).

    variance: without rounding and the noise of the dark current. above_steps: the noise is wider
    than rounding hides. bright_signal, bright_variance: of the brightest tiles. pixels: of a phase.
    dark_dn_per_s, black_dn: slope and start of the dark signal. dark_variance_dn2: at no exposure,
    with rounding. below_steps: the dark's noise is less than the steps of the converter show.
    """

    signal: Array
    variance: Array
    exposure_s: Array
    clipped: Array
    above_steps: Flags
    bright_signal: Array
    bright_variance: Array
    pixels: float
    dark_dn_per_s: float
    black_dn: float
    dark_variance_dn2: float
    step_dn: float
    below_steps: bool

    @property
    def saturation(self) -> tuple[float, float]:
        """The signal where all pixels are full, else that of the greatest variance; the step.

        Between two exposures the latter, EMVA 1288's saturation point, may be higher by their
        step.
        """
        full_dn, loudest_dn = [], []
        for phase in range(PHASES):
            signal, variance = self.bright_signal[:, phase], self.bright_variance[:, phase]
            free = np.where(self.clipped[:, phase] < CLIPPED_SHARE, variance, 0)
            loudest = int(np.argmax(free))
            full = (signal > signal[loudest]) & (variance < COLLAPSED_SHARE * free[loudest])
            brighter = signal[signal > signal[loudest]]
            if full.any():
                # Of longer exposures the dark current fills more.
                shortest = np.where(full, self.exposure_s[:, phase], np.inf).argmin()
                full_dn.append(float(signal[shortest]))
            step = brighter.min() - signal[loudest] if brighter.size else 0.0
            loudest_dn.append((float(signal[loudest]), float(step)))
        return (float(np.mean(full_dn)), 0.0) if full_dn else max(loudest_dn)

    @property
    def dark_noise_dn2(self) -> float:
        """The dark's temporal variance without rounding; the middle of what is possible below."""
        if self.below_steps:
            return LEAST_NOISE**2 * self.step_dn**2 / 2
        return self.dark_variance_dn2 - QUANTISATION * self.step_dn**2

    @property
    def fitted(self) -> Flags:
        """The levels to which the gain is fitted, (level, phase)."""
        dim = self.bright_signal <= FIT_SHARE * self.saturation[0]
        return dim & (self.signal > 0) & self.above_steps

    def transfer(self) -> _Line:
        """Return the line of variance against signal, anchored at the dark.

        A variance of n pixels is sure to 2 variance^2 / n, that of the dark below the steps to
        what it may be at all.
        """
        below = self.fitted
        if below.sum() < 3:
            raise CalibrationError(
                "fewer than three flats lie below 70 % of saturation with noise above the steps "
                f"of the converter ({self.step_dn:g} DN): add shorter exposures, or raise the "
                "camera's gain"
            )
        anchor = self.dark_noise_dn2
        x, y = np.append(self.signal[below], 0.0), np.append(self.variance[below], anchor)
        # Evenly distributed between 0 and twice the middle.
        known_dn4 = np.append(np.zeros(below.sum()), anchor**2 / 3 if self.below_steps else 0.0)
        expected = np.maximum(y, anchor)
        for _ in range(3):
            # By the measured variance a level that is low by chance would count more.
            rounded = expected + QUANTISATION * self.step_dn**2
            line = _fit_line(x, y, 1 / (2 * rounded**2 / self.pixels + known_dn4))
            expected = np.maximum(line.slope * x + line.intercept, 1e-9)
        if line.slope <= 0:
            raise CalibrationError(
                "the variance does not grow with the light: are these frames as the sensor gave "
                "them?"
            )
        return line

    def figures(self, shared: float) -> dict[str, float]:
        """Return the quantities of `SensorSheet` that follow from the curve.

        shared: by how much of its variance a pixel's noise varies with its neighbours' noise.
        """
        saturation, _ = self.saturation
        if saturation < BRIGHTER_DEVIATIONS * np.sqrt(self.dark_variance_dn2):
            raise CalibrationError("the flats are no brighter than the dark: is the lamp on?")
        gain = self.transfer().slope * (1 + shared)
        read_dn = np.sqrt(max(self.dark_noise_dn2, 0.0))
        if self.below_steps:
            read_dn = LEAST_NOISE * self.step_dn
        well, read = saturation / gain, read_dn / gain
        least = np.sqrt(read**2 + QUANTISATION * (self.step_dn / gain) ** 2) + 0.5
        residual = self.linearity()
        return {
            "gain_dn_per_electron": gain,
            "read_noise_electrons": float(read),
            "dark_current_electrons_per_s": self.dark_dn_per_s / gain,
            "black_level_dn": self.black_dn,
            "dark_variance_dn2": self.dark_noise_dn2,
            "full_well_electrons": well,
            "saturation_dn": saturation,
            "linearity_error_percent": float((np.nanmax(residual) - np.nanmin(residual)) / 2),
            "snr_max_db": float(10 * np.log10(max(well, 1e-9))),
            "dynamic_range_db": float(20 * np.log10(max(well / least, 1e-9))),
        }

    @property
    def linear(self) -> Flags:
        """The levels at which the response is to be linear, (level, phase)."""
        low, high = (share * self.saturation[0] for share in LINEAR_RANGE)
        return (self.signal >= low) & (self.bright_signal <= high)

    def linearity(self) -> Array:
        """Return deviations from the line through 5 to 95 % of saturation, percent; NaN outside."""
        residual = np.full(self.signal.shape, np.nan)
        for phase, inside in enumerate(self.linear.T):
            if inside.sum() < 3:
                continue
            y, t = self.signal[inside, phase], self.exposure_s[inside, phase]
            slope, zero, _ = _fit_line(t, y, 1 / y**2)
            line = slope * t + zero
            residual[inside, phase] = 100 * (y - line) / line
        if np.isnan(residual).all():
            raise CalibrationError(
                "fewer than three flats lie between 5 and 95 % of saturation: add exposures"
            )
        return residual

    def bend_of_variance(self) -> Effect:
        """Return the relative loss of signal at saturation, by the bend of the transfer curve.

        Of signal = s (1 - loss s / top) the variance is K s (1 - 2 loss s / top)^2 + dark, nearly
        K signal (1 - 3 loss signal / top) + dark.
        """
        below, line = self.fitted, self.transfer()
        x, y = np.append(self.signal[below], 0.0), np.append(self.variance[below], 0.0)
        y[-1] = self.dark_noise_dn2
        deviation = np.maximum(line.slope * x + line.intercept, 1e-9) * np.sqrt(2 / self.pixels)
        if self.below_steps:
            deviation[-1] = np.hypot(deviation[-1], self.dark_noise_dn2)
        return bend_of_curve(x, y, deviation, self.saturation[0])


class _Effects(NamedTuple):
    """Effects outside the linear model, and the steps of a file's lossy code.

    drift: DN, from frame to frame. creep: DN per frame. bend: relative, at saturation, by response
    and noise. scatter: percent, of the linearity's points about a smooth curve. coded: the steps
    of the brightest flats in DN, 0 where they are those of the dark.
    """

    drift: Effect
    lag: Effect
    creep: Effect
    shared: Effect
    bend: Effect
    bends: bool
    scatter: float
    coded: float


def _effects(frames: _Frames, points: _Points, carried: dict[int, Array]) -> _Effects:
    """Return the effects that the frames show; carried: see `_read_flats`."""
    dim = points.bright_signal <= LINEAR_RANGE[1] * points.saturation[0]
    clear: Flags = np.logical_and.reduce((points.clipped < CLIPPED_SHARE) & dim, axis=1)
    lag, creep = lag_and_creep(frames.flat, points.signal.mean(axis=1), clear)
    of_noise = by_blocks([shares for number, shares in carried.items() if clear[number]])
    in_light = points.fitted.all(axis=1) & (
        points.variance.min(axis=1) > BRIGHTER_DEVIATIONS * points.dark_noise_dn2
    )
    shared = shared_charge(frames.flat, frames.dark, in_light)
    of_response, scatter = _bend_of_response(points)
    of_variance = points.bend_of_variance()
    return _Effects(
        drift=black_drift_dn(frames.dark),
        lag=combined([lag, of_noise]),
        creep=creep,
        shared=shared,
        bend=combined([of_response, of_variance]),
        bends=of_response.significant or of_variance.significant,
        scatter=scatter,
        coded=_coded_step_dn(frames, points, clear),
    )


def _bend_of_response(points: _Points) -> tuple[Effect, float]:
    """Return the bend of the response, and in percent the scatter of the signals about it.

    About a straight response where the bend is not significant.
    """
    bends, scatters = [], []
    for phase, inside in enumerate(points.linear.T):
        y, t = points.signal[inside, phase], points.exposure_s[inside, phase]
        bend, scatter = bend_of_response(t, y, points.saturation[0])
        if not bend.significant and len(t) > 2:
            squares = np.nansum(np.square(points.linearity()[:, phase]))
            scatter = np.sqrt(squares / (len(t) - 2)) / 100
        bends.append(bend)
        scatters.append(100 * float(scatter))
    # The phases share the lamp's flicker: their mean is no surer than each phase.
    size, deviation = (
        float(np.mean([getattr(bend, name) for bend in bends])) for name in ("size", "deviation")
    )
    return Effect(size, deviation, min(bend.freedom for bend in bends)), max(scatters)


def _coded_step_dn(frames: _Frames, points: _Points, clear: Flags) -> float:
    """Return the largest step of flats whose values a code made coarser than the dark's; or 0."""
    steps = frames.flat.step_dn
    variance = np.maximum(frames.flat.over(EVERY, "variance").min(axis=1), 1e-9)
    coarse = clear & (steps > CODED_STEPS * points.step_dn)
    coarse &= QUANTISATION * steps**2 > CODED_VARIANCE * variance
    return float(steps[coarse].max(initial=0.0))


def _deviations(
    frames: _Frames, points: _Points, effects: _Effects, dsnu: Nonuniformity, prnu: Nonuniformity
) -> dict[str, float]:
    """Return the figures' deviations: a jackknife over blocks of rows, and common errors.

    All blocks share the rounding, the black level's drift, the steps between exposures at
    saturation, and what the effects leave open of the gain.
    """
    shared = effects.shared.correction
    without = []
    for block in range(BLOCKS):
        tiles = EVERY.copy()
        tiles[block] = False
        without.append(frames.points(tiles).figures(shared))
    factor = (BLOCKS - 1) / np.sqrt(BLOCKS)
    found = {
        name: float(factor * np.std([figures[name] for figures in without])) for name in without[0]
    }
    figures = points.figures(shared)
    gain, well = figures["gain_dn_per_electron"], figures["full_well_electrons"]
    read_dn = figures["read_noise_electrons"] * gain

    def add(name: str, deviation: float) -> None:
        found[name] = float(np.hypot(found[name], deviation))

    of_mean_dn, of_variance_dn2 = _rounding(points)
    darks, span_s = len(frames.dark.exposure_s), float(np.ptp(frames.dark.exposure_s))
    for error_dn in (of_mean_dn, effects.drift.left_open):
        add("black_level_dn", error_dn)
        add("dark_current_electrons_per_s", error_dn / span_s / gain)
        add("saturation_dn", error_dn)
    # Drift of one sign adds up till the last flat, even the drift that noise hides.
    add("saturation_dn", 2 * len(frames.flat.exposure_s) * effects.drift.size)
    add("read_noise_electrons", of_variance_dn2 / (2 * max(read_dn, 1e-9)) / gain)
    saturation_dn, step_dn = points.saturation
    add("saturation_dn", step_dn / np.sqrt(3))
    add("linearity_error_percent", effects.scatter)
    relative = _open_of_gain(points, effects, darks)
    for name in ("gain_dn_per_electron", "read_noise_electrons", "dark_current_electrons_per_s"):
        add(name, relative * figures[name])
    of_gain = found["gain_dn_per_electron"] / gain
    # Shared charge and a bent response make the pixels' differences smaller.
    of_response = np.hypot(effects.shared.left_open / 2, PRNU_SHARE * effects.bend.left_open)
    for name, pattern, scale, open_part in (
        ("dsnu", dsnu, 1 / gain, of_gain), ("prnu", prnu, 1.0, of_response)
    ):  # fmt: skip
        value, deviation = pattern.figure(scale)
        found[name] = float(np.hypot(deviation, value * open_part))
    of_well = float(np.hypot(found["saturation_dn"] / saturation_dn, relative))
    add("full_well_electrons", well * of_well)
    add("snr_max_db", 10 / np.log(10) * of_well)
    of_read = found["read_noise_electrons"] / max(read_dn / gain, 1e-9)
    add("dynamic_range_db", 20 / np.log(10) * float(np.hypot(of_well, of_read)))
    return found


def _rounding(points: _Points) -> tuple[float, float]:
    """Return what rounding may do to the dark's mean and variance, DN and DN^2, as deviations.

    Of normal noise of s steps about a place between two values that is not known:

        mean:      step / pi exp(-2 pi^2 s^2) sin(place)
        variance:  step^2 (4 s^2 + 1 / pi^2) exp(-2 pi^2 s^2) cos(place), beyond step^2 / 12.
    """
    steps2 = 0.0 if points.below_steps else points.dark_noise_dn2 / points.step_dn**2
    left = np.exp(-2 * np.pi**2 * steps2) / np.sqrt(2)
    of_variance = points.step_dn**2 * (4 * steps2 + 1 / np.pi**2) * left
    return float(points.step_dn / np.pi * left), float(of_variance)


def _open_of_gain(points: _Points, effects: _Effects, darks: int) -> float:
    """Return the relative deviation of the gain by the effects outside the model."""
    line, below = points.transfer(), points.fitted
    lever = np.zeros(below.shape)
    lever[below] = line.lever[:-1]
    # A signal that is too large by d is as a variance too small by K d.
    by_level = lever.sum(axis=1)
    of_drift = effects.drift.left_open * np.hypot(
        np.sqrt(np.sum(by_level**2) / 2), by_level.sum() / np.sqrt(2 * darks)
    )
    loss = 3 / points.saturation[0] * float(np.sum(lever * points.signal**2))
    shared, lag = effects.shared, effects.lag
    of_shared = shared.deviation if shared.significant else shared.left_open
    # The noise of two frames that share a little of their charge differs by less than K s, by the
    # share of each and their covariance.
    of_lag = 3 * lag.left_open if lag.deviation < LEAST_SURE_LAG else 0.0
    parts = (of_drift, of_shared, of_lag, loss * effects.bend.left_open)
    return float(np.sqrt(np.sum(np.square(parts))))


def _bounds(frames: _Frames, points: _Points, shortest: Pair, dsnu: Nonuniformity) -> list[Remark]:
    """Return which quantities are bounds: by flats below saturation, clipped black, steps."""
    flat, last = frames.flat, int(np.argmax(frames.flat.exposure_s))
    variance = flat.over(frames.bright, "variance")
    fell = variance[last] < FALLEN_SHARE * variance.max(axis=0)
    found = []
    if np.nanmax(flat.clipped[last]) < CLIPPED_SHARE and not fell.any():
        found.append(Remark(OF_SATURATION, "at least"))
    clipped = np.mean([np.mean(frame == 0) for frame in (shortest.first, shortest.second)])
    if clipped > CLIPPED_BLACK:
        why = "(the darks are clipped at 0 DN: raise the camera's black level)"
        found.append(Remark((*OF_DARK, "saturation_dn"), f"at least {why}"))
        found.append(Remark(("black_level_dn", "dynamic_range_db"), f"at most {why}"))
    elif points.below_steps:
        names = ["read_noise_electrons"]
        if dsnu.figure(1.0)[0] < points.step_dn:
            names.append("dsnu")
        words = f"{BELOW_STEPS} (below the steps of the converter: raise the camera's gain)"
        found.append(Remark(tuple(names), words))
        words = "at least (the dark noise is below the steps of the converter)"
        found.append(Remark(("dynamic_range_db",), words))
    return found


def _departures(effects: _Effects) -> list[Remark]:
    """Return the effects that the standard excludes, and the quantities that each changes."""
    found = []
    drift, lag, creep, bend = effects.drift, effects.lag, effects.creep, effects.bend
    unsteady = "let the camera warm up, wait after bright frames, no automatic black level"
    if drift.significant:
        words = f"the black level moves by {drift.size:.2g} DN between frames: {unsteady}"
        found.append(Remark(("black_level_dn", "dark_current_electrons_per_s"), words))
    if creep.significant:
        words = f"the black level creeps by {creep.size:.2g} DN a frame: {unsteady}"
        names = "saturation_dn", "linearity_error_percent", "black_level_dn"
        found.append(Remark((*OF_GAIN, *names), words))
    if lag.significant and abs(lag.size) > NOTABLE_LAG:
        words = f"frames show {lag.size:.2%} of the frame before: wait between frames"
        found.append(Remark((*OF_GAIN, "linearity_error_percent"), words))
    if effects.bends and abs(bend.size) > NOTABLE_BEND:
        words = (
            f"the response, or its noise, bends by {abs(bend.size):.1%} at saturation: no linear "
            "sensor, or the lamp changed during the exposures"
        )
        found.append(Remark(OF_GAIN, words))
    if effects.coded:
        words = (
            f"the values' steps grow to {effects.coded:.3g} DN with the light: save the frames "
            "without lossy compression"
        )
        names = "saturation_dn", "linearity_error_percent", "black_level_dn"
        found.append(Remark((*OF_GAIN, *names), words))
    if effects.shared.significant:
        words = (
            f"corrected for {effects.shared.size:.1%} of the noise that neighbouring pixels share"
        )
        found.append(Remark((*OF_GAIN, "hot_pixels"), words))
    return found


def _dead_pixels(flat: Pair, dark: Pair) -> Flags:
    """Return pixels that see less than half of what their colour's do, and more than noise does."""
    if flat.first.shape != dark.first.shape:  # refused where its levels are measured
        return np.zeros(dark.first.shape, dtype=bool)
    signal = (flat.first.astype(np.float64) + flat.second - dark.first - dark.second) / 2
    dead = np.zeros(signal.shape, dtype=bool)
    for part, below in zip(phases_of(signal), phases_of(dead), strict=True):
        middle = float(np.median(part))
        noise = DEAD_DEVIATIONS * deviation_of(part - middle)
        below[...] = part < min(DEAD_SHARE * middle, middle - noise)
    return dead


def _nonuniformity(pair: Pair, dark: Pair | None, good: Flags, phases_alike: bool) -> Nonuniformity:
    """Return what differs between pixels, in DN, or with a dark pair as a share of the signal.

    A smooth quadratic is taken out of each phase of each frame first: the lamp's falloff and its
    flicker are not the pixels'. phases_alike: phases whose means differ are pixels that differ, as
    of even and odd columns; else they have colour filters.
    """
    rows, columns = (count // 2 * 2 for count in good.shape)
    frames = [pair.first.astype(np.float64), pair.second.astype(np.float64)]
    if dark is not None:
        # A dark of its own each, so that their noise does not vary together.
        frames = [frames[0] - dark.first, frames[1] - dark.second]
    variances, uncertainties, means = [], [], []
    planes = (phases_of(plane[:rows, :columns]) for plane in (*frames, good))
    for *both, use in zip(*planes, strict=True):
        # Each frame's own surface: the lamp may differ between them.
        surfaces = [_fit_quadratic(plane, use) for plane in both]
        a, b = (
            np.where(use, (plane - smooth) / (smooth if dark is not None else 1.0), 0)
            for plane, smooth in zip(both, surfaces, strict=True)
        )
        means.append([float(smooth.mean()) for smooth in surfaces])
        variances.append(float(np.sum(a * b) / use.sum()))
        uncertainties.append(_uncertainty(a, b, float(use.sum())))
    variance, uncertainty = float(np.mean(variances)), float(np.sum(uncertainties)) / PHASES**2
    if phases_alike:
        of_phase = np.array(means)
        middle = of_phase.mean(axis=0)
        of_phase = (of_phase - middle) / (middle if dark is not None else 1.0)
        variance += float(np.mean(of_phase[:, 0] * of_phase[:, 1]))
    return Nonuniformity(variance, uncertainty)


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

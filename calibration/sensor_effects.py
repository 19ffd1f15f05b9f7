"""Effects that the linear model of EMVA 1288 excludes, measured from the levels of sensor frames.

The standard demands a stable black level, frames independent of each other, a linear response, and
noise that is independent from pixel to pixel. Each effect has a size with its deviation. A
significant effect is named; an effect that noise could hide adds to the deviations of the figures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from emmc_rig.calibration.sensor_levels import (
    BLOCKS,
    Flags,
    Levels,
    Pair,
    phases_of,
    tiles_of,
)

Array = NDArray[np.floating]
CHANCE = 1e-4
"""That noise alone looks as significant: one sheet in thousands names an effect that is not."""
FEWEST_PAIRS = 7
"""Of flats that show lag: three parameters are fitted to their changes."""
FEWEST_EXPOSURES = 5
"""That show how a response bends: three parameters are fitted."""


@dataclass(frozen=True)
class Effect:
    """The size of an effect, 0 where there is none; freedom: degrees of, of its deviation."""

    size: float
    deviation: float
    freedom: int

    @property
    def significant(self) -> bool:
        """Whether noise alone is less likely than CHANCE to be as large."""
        if self.freedom < 1 or self.deviation <= 0:
            return False
        return bool(2 * stdtr(self.freedom, -abs(self.size) / self.deviation) < CHANCE)

    @property
    def correction(self) -> float:
        """The size to correct for: none without significance."""
        return self.size if self.significant else 0.0

    @property
    def left_open(self) -> float:
        """How large the effect may be: its size; without significance, beyond the deviation."""
        if self.significant:
            return abs(self.size)
        return float(np.sqrt(max(self.size**2 - self.deviation**2, 0.0)))


NONE = Effect(0.0, 0.0, 0)


def black_drift_dn(dark: Levels) -> Effect:
    """Return the standard deviation of the black level from frame to frame, DN.

        drift^2 = <(second mean - first mean)^2> / 2, with the noise of the means in it.

    The noise is estimated from blocks of rows, so that flicker of whole rows counts.
    """
    blocks = np.nanmean(dark.change, axis=(2, 3))
    drift2 = np.mean(blocks.mean(axis=1) ** 2) / 2
    noise2 = np.mean(blocks.var(axis=1, ddof=1)) / BLOCKS / 2
    return Effect(float(np.sqrt(drift2)), float(np.sqrt(noise2)), BLOCKS - 1)


def lag_and_creep(flat: Levels, signal_dn: Array, clear: Flags) -> tuple[Effect, Effect]:
    """Return lag, the share of a frame that the next one shows, and creep, DN per frame.

    The second frame of a pair follows one as bright, the first that of the pair before, darker as
    a rule: signal_dn: (pair,), in the order taken. For each pair that is clear, below saturation:

        change = lag (signal - signal before) + creep + lamp signal + noise,

    noise: the pixels', and the lamp's flicker, in proportion to the signal.
    """
    before = np.append(0.0, signal_dn[:-1])
    usable = clear & (signal_dn > 0)
    count = int(usable.sum())
    if count < FEWEST_PAIRS:
        return NONE, NONE
    blocks = np.nanmean(flat.change, axis=(2, 3))[usable]
    change, noise2 = blocks.mean(axis=1), blocks.var(axis=1, ddof=1) / BLOCKS
    signal = signal_dn[usable]
    terms = np.stack([signal - before[usable], np.ones(count), signal], axis=1)
    flicker2 = 0.0
    for _ in range(20):
        weight = 1 / np.maximum(noise2 + flicker2 * signal**2, 1e-12)
        root = np.sqrt(weight)
        covariance = np.linalg.inv((terms * weight[:, None]).T @ terms)
        fitted = covariance @ (terms * weight[:, None]).T @ change
        scaled = float(np.sum(np.square(root * (change - terms @ fitted)))) / (count - 3)
        # The flicker under which residuals are as large as expected.
        flicker2 = max(flicker2 + (scaled - 1) * float(np.mean(1 / weight / signal**2)) / 2, 0.0)
    deviations = np.sqrt(np.diag(covariance) * max(scaled, 1.0))
    # Without flicker the noise is that of the blocks.
    freedom = count - 3 if flicker2 else count * (BLOCKS - 1)
    lag, creep = (Effect(float(fitted[k]), float(deviations[k]), freedom) for k in (0, 1))
    return lag, creep


def carried_charge(dim: Pair, bright: Pair, dark: Pair, good: Flags) -> Array:
    """Return by which share of its variance the noise of second frames follows the first, (block,).

    With r the ratio of the two pairs' signals, pixels' own response cancels in d = r bright - dim:

        lag = <d_first d_second> / (<d_first^2> + <d_second^2>) * 2,

    of pixels less their tile's mean; from the first frames the first dark is subtracted, whose
    noise is not the second's. This needs no steady lamp, and many pixels.
    """
    products, squares = np.zeros(BLOCKS), np.zeros(BLOCKS)
    both = [
        [frame - black.astype(np.float64) for frame in frames]
        for *frames, black in (
            (dim.first, bright.first, dark.first), (dim.second, bright.second, dark.second)
        )
    ]  # fmt: skip
    planes = map(phases_of, (*both[0], *both[1], good))
    for *frames, use in zip(*planes, strict=True):
        for block, _, part in tiles_of(use.shape):
            values = [frame[part][use[part]] for frame in frames]
            if len(values[0]) < 2 or min(values[1].mean(), values[3].mean()) <= 0:
                continue
            # Each frame's own level: the lamp may flicker.
            first, second = (
                bright_dn * (dim_dn.mean() / bright_dn.mean()) - dim_dn
                for dim_dn, bright_dn in (values[:2], values[2:])
            )
            products[block] += 2 * float(first @ second)
            squares[block] += float(first @ first + second @ second)
    return products / np.maximum(squares, 1e-12)


def by_blocks(shares: list[Array]) -> Effect:
    """Return the mean of shares (block,) of independent pairs, by the scatter of the blocks."""
    if not shares:
        return NONE
    mean = np.mean(shares, axis=0)
    return Effect(float(mean.mean()), float(mean.std(ddof=1)) / np.sqrt(BLOCKS), BLOCKS - 1)


def shared_charge(flat: Levels, dark: Levels, clear: Flags) -> Effect:
    """Return by how much of its variance a pixel's noise varies with its neighbours' noise.

    Where y = k * electrons, with sum k = 1, the variance is gain signal sum k^2, too small, and the
    sum of all covariances is gain signal: the size is their ratio less 1. The four neighbours at
    the sides decide whether it is significant; then those at the corners count too. clear: pairs
    whose noise is the light's.
    """
    if not clear.any():
        return NONE
    ratios = []
    for corners in (0, 1):
        shared = [levels.sides_dn2 + corners * levels.corners_dn2 for levels in (flat, dark)]
        variances = [np.nanmean(levels.variance, axis=(2, 3)) for levels in (flat, dark)]
        of_light, variance = (
            (of_flat - of_dark.mean(axis=0))[clear] for of_flat, of_dark in (shared, variances)
        )
        ratios.append(by_blocks(list(of_light / np.maximum(variance, 1e-12))))
    return ratios[1] if ratios[0].significant else ratios[0]


def bend_of_response(exposure_s: Array, signal: Array, top: float) -> tuple[Effect, float]:
    """Return the relative loss of signal at `top`, and the scatter of the signals about the bend.

        signal = a + b t + c t^2, weighted by 1 / signal^2, and the loss is -c top / b^2,

    (exposure,) each. The scatter is relative; of few exposures, about their mean.
    """
    count = len(signal)
    if count < FEWEST_EXPOSURES:
        return NONE, 0.0
    t = exposure_s / exposure_s.max()
    fitted, covariance, scatter = _fit_parabola(t, signal, signal)
    factor = -top / fitted[1] ** 2
    deviation = abs(factor) * float(np.sqrt(covariance[2, 2])) * scatter
    return Effect(float(factor * fitted[2]), deviation, count - 3), scatter


def bend_of_curve(signal: Array, variance: Array, deviation: Array, top: float) -> Effect:
    """Return the relative loss of signal at `top` that the bend of a transfer curve shows.

    variance = a + b signal + c signal^2, and the loss is -c top / 3 b.
    """
    if len(signal) < FEWEST_EXPOSURES:
        return NONE
    fitted, covariance, scatter = _fit_parabola(signal / top, variance, deviation)
    factor = -1 / (3 * fitted[1])
    spread = abs(factor) * float(np.sqrt(covariance[2, 2])) * max(scatter, 1.0)
    return Effect(float(factor * fitted[2]), spread, len(signal) - 3)


def _fit_parabola(x: Array, y: Array, deviation: Array) -> tuple[Array, Array, float]:
    """Return a parabola's coefficients, their covariance, and the residuals in deviations."""
    terms = np.stack([np.ones_like(x), x, x**2], axis=1) / deviation[:, None]
    covariance = np.linalg.inv(terms.T @ terms)
    fitted = covariance @ terms.T @ (y / deviation)
    squares = float(np.sum(np.square(y / deviation - terms @ fitted)))
    return fitted, covariance, float(np.sqrt(squares / (len(x) - 3)))


def combined(effects: list[Effect]) -> Effect:
    """Return the mean of independent measurements of one effect, by their deviations."""
    known = [effect for effect in effects if effect.freedom > 0 and effect.deviation > 0]
    if not known:
        return NONE
    weights = np.array([1 / effect.deviation**2 for effect in known])
    size = float(np.average([effect.size for effect in known], weights=weights))
    # Of the surest alone where it decides (Welch and Satterthwaite).
    freedom = weights.sum() ** 2 / np.sum(weights**2 / [effect.freedom for effect in known])
    return Effect(size, float(1 / np.sqrt(weights.sum())), int(freedom))

"""How many whiteboards, of which kind and at what exposure, make Psi as sure as asked.

Parametric: a frame of N pixels adds the Fisher information sum over pixels of (slope slope^T) /
variance; with n frames of each kind the covariance of the placement is C = (prior + sum n_k I_k)^-1
and the expected squared error of Psi trace(G C), G from `psi_information`. Every kind is taken
once: a view that is never opened is known from its neighbours alone, whose shadows are nearly its
own, and takes up whatever the model misses. Frames are then added, each of the kind that lowers
that error most (greedy A-optimal design: Pukelsheim 2006, ch. 5).

Free: a coefficient's relative variance is that of its signal and of the reference it is divided
by, so the relative error of Psi after n frames a view is the root of
(sum var(pinhole) / n + psi^2 var(reference) / m) / sum psi^2.

A fitted mask is not the real one: MODEL_ERROR is in every expected error of a route that has one.
Both in one (see `misfit`): the variances of model and pinhole add as those of two measurements.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import Board, unsteadiness2
from emmc_rig.calibration.fit import shares_of_prior
from emmc_rig.calibration.openings import CENTRED, Window, views_open
from emmc_rig.calibration.parametric import SAMPLED, Parametric, drawn_pixels, psi_information
from emmc_rig.calibration.placement import SCALARS, Placement, Tolerances
from emmc_rig.calibration.shadow import Shadow, ShadowMask
from emmc_rig.model.noise import SensorNoise

Array = NDArray[np.floating]
DARK_FRAMES = 2
REFERENCE_FRAMES = 4
MOST_FRAMES = 400
"""Of whiteboards in a plan."""
MODEL_ERROR = 0.0022
"""Of Psi, relative: error of the fitted mask with its defects on the bench as it is shipped.

`benchmarks/calibration_checks.py psi --size 64x80 --rays 8192`: 0.223 % by the mixed route. With
fewer rays it is the bench that is grainy: 0.42 % at 2048, 1.11 % at 512.
"""


FEW_MODEL_ERROR = 0.0043
"""The same where parts of the aperture are opened: views never opened alone take up what is missed.

The whole error of `benchmarks/calibration_checks.py few`, with noise.
"""


@dataclass(frozen=True)
class Kind:
    """A kind of whiteboard: the pinhole before one view, or None for the window, moved by cells."""

    pinhole: tuple[int, int] | None
    stage_um: tuple[float, float] = (0.0, 0.0)
    window: Window = CENTRED

    def views_open(self, views: tuple[int, int]) -> NDArray[np.bool_]:
        """Return which views (v, u) it opens."""
        return views_open(views, self.pinhole, self.window)


@dataclass(frozen=True)
class Light:
    """What a frame is exposed to.

    exposure_s: of an open whiteboard; that of one which opens n of the views is longer, views / n
    times. light: pixels' share, see `model.noise`. pixels: how many there are to fit.
    """

    noise: SensorNoise
    exposure_s: float
    views: tuple[int, int]
    light: float
    pixels: int

    def times(self, kind: Kind) -> float:
        """Return how much longer than an open whiteboard a kind is exposed."""
        return float(np.prod(self.views) / kind.views_open(self.views).sum())


@dataclass(frozen=True)
class PlannedFrames:
    """How many frames of each kind, and the relative error of Psi expected of them."""

    counts: Mapping[Kind, int]
    expected_error: float


def dark_variance(kind: Kind, light: Light) -> float:
    """Return the variance of readings by the darks of their exposure, which all frames share."""
    return float(reading_variance(np.zeros(1), kind, light)[0]) / DARK_FRAMES


def reading_variance(reading: Array, kind: Kind, light: Light) -> Array:
    """Return the variance of one frame's readings, without those of the reference and the dark."""
    return light.noise.variance(reading, light.exposure_s * light.times(kind), light.light)


def information_of(
    mask: ShadowMask, placement: Placement, kind: Kind, light: Light
) -> NDArray[np.float64]:
    """Return the Fisher information of one frame, (parameter, parameter)."""
    chosen, channels = drawn_pixels(mask)
    shadow = Shadow(mask, placement)
    opened = kind.views_open(mask.views)
    reading, slopes = shadow.with_slopes(chosen, channels, opened, kind.stage_um)
    variance = reading_variance(reading, kind, light)
    # The noise of reference and dark does not average over the boards.
    variance = (
        variance
        + reading**2 * reading_variance(np.ones_like(reading), Kind(None), light) / REFERENCE_FRAMES
        + dark_variance(kind, light)
    )
    return (slopes.T @ (slopes / variance[:, None])) * (light.pixels / SAMPLED)


@dataclass(frozen=True)
class PinholeWorth:
    """What whiteboards through the pinhole would add to open ones alone.

    weights: relative deviation of the views' shares of the light, as known now. now, with_best,
    every: relative error of Psi expected now, with a whiteboard before `view`, the best, and before
    every view.
    """

    weights: float
    view: tuple[int, int]
    now: float
    with_best: float
    every: float


def pinhole_worth(known: Parametric, boards: Sequence[Board], stated: float) -> PinholeWorth:
    """Return what whiteboards through the pinhole are worth beside `boards`, taken as the first.

        information of a view = (sum s s^T - (sum s r)(sum s r)^T / (sum r^2 + v / unsteady2)) / v
        error^2 = trace(G C) / |Psi|^2 + stays2,    C = (information of all whiteboards)^-1

    Sums over the usable pixels; r: reading, s: its derivatives, v: its variance; what is subtracted
    is the whiteboard's own brightness, of variance unsteady2. G: see `psi_information`. stated:
    relative error of Psi now; stays2 is the part of its square that is not by the placement.
    """
    shadow, fit, board = known.shadow, known.fit, boards[0]
    mask = shadow.mask
    chosen, channels = drawn_pixels(mask)
    matrix, squares = psi_information(shadow)
    # A pinhole's whiteboard is exposed until it is as bright.
    views = mask.views[0] * mask.views[1]
    variance = float(np.median(board.variance[board.usable])) / views**2
    unsteady2 = fit.brightness_spread**2 + unsteadiness2(boards) / board.repeats
    pixels = int(board.usable.sum()) / SAMPLED
    total = np.linalg.inv(fit.covariance)
    stays2 = max(stated**2 - float(np.sum(fit.covariance * matrix)) / squares, 0.0)

    def added(view: tuple[int, int]) -> NDArray[np.float64]:
        reading, slopes = shadow.with_slopes(chosen, channels, views_open(mask.views, view))
        light = slopes.T @ reading
        level = float(reading @ reading) + variance / pixels / max(unsteady2, 1e-12)
        return (slopes.T @ slopes - np.outer(light, light) / level) * pixels / variance

    def error(information: Array) -> float:
        missed2 = float(np.trace(np.linalg.solve(information, matrix))) / squares
        return float(np.sqrt(missed2 + stays2))

    each = {view: added(view) for view in np.ndindex(mask.views)}
    best = min(each, key=lambda view: error(total + each[view]))
    shares = shares_of_prior(mask, fit.placement, fit.covariance, Tolerances())[len(SCALARS) :]
    return PinholeWorth(
        weights=float(np.sqrt(np.mean(np.square(shares)))) * Tolerances().aperture,
        view=(int(best[0]), int(best[1])),
        now=stated,
        with_best=error(total + each[best]),
        every=error(total + sum(each.values())),
    )


def plan_parametric(
    mask: ShadowMask,
    placement: Placement,
    kinds: Sequence[Kind],
    light: Light,
    target: float,
    most: int = MOST_FRAMES,
    model_error: float = MODEL_ERROR,
) -> PlannedFrames:
    """Return frames of the given kinds, each at least once, for an error of `target`.

    The first frame is always the first kind, which the fit registers. Stops at `most` frames:
    the error expected then is in the result.
    """
    matrix, squares = psi_information(Shadow(mask, placement))
    each = {kind: information_of(mask, placement, kind, light) for kind in kinds}
    total = np.diag(1 / Tolerances().deviations(mask.views) ** 2) + sum(each.values())
    counts = dict.fromkeys(kinds, 1)

    def error(information: NDArray[np.float64]) -> float:
        noise2 = max(np.trace(np.linalg.solve(information, matrix)), 0) / squares
        return float(np.sqrt(noise2 + model_error**2))

    expected = error(total)
    while expected > max(target, 1.01 * model_error) and sum(counts.values()) < most:
        best = min(kinds, key=lambda kind: error(total + each[kind]))
        total = total + each[best]
        counts[best] += 1
        expected = error(total)
    return PlannedFrames(counts, expected)


@dataclass(frozen=True)
class FreeNoise:
    """Squared relative error of the free route: of one frame a view, and of what all share, the
    references and the darks.
    """

    pinhole2: float
    reference2: float

    def error(self, repeats: int) -> float:
        """Return the expected relative error of Psi after so many frames a view."""
        return float(np.sqrt(self.pinhole2 / repeats + self.reference2))

    def with_model(self, repeats: int) -> float:
        """Return the same where the model makes it surer."""
        free2 = self.error(repeats) ** 2
        return float(np.sqrt(free2 * MODEL_ERROR**2 / (free2 + MODEL_ERROR**2)))


def free_noise(mask: ShadowMask, placement: Placement, light: Light) -> FreeNoise:
    """Return what the noise of the free route's error is made of."""
    chosen, channels = drawn_pixels(mask)
    shadow = Shadow(mask, placement)
    pinhole = white = squares = 0.0
    for view in np.ndindex(mask.views):
        psi = shadow.readings(chosen, channels, views_open(mask.views, view))
        pinhole += float(reading_variance(psi, Kind(view), light).sum())
        reference = reading_variance(np.ones_like(psi), Kind(None), light) / REFERENCE_FRAMES
        white += float((psi**2 * reference).sum()) + len(psi) * dark_variance(Kind(view), light)
        squares += float((psi**2).sum())
    return FreeNoise(pinhole / squares, white / squares)


def plan_combined(
    mask: ShadowMask, placement: Placement, light: Light, target: float, most: int = MOST_FRAMES
) -> PlannedFrames:
    """Return frames through the pinhole, the same number before every view, for both routes in one.

    At most `most` before each: the error expected then is in the result.
    """
    noise = free_noise(mask, placement, light)
    repeats = next((n for n in range(1, most) if noise.with_model(n) <= target), most)
    counts = dict.fromkeys(map(Kind, np.ndindex(mask.views)), repeats)
    return PlannedFrames(counts, noise.with_model(repeats))

"""How many whiteboards, of which kind and at what exposure, make Psi as sure as asked.

Parametric: a frame of N pixels adds the Fisher information sum over pixels of (slope slope^T) /
variance; with n frames of each kind the covariance of the placement is C = (prior + sum n_k I_k)^-1
and the expected squared error of Psi trace(G C), G from `psi_information`. Frames are added one by
one, always the kind that lowers that error most (greedy A-optimal design: Pukelsheim 2006, ch. 5).

Free: a coefficient's relative variance is that of its signal and of the reference it is divided
by, so the relative error of Psi after n frames a view is the root of
(sum var(pinhole) / n + psi^2 var(reference) / m) / sum psi^2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.parametric import SAMPLED, psi_information
from calibration.placement import Placement, Tolerances
from calibration.shadow import ANY_COLOUR, Shadow, ShadowMask
from emmc_rig.model.noise import SensorNoise

Array = NDArray[np.floating]
DARK_FRAMES = 2
REFERENCE_FRAMES = 4
MOST_FRAMES = 400


@dataclass(frozen=True)
class Kind:
    """A kind of whiteboard: the pinhole before one view, or None for the open aperture."""

    pinhole: tuple[int, int] | None
    stage_um: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Light:
    """What a frame is exposed to.

    exposure_s: of an open whiteboard; the pinhole's is longer by `pinhole_times`. light: pixels'
    share, see `model.noise`. pixels: how many there are to fit (usable ones).
    """

    noise: SensorNoise
    exposure_s: float
    pinhole_times: float
    light: float
    pixels: int


@dataclass(frozen=True)
class PlannedFrames:
    """How many frames of each kind, and the relative error of Psi expected of them."""

    counts: Mapping[Kind, int]
    expected_error: float
    dark_frames: int = DARK_FRAMES
    reference_frames: int = REFERENCE_FRAMES

    @property
    def exposures(self) -> int:
        """All frames."""
        return sum(self.counts.values()) + self.dark_frames + self.reference_frames


def reading_variance(reading: Array, kind: Kind, light: Light) -> Array:
    """Return the variance of one frame's readings, without the reference's part."""
    times = 1.0 if kind.pinhole is None else light.pinhole_times
    return light.noise.variance(reading, light.exposure_s * times, light.light)


def information_of(
    mask: ShadowMask, placement: Placement, kind: Kind, light: Light, seed: int = 0
) -> NDArray[np.float64]:
    """Return the Fisher information of one frame, (parameter, parameter)."""
    rng = np.random.default_rng(seed)
    rows, columns = mask.pixel_shape()
    chosen = np.stack([rng.integers(rows, size=SAMPLED), rng.integers(columns, size=SAMPLED)], 1)
    channels = rng.integers(ANY_COLOUR, size=SAMPLED).astype(np.uint8)
    views_open = np.full(mask.views, kind.pinhole is None)
    if kind.pinhole is not None:
        views_open[kind.pinhole] = True
    shadow = Shadow(mask, placement)
    reading, slopes = shadow.with_slopes(chosen, channels, views_open, kind.stage_um)
    variance = reading_variance(reading, kind, light)
    # The reference is divided by as well, and its noise does not average over the boards.
    variance = (
        variance
        + reading**2 * reading_variance(np.ones_like(reading), Kind(None), light) / REFERENCE_FRAMES
    )
    return (slopes.T @ (slopes / variance[:, None])) * (light.pixels / SAMPLED)


def plan_parametric(
    mask: ShadowMask,
    placement: Placement,
    kinds: Sequence[Kind],
    light: Light,
    target: float,
    tolerances: Tolerances | None = None,
    most: int = MOST_FRAMES,
) -> PlannedFrames:
    """Return frames of the given kinds that bring Psi's expected relative error to `target`.

    The first frame is always the first kind, which the fit registers. Stops at `most` frames:
    the error expected then is in the result.
    """
    tolerances = tolerances or Tolerances()
    matrix, squares = psi_information(Shadow(mask, placement))
    each = {kind: information_of(mask, placement, kind, light) for kind in kinds}
    total = np.diag(1 / tolerances.deviations(mask.views) ** 2) + each[kinds[0]]
    counts = dict.fromkeys(kinds, 0)
    counts[kinds[0]] = 1

    def error(information: NDArray[np.float64]) -> float:
        return float(np.sqrt(max(np.trace(np.linalg.solve(information, matrix)), 0) / squares))

    expected = error(total)
    while expected > target and sum(counts.values()) < most:
        best = min(kinds, key=lambda kind: error(total + each[kind]))
        total = total + each[best]
        counts[best] += 1
        expected = error(total)
    return PlannedFrames({kind: n for kind, n in counts.items() if n}, expected)


def free_error(mask: ShadowMask, placement: Placement, light: Light, repeats: int) -> float:
    """Return Psi's expected relative error by the free route with so many frames a view."""
    rng = np.random.default_rng(0)
    rows, columns = mask.pixel_shape()
    chosen = np.stack([rng.integers(rows, size=SAMPLED), rng.integers(columns, size=SAMPLED)], 1)
    channels = rng.integers(ANY_COLOUR, size=SAMPLED).astype(np.uint8)
    shadow = Shadow(mask, placement)
    errors = squares = 0.0
    for view in np.ndindex(mask.views):
        views_open = np.zeros(mask.views, dtype=bool)
        views_open[view] = True
        psi = shadow.readings(chosen, channels, views_open)
        pinhole = reading_variance(psi, Kind(view), light) / repeats
        white = reading_variance(np.ones_like(psi), Kind(None), light) / REFERENCE_FRAMES
        errors += float((pinhole + psi**2 * white).sum())
        squares += float((psi**2).sum())
    return float(np.sqrt(errors / squares))


def plan_free(
    mask: ShadowMask,
    placement: Placement,
    light: Light,
    target: float,
    shots: int,
    most: int = MOST_FRAMES,
) -> PlannedFrames:
    """Return frames through the pinhole, the same number before every view and for every shot."""
    repeats = 1
    while free_error(mask, placement, light, repeats) > target and repeats < most:
        repeats += 1
    counts = {Kind((v, u)): repeats * shots for v, u in np.ndindex(mask.views)}
    return PlannedFrames(counts, free_error(mask, placement, light, repeats))

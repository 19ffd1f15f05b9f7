"""High dynamic range: frames of one scene at several exposures, fused to a linear rate.

The best unbiased estimate weighs each frame by the inverse of its variance. That variance is
taken from the sensor's noise model at the fused rate, never from the pixel's own noisy value, which
would favour those that happen to be low (Granados et al., CVPR 2010, Section 3). For the same
reason whether a longer exposure saturates is foretold from the shorter ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.frames import MeanFrame, SensorGain

Array = NDArray[np.floating]
ROUNDS = 3
SAFETY_SIGMAS = 4.0
QUANTISATION_DN2 = 1 / 12
"""Least variance of a frame: a sensor without any noise still rounds."""


@dataclass(frozen=True, eq=False)
class LinearFrame:
    """A frame in DN per second above the dark, all (y, x).

    dn_per_s: where the shortest exposure is saturated, the least that it can be. variance: of
    `dn_per_s`, (DN/s)^2; infinite where nothing is usable. usable: at least one exposure was
    neither saturated nor foretold to be.
    """

    dn_per_s: NDArray[np.float32]
    variance: NDArray[np.float32]
    usable: NDArray[np.bool_]


def fuse(
    frames_dn: Sequence[NDArray[np.uint16]],
    exposures_s: Sequence[float],
    dark: MeanFrame,
    gain: SensorGain,
    white_level_dn: int,
    dead: NDArray[np.bool_] | None = None,
) -> LinearFrame:
    """Return the linear frame of a bracket: frames (y, x), repeats of one exposure too.

    dead: pixels that no exposure can use. Raises CalibrationError for no frame, or for frames of
    another size than the dark one.
    """
    if not frames_dn or len(frames_dn) != len(exposures_s):
        raise CalibrationError("a bracket needs frames, and an exposure for each")
    if any(frame.shape != dark.mean_dn.shape for frame in frames_dn):
        raise CalibrationError("a bracket's frames differ in size from the dark frame")
    order = np.argsort(exposures_s, kind="stable")
    times_s = np.asarray(exposures_s, dtype=np.float64)[order]
    signals = [frames_dn[i].astype(np.float64) - dark.mean_dn for i in order]
    unclipped = [frames_dn[i] < white_level_dn for i in order]
    room_dn = white_level_dn - dark.mean_dn.astype(np.float64)
    used = _used(signals, unclipped, times_s, gain, room_dn)
    if dead is not None:
        used = [one & ~dead for one in used]
    rate = _pooled(signals, used, times_s)
    for _ in range(ROUNDS):
        weights = _weights(rate, used, times_s, gain)
        total = np.sum(weights, axis=0)
        seen = total > 0
        safe = np.where(seen, total, 1.0)
        rate = np.sum([w * s / t for w, s, t in _zip(weights, signals, times_s)], axis=0) / safe
    # The dark frame's own noise is common to all exposures.
    lever = np.sum([w / t for w, t in zip(weights, times_s, strict=True)], axis=0) / safe
    variance = 1 / safe + lever**2 * gain.dark_variance_dn2 / dark.count
    clipped = ~(seen | unclipped[0])
    if dead is not None:
        clipped &= ~dead
    rate = np.where(clipped, np.maximum(signals[0], 0) / times_s[0], rate)
    return LinearFrame(
        rate.astype(np.float32), np.where(seen, variance, np.inf).astype(np.float32), seen
    )


def _zip(weights: list[Array], signals: list[Array], times_s: Array) -> list[tuple]:
    return list(zip(weights, signals, times_s, strict=True))


def _used(
    signals: list[Array],
    unclipped: list[NDArray[np.bool_]],
    times_s: Array,
    gain: SensorGain,
    room_dn: Array,
) -> list[NDArray[np.bool_]]:
    """Return where each frame is used: the shortest where not clipped, others as foretold."""
    used = []
    collected = np.zeros_like(signals[0])
    collected_s = np.zeros_like(signals[0])
    count = np.zeros_like(signals[0])
    for signal, whole, time_s in zip(signals, unclipped, times_s, strict=True):
        known = collected_s > 0
        safe_s = np.where(known, collected_s, 1.0)
        rate = np.maximum(collected / safe_s, 0)
        foretold_dn = rate * time_s
        spread = gain.gain_dn_per_electron * collected + count * gain.dark_variance_dn2
        variance = np.maximum(spread, 0) / safe_s**2 * time_s**2 + gain.variance_dn2(foretold_dn)
        fits = foretold_dn + SAFETY_SIGMAS * np.sqrt(variance) < room_dn
        shortest = time_s == times_s[0]
        use = whole if shortest else whole & known & fits
        used.append(use)
        collected = collected + np.where(use, signal, 0)
        collected_s = collected_s + np.where(use, time_s, 0)
        count = count + use
    return used


def _pooled(signals: list[Array], used: list[NDArray[np.bool_]], times_s: Array) -> Array:
    """Return all light over all time: the estimate where shot noise is all there is."""
    light = np.sum([np.where(u, s, 0) for u, s in zip(used, signals, strict=True)], axis=0)
    spent_s = np.sum([u * t for u, t in zip(used, times_s, strict=True)], axis=0)
    return light / np.where(spent_s > 0, spent_s, 1.0)


def _weights(
    rate: Array, used: list[NDArray[np.bool_]], times_s: Array, gain: SensorGain
) -> list[Array]:
    """Return the inverse variance of each frame's rate, 0 where it is not used."""
    return [
        np.where(
            use,
            time_s**2 / np.maximum(gain.variance_dn2(rate * time_s), QUANTISATION_DN2),
            0.0,
        )
        for use, time_s in zip(used, times_s, strict=True)
    ]

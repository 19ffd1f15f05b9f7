"""High dynamic range: frames of one scene at several exposures, fused to a linear rate.

The best unbiased estimate weighs each frame by the inverse of its variance. That variance is
taken from the sensor's noise model at the fused rate, never from the pixel's own noisy value, which
would favour those that happen to be low (Granados et al., CVPR 2010, Section 3). For the same
reason whether a longer exposure saturates is predicted from the shorter ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from calibration.frames import (
    DARK_ELECTRONS_PER_S,
    MeanFrame,
    SensorGain,
    dark_current_known,
    dark_shares,
)

Array = NDArray[np.floating]
ROUNDS = 3
SAFETY_SIGMAS = 4.0
QUANTISATION_DN2 = 1 / 12
"""Least variance of a frame: a sensor without any noise still rounds."""


def fuse(
    frames_dn: Sequence[NDArray[np.uint16]],
    exposures_s: Sequence[float],
    darks: Sequence[MeanFrame],
    gain: SensorGain,
    white_level_dn: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return the light rate of a bracket, its variance, and which pixels are usable, each (y, x).

    The rate is in DN per second above the dark; where the shortest exposure is saturated, the least
    that it can be. The variance is in (DN/s)^2, infinite where nothing is usable. A pixel is usable
    where at least one exposure is neither saturated nor predicted to be.

    frames_dn: (y, x) each, repeats of one exposure too. darks: of one exposure or more; each
    frame's own is subtracted, see `dark_shares`. Where all are of another exposure, the added dark
    current is not known: the deviation counts DARK_ELECTRONS_PER_S. gain: its variance in the dark
    is that of the shortest dark.

    Raises CalibrationError for no frame, or for frames of another size than the dark one.
    """
    if not frames_dn or len(frames_dn) != len(exposures_s):
        raise CalibrationError("a bracket needs frames, and an exposure for each")
    if any(frame.shape != darks[0].mean_dn.shape for frame in frames_dn):
        raise CalibrationError("a bracket's frames differ in size from the dark frame")
    order = np.argsort(exposures_s, kind="stable")
    times_s = np.asarray(exposures_s, dtype=np.float64)[order]
    shares = [dark_shares(darks, time_s) for time_s in times_s]
    means_dn = [one.mean_dn.astype(np.float64) for one in darks]
    own_dn = [np.tensordot(share, means_dn, 1) for share in shares]
    shortest_dn = means_dn[int(np.argmin([one.exposure_s for one in darks]))]
    # Dark current is shot noise too.
    current_dn = [np.maximum(one - shortest_dn, 0) for one in own_dn]
    signals = [frames_dn[i] - own for i, own in zip(order, own_dn, strict=True)]
    unclipped = [frames_dn[i] < white_level_dn for i in order]
    room_dn = [white_level_dn - own for own in own_dn]
    used = _used(signals, unclipped, times_s, gain, room_dn, current_dn)
    rate = _pooled(signals, used, times_s)
    for _ in range(ROUNDS):
        weights = _weights(rate, used, times_s, gain, current_dn)
        total = np.sum(weights, axis=0)
        seen = total > 0
        safe = np.where(seen, total, 1.0)
        rate = np.sum([w * s / t for w, s, t in _zip(weights, signals, times_s)], axis=0) / safe
    # What a dark frame is off by is common to all exposures that it serves.
    levers = [w / t / safe for w, t in zip(weights, times_s, strict=True)]
    variance = 1 / safe
    for place, one in enumerate(darks):
        own_variance = gain.variance_dn2(means_dn[place] - shortest_dn) / one.count
        lever = sum(share[place] * lever for share, lever in zip(shares, levers, strict=True))
        variance = variance + lever**2 * (own_variance + one.extra_variance_dn2)
    unknown_dn = [_unknown_dn(darks, time_s, gain) for time_s in times_s]
    variance = variance + sum(dn * lever for dn, lever in zip(unknown_dn, levers, strict=True)) ** 2
    clipped = ~(seen | unclipped[0])
    rate = np.where(clipped, np.maximum(signals[0], 0) / times_s[0], rate)
    return rate.astype(np.float32), np.where(seen, variance, np.inf).astype(np.float32), seen


def _unknown_dn(darks: Sequence[MeanFrame], exposure_s: float, gain: SensorGain) -> float:
    """Return the deviation of the dark current that no dark shows, in DN of an exposure."""
    if dark_current_known([one.exposure_s for one in darks], exposure_s):
        return 0.0
    further_s = abs(exposure_s - darks[0].exposure_s)
    return gain.gain_dn_per_electron * DARK_ELECTRONS_PER_S * further_s


def _zip(weights: list[Array], signals: list[Array], times_s: Array) -> list[tuple]:
    return list(zip(weights, signals, times_s, strict=True))


def _used(
    signals: list[Array],
    unclipped: list[NDArray[np.bool_]],
    times_s: Array,
    gain: SensorGain,
    room_dn: Sequence[Array],
    current_dn: Sequence[Array],
) -> list[NDArray[np.bool_]]:
    """Return where each frame is used: the shortest where not clipped, others as predicted."""
    used = []
    collected = np.zeros_like(signals[0])
    collected_s = np.zeros_like(signals[0])
    count = np.zeros_like(signals[0])
    for signal, whole, time_s, room, current in zip(
        signals, unclipped, times_s, room_dn, current_dn, strict=True
    ):
        known = collected_s > 0
        safe_s = np.where(known, collected_s, 1.0)
        rate = np.maximum(collected / safe_s, 0)
        expected_dn = rate * time_s
        spread = gain.gain_dn_per_electron * collected + count * gain.dark_variance_dn2
        variance = np.maximum(spread, 0) / safe_s**2 * time_s**2 + gain.variance_dn2(
            expected_dn + current
        )
        fits = expected_dn + SAFETY_SIGMAS * np.sqrt(variance) < room
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
    rate: Array,
    used: list[NDArray[np.bool_]],
    times_s: Array,
    gain: SensorGain,
    current_dn: Sequence[Array],
) -> list[Array]:
    """Return the inverse variance of each frame's rate, 0 where it is not used."""
    return [
        np.where(
            use,
            time_s**2
            / np.maximum(
                gain.variance_dn2(np.maximum(rate * time_s, 0) + current), QUANTISATION_DN2
            ),
            0.0,
        )
        for use, time_s, current in zip(used, times_s, current_dn, strict=True)
    ]

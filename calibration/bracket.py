"""High dynamic range: frames of one scene at several exposures, fused to a linear rate.

The best unbiased estimate weighs each frame by the inverse of its variance. That variance is
taken from the sensor's noise model at the fused rate, never from the pixel's own noisy value, which
would favour those that happen to be low (Granados et al., CVPR 2010, Section 3). For the same
reason whether a longer exposure saturates is predicted from the shorter ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import (
    DARK_ELECTRONS_PER_S,
    MeanFrame,
    SensorGain,
    dark_current_known,
    dark_shares,
)

Array = NDArray[np.floating]
ROUNDS = 3
"""Of rate and variance in turn."""
SAFETY_SIGMAS = 4.0
"""Below white, that a predicted reading must lie: noise exceeds them once in 30 000."""
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

        w_k = t_k^2 / variance_k(rate),    rate = sum w_k (signal_k / t_k) / sum w_k
        variance = 1 / sum w_k + sum over darks d of  (sum share_kd lever_k)^2 variance_d
                   + (sum unknown_k lever_k)^2,    lever_k = w_k / (t_k sum w)

    Sums over the frames k used, t their exposures, signal above the dark in DN; share_kd: of dark d
    in what is subtracted from frame k; unknown: of the dark current.

    Raises CalibrationError for no frame, and for frames of another size than the darks.
    """
    if not frames_dn or len(frames_dn) != len(exposures_s):
        raise CalibrationError("a bracket needs frames, and an exposure for each")
    if any(frame.shape != darks[0].mean_dn.shape for frame in frames_dn):
        raise CalibrationError(
            "a bracket's frames differ in size from the dark frame: capture all alike"
        )
    order = np.argsort(exposures_s, kind="stable")
    times_s = np.asarray(exposures_s, dtype=np.float64)[order]
    shares = np.array([dark_shares(darks, time_s) for time_s in times_s])
    means_dn = np.array([dark.mean_dn for dark in darks], dtype=np.float64)
    shortest_dn = means_dn[int(np.argmin([dark.exposure_s for dark in darks]))]
    taken = _Bracket(
        np.array([frames_dn[i] for i in order]), times_s, np.tensordot(shares, means_dn, 1),
        shortest_dn, gain, white_level_dn,
    )  # fmt: skip
    used = taken.used()
    # All light over all time: the estimate where shot noise is all there is.
    spent_s = np.tensordot(times_s, used, 1)
    rate = np.where(used, taken.signal_dn, 0).sum(axis=0) / np.where(spent_s > 0, spent_s, 1.0)
    by_time = times_s[:, None, None]
    for _ in range(ROUNDS):
        spread = np.maximum(taken.variance_dn2(rate), QUANTISATION_DN2)
        weights = np.where(used, by_time**2 / spread, 0.0)
        total = weights.sum(axis=0)
        seen = total > 0
        safe = np.where(seen, total, 1.0)
        rate = (weights * taken.signal_dn / by_time).sum(axis=0) / safe
    # The error of a dark frame is common to all exposures that it serves.
    levers = weights / by_time / safe
    variance = 1 / safe
    for place, dark in enumerate(darks):
        own_variance = gain.variance_dn2(means_dn[place] - shortest_dn) / dark.count
        lever = np.tensordot(shares[:, place], levers, 1)
        variance = variance + lever**2 * (own_variance + dark.extra_variance_dn2)
    unknown_dn = np.array([_unknown_dn(darks, time_s, gain) for time_s in times_s])
    variance = variance + np.tensordot(unknown_dn, levers, 1) ** 2
    clipped = ~(seen | (taken.frames_dn[0] < white_level_dn))
    rate = np.where(clipped, np.maximum(taken.signal_dn[0], 0) / times_s[0], rate)
    return rate.astype(np.float32), np.where(seen, variance, np.inf).astype(np.float32), seen


def _unknown_dn(darks: Sequence[MeanFrame], exposure_s: float, gain: SensorGain) -> float:
    """Return the deviation of the dark current that no dark shows, in DN of an exposure."""
    if dark_current_known([dark.exposure_s for dark in darks], exposure_s):
        return 0.0
    further_s = abs(exposure_s - darks[0].exposure_s)
    return gain.gain_dn_per_electron * DARK_ELECTRONS_PER_S * further_s


@dataclass(frozen=True, eq=False)
class _Bracket:
    """Frames from the shortest exposure on, and their darks: (frame, y, x)."""

    frames_dn: NDArray[np.uint16]
    times_s: Array
    dark_dn: Array
    shortest_dark_dn: Array
    gain: SensorGain
    white_level_dn: int

    @cached_property
    def signal_dn(self) -> Array:
        """What is above the dark."""
        return self.frames_dn - self.dark_dn

    @cached_property
    def current_dn(self) -> Array:
        """The dark current's signal, which is shot noise too."""
        return np.maximum(self.dark_dn - self.shortest_dark_dn, 0)

    def variance_dn2(self, rate: Array) -> Array:
        """Return the variance of every frame at a rate, (frame, y, x)."""
        expected_dn = np.maximum(rate * self.times_s[:, None, None], 0)
        return self.gain.variance_dn2(expected_dn + self.current_dn)

    def used(self) -> NDArray[np.bool_]:
        """Return where each frame is used: the shortest where not clipped, others as predicted."""
        used = self.frames_dn < self.white_level_dn
        collected, collected_s, count = (np.zeros(used.shape[1:]) for _ in range(3))
        for k, time_s in enumerate(self.times_s):
            if time_s > self.times_s[0]:
                known = collected_s > 0
                safe_s = np.where(known, collected_s, 1.0)
                expected_dn = np.maximum(collected / safe_s, 0) * time_s
                spread = self.gain.gain_dn_per_electron * collected
                spread = np.maximum(spread + count * self.gain.dark_variance_dn2, 0)
                variance = spread / safe_s**2 * time_s**2
                variance = variance + self.gain.variance_dn2(expected_dn + self.current_dn[k])
                room_dn = self.white_level_dn - self.dark_dn[k]
                used[k] &= known & (expected_dn + SAFETY_SIGMAS * np.sqrt(variance) < room_dn)
            collected = collected + np.where(used[k], self.signal_dn[k], 0)
            collected_s = collected_s + np.where(used[k], time_s, 0)
            count = count + used[k]
        return used

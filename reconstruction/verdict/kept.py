"""What readings kept from the fit say of a light field: how much of them it foretells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.verdict.shadow import Relief

Array = NDArray[np.floating]
FEWEST = 30
SHARE = 0.003
"""Of the usable readings that are kept from every fit; more of few, so that WANTED are."""
WANTED, MOST_SHARE = 150, 0.04
SEED = 1
"""Other than that of the readings which `adaptive` keeps for its standard deviation."""


def kept_readings(usable: NDArray[np.bool_], seed: int = SEED) -> NDArray[np.bool_]:
    """Return which usable readings (shot, pixel_y, pixel_x) to keep from the fit, at random."""
    share = min(max(SHARE, WANTED / max(int(usable.sum()), 1)), MOST_SHARE)
    return usable & (np.random.default_rng(seed).random(usable.shape) < share)


@dataclass(frozen=True)
class Kept:
    """How well a light field predicts held-out readings.

    readings: their number. missed: root mean square residual, over the mean reading. plain: that of
    the smooth picture. explained: share of the smooth picture's squared residual, less noise, that
    the light field removes. noise: share of the squared residual that is noise. beyond: share of
    the readings whose residual is more than five times the typical one.
    """

    readings: int
    missed: float
    plain: float
    explained: float
    noise: float
    beyond: float


def foretold(
    frames: Array, residual: Array, noise_sigma: float, kept: NDArray[np.bool_], found: Relief
) -> Kept | None:
    """Return how a light field fitted without some readings foretells them; None with too few.

    frames, residual (frames less what it predicts), kept: (shot, pixel_y, pixel_x).
    """
    kept = kept & np.isfinite(frames)
    if kept.sum() < FEWEST:
        return None
    read = frames[kept].astype(np.float64)
    miss = residual[kept].astype(np.float64)
    smooth = (found.level * (1 + found.masks))[kept]
    plain = read - smooth
    square, before, noise = float(np.mean(miss**2)), float(np.mean(plain**2)), noise_sigma**2
    mean = max(float(np.mean(np.abs(read))), 1e-12)
    typical = 1.4826 * float(np.median(np.abs(miss)))
    return Kept(
        len(read),
        float(np.sqrt(square)) / mean,
        float(np.sqrt(before)) / mean,
        1 - (square - noise) / max(before - noise, 1e-30) if before > 2 * noise else 0.0,
        min(noise / max(square, 1e-30), 1.0),
        float(np.mean(np.abs(miss) > 5 * max(typical, noise_sigma))),
    )

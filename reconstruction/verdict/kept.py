"""Held-out readings: which are kept from the fit, and how well the light field predicts them."""

from __future__ import annotations

from typing import Any

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


def compare_held_out(
    frames: Array, residual: Array, noise_sigma: float, kept: NDArray[np.bool_], found: Relief
) -> dict[str, Any]:
    """Return figures of `Evidence`: how well a light field predicts readings kept from its fit.

    frames, residual (frames less what it predicts), kept: (shot, pixel_y, pixel_x). None with too
    few readings.
    """
    kept = kept & np.isfinite(frames)
    if kept.sum() < FEWEST:
        return {"kept": 0, "explained": None, "noise_share": None}
    smooth = found.level * (1 + found.masks)
    square, before = (
        float(np.mean(np.square(one[kept], dtype=np.float64)))
        for one in (residual, frames - smooth)
    )
    noise = noise_sigma**2
    removed = 1 - (square - noise) / max(before - noise, 1e-30) if before > 2 * noise else 0.0
    share = min(noise / max(square, 1e-30), 1.0)
    return {"kept": int(kept.sum()), "explained": removed, "noise_share": share}

"""Pixels that cannot be used and are not listed, and holes that those listed leave."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.verdict.shadow import Relief

Array = NDArray[np.floating]
SMOOTH = 0.5
"""Of the neighbours' typical value: they must lie within so much for a pixel to be judged."""
SPREADS, LEAST, DEVIATIONS = 2.0, 0.3, 6.0
"""Times the neighbours' spread, their typical value, and the noise, that a pixel is off by."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """off: share that are far off all around, of readings whose neighbours agree. unusable: share of readings.

    hole_px: radius of the largest hole that no shot sees; hole: its centre (y, x).
    blind: share of pixels that no shot sees.
    """

    off: float
    unusable: float
    hole_px: float
    hole: tuple[int, int]
    blind: float


def judged_pixels(
    psi: ImagingMatrix, found: Relief, noise_sigma: float, usable: NDArray[np.bool_]
) -> Pixels:
    """Return what is wrong with single pixels."""
    step = 1 if psi.colour is None else 2
    off, told = 0, 0
    for shot in range(psi.shots):
        detail = (1 + found.read[shot]) / np.maximum(1 + found.masks[shot], 0.05)
        around = np.sort(_neighbours(detail, found.good[shot], step), axis=0)
        low, high = around[1], around[-2]
        spread = high - low
        smooth = found.good[shot] & (spread < SMOOTH * np.abs(around[3:5].mean(axis=0)))
        apart = np.where(detail > high, detail - high, np.maximum(low - detail, 0))
        light = found.level[shot] * np.maximum(1 + found.masks[shot], 0.05)
        wild = (apart > SPREADS * spread) & (apart * light > DEVIATIONS * noise_sigma)
        wild &= apart > LEAST * np.abs(around[3:5].mean(axis=0))
        off += int((wild & smooth).sum())
        told += int(smooth.sum())
    seen = usable.any(axis=0)
    radius = cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, 3)
    hole = np.unravel_index(int(radius.argmax()), radius.shape)
    return Pixels(
        off / max(told, 1),
        float(1 - usable.mean()),
        float(radius.max()),
        (int(hole[0]), int(hole[1])),
        float(1 - seen.mean()),
    )


def _neighbours(values: Array, good: NDArray[np.bool_], step: int) -> NDArray[np.float32]:
    """Return the eight neighbours at a step, (8, y, x); those not good take the good ones' mean."""
    rows, columns = values.shape
    padded = np.pad(np.where(good, values, np.nan), step, mode="reflect")
    places = [(i, j) for i in (0, step, 2 * step) for j in (0, step, 2 * step)]
    places.remove((step, step))
    found = np.stack([padded[i : i + rows, j : j + columns] for i, j in places])
    known = np.isfinite(found)
    mean = np.where(known, found, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known, found, mean).astype(np.float32)

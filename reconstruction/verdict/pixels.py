"""Unusable pixels missing from the list, and holes left by the listed pixels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.reconstruction.verdict.shadow import Relief

Array = NDArray[np.floating]
BLIND_PX = 1.9
"""A pixel is blind at this distance from the nearest pixel with a usable reading."""
SMOOTH = 0.5
"""Largest spread of the neighbours with which a pixel is compared, over their typical value."""
DIMMEST = 0.2
"""Of the light expected without masks: pixels behind dark cells are not compared."""
ENOUGH = 6
"""Neighbours, of eight, that must be usable."""
SPREADS, LEAST, DEVIATIONS = 2.0, 0.3, 6.0
"""Times the neighbours' spread, their typical value, and the noise, that a pixel is off by."""


def pixel_figures(
    psi: ImagingMatrix,
    excluded: Array,
    found: Relief,
    noise_sigma: float,
    usable: NDArray[np.bool_],
) -> dict[str, Any]:
    """Return figures of `Evidence` on single pixels. excluded: what unusable pixels read."""
    step = 1 if psi.colour is None else 2
    off, compared = 0, 0
    for shot in range(psi.shots):
        passed = 1 + found.masks[shot]
        detail = (1 + found.read[shot]) / np.maximum(passed, DIMMEST)
        good = found.good[shot] & (passed > DIMMEST)
        around, known = neighbours(detail, good, step)
        low, high, typical = around[1], around[-2], np.abs(around[3:5].mean(axis=0))
        spread = high - low
        smooth = good & (known >= ENOUGH) & (spread < SMOOTH * typical)
        apart = np.where(detail > high, detail - high, np.maximum(low - detail, 0))
        light = found.level[shot] * passed
        wild = (apart > SPREADS * spread) & (apart * light > DEVIATIONS * noise_sigma)
        wild &= apart > LEAST * typical
        off += int((wild & smooth).sum())
        compared += int(smooth.sum())
    seen = usable.any(axis=0)
    unseen = np.asarray(~seen, dtype=np.uint8)
    radius = cv2.distanceTransform(unseen, cv2.DIST_L2, 3)
    hole = np.unravel_index(int(radius.argmax()), radius.shape)
    return {
        "off": off / max(compared, 1),
        "unusable": float(1 - usable.mean()),
        "saturated": _saturated(excluded, found, usable),
        "blind": float((radius >= BLIND_PX).mean()),
        "hole_px": float(radius.max()),
        "hole_at": (int(hole[0]), int(hole[1])),
    }


def _saturated(excluded: Array, found: Relief, usable: NDArray[np.bool_]) -> float:
    """Return the share of readings that are not usable and above nearly all that are."""
    above = 0
    for shot, good in enumerate(usable):
        if good.any():
            read = found.level[shot] * (1 + found.read[shot])
            limit = float(np.quantile(read[good], 0.99))
            above += int((excluded[shot][~good] >= limit).sum())
    return above / usable.size


def neighbours(
    values: Array, good: NDArray[np.bool_], step: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the eight neighbours at a step in order, (8, y, x), and how many are good, (y, x).

    Those not good take the others' mean.
    """
    rows, columns = values.shape
    padded = np.pad(np.where(good, values, np.nan), step, mode="reflect")
    places = [(i, j) for i in (0, step, 2 * step) for j in (0, step, 2 * step)]
    places.remove((step, step))
    found = np.stack([padded[i : i + rows, j : j + columns] for i, j in places])
    known = np.isfinite(found)
    count = known.sum(axis=0)
    mean = np.where(known, found, 0).sum(axis=0) / np.maximum(count, 1)
    return np.sort(np.where(known, found, mean), axis=0).astype(np.float32), count

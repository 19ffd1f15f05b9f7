"""What single readings show: bad pixels, holes, compression and coarse quantisation.

JPEG rounds the cosine transform of blocks of 8 x 8 pixels: there, and nowhere else, many
coefficients are next to nothing. A quantised reading is a multiple of one step.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn

from emmc_rig.reconstruction.verdict.shadow import Relief

Array = NDArray[np.floating]
BLIND_PX = 1.9
"""A pixel is blind at this distance from the nearest pixel with a usable reading."""
BLOCK_PX = 8
MOST_PX = 256
"""Side of the middle that is transformed."""
FEWEST_BLOCKS = 20
NOTHING = 1e-3
"""Of a coefficient's root mean square, below which all are alike: rounding of the readings."""
REPEATED = 4
"""Readings per different value, from which on they are quantised."""


def pixel_figures(
    excluded: Array,
    relief: Relief,
    usable: NDArray[np.bool_],
) -> dict[str, Any]:
    """Return figures of `Evidence` on single pixels. excluded: the readings of unusable pixels."""
    seen = usable.any(axis=0)
    unseen = np.asarray(~seen, dtype=np.uint8)
    radius = cv2.distanceTransform(unseen, cv2.DIST_L2, 3)
    hole = np.unravel_index(int(radius.argmax()), radius.shape)
    return {
        "unusable": float(1 - usable.mean()),
        "saturated": _saturated(excluded, relief, usable),
        "blind": float((radius >= BLIND_PX).mean()),
        "hole_px": float(radius.max()),
        "hole_at": (int(hole[0]), int(hole[1])),
    }


def _saturated(excluded: Array, relief: Relief, usable: NDArray[np.bool_]) -> float:
    """Return the share of readings that are not usable and above nearly all that are."""
    above = 0
    for shot, good in enumerate(usable):
        if good.any():
            read = relief.level[shot] * (1 + relief.read[shot])
            limit = float(np.quantile(read[good], 0.99))
            above += int((excluded[shot][~good] >= limit).sum())
    return above / usable.size


def blockiness(frames: Array, usable: NDArray[np.bool_]) -> float | None:
    """Return the contrast between coefficients of the most compressed raster of blocks and of the
    others.

    The mean of log(|coefficient| / its root mean square), by which one of the 64 rasters of blocks
    lies below their median, of the shot where that is most. None with too few whole blocks.

    frames, usable: (shot, pixel_y, pixel_x).
    """
    middle = tuple(slice(max(0, (n - MOST_PX) // 2), (n + MOST_PX) // 2) for n in frames.shape[1:])
    contrasts = []
    for frame, good in zip(frames[:, *middle], usable[:, *middle], strict=True):
        rasters = np.ndindex(BLOCK_PX, BLOCK_PX)
        values = np.array([_smallness(frame[y:, x:], good[y:, x:]) for y, x in rasters])
        if np.isfinite(values).all():
            contrasts.append(float(np.median(values) - np.min(values)))
    return max(contrasts, default=None)


def _smallness(frame: Array, good: NDArray[np.bool_]) -> float:
    """Return the mean of log(|coefficient| / its root mean square); NaN with few whole blocks."""
    blocks = _blocks(frame)[_blocks(good).all(axis=(1, 2))].astype(np.float64)
    if len(blocks) < FEWEST_BLOCKS:
        return np.nan
    # The first coefficient is the mean: brightness, no detail.
    coefficients = np.asarray(dctn(blocks, axes=(1, 2), norm="ortho"))
    sizes = np.abs(coefficients).reshape(len(blocks), -1)[:, 1:]
    typical = np.sqrt(np.mean(np.square(sizes), axis=0)) + 1e-30
    return float(np.log(sizes / typical + NOTHING).mean())


def _blocks(values: NDArray) -> NDArray:
    """Return the whole blocks of an array (y, x), (block, 8, 8)."""
    n = BLOCK_PX
    rows, columns = (size // n for size in values.shape)
    cut = values[: rows * n, : columns * n].reshape(rows, n, columns, n)
    return cut.swapaxes(1, 2).reshape(-1, n, n)


def quantised(frames: Array, usable: NDArray[np.bool_]) -> float | None:
    """Return the step of which all readings of a shot are multiples, the largest; None if none.

    frames, usable: (shot, pixel_y, pixel_x).
    """
    steps = []
    for frame, good in zip(frames, usable, strict=True):
        levels = np.unique(frame[good])
        if len(levels) > 1 and REPEATED * len(levels) <= good.sum():
            steps.append(float(np.median(np.diff(levels))))
    return max(steps, default=None)

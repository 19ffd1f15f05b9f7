"""Whether readings were compressed or coarsely quantised before they came here.

JPEG rounds the cosine transform of blocks of 8 x 8 pixels: there, and nowhere else, many
coefficients are next to nothing. A quantised reading is a multiple of one step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
BLOCK_PX = 8
MOST_PX = 256
"""Side of the middle that is transformed."""
FEWEST_BLOCKS = 20
NOTHING = 1e-3
"""Of a coefficient's root mean square, below which all are alike: rounding of the readings."""
REPEATED = 4
"""Readings per different value, from which on they are quantised."""


def _cosines() -> NDArray[np.float64]:
    k = np.arange(BLOCK_PX)
    rows = np.cos(np.pi * (2 * k[None] + 1) * k[:, None] / (2 * BLOCK_PX))
    rows *= np.sqrt(2 / BLOCK_PX)
    rows[0] /= np.sqrt(2)
    return rows


def blockiness(frames: Array, usable: NDArray[np.bool_]) -> float | None:
    """Return the contrast between coefficients of the most compressed raster of blocks and of the
    others.

    The mean of log(|coefficient| / its root mean square), by which one of the 64 rasters of blocks
    lies below their median, of the shot where that is most. None with too few whole blocks.

    frames, usable: (shot, pixel_y, pixel_x).
    """
    middle = tuple(slice(max(0, (n - MOST_PX) // 2), (n + MOST_PX) // 2) for n in frames.shape[1:])
    found = []
    for frame, good in zip(frames[:, *middle], usable[:, *middle], strict=True):
        values = np.array([_smallness(frame[y:, x:], good[y:, x:]) for y, x in np.ndindex(8, 8)])
        if np.isfinite(values).all():
            found.append(float(np.median(values) - np.min(values)))
    return max(found, default=None)


def _smallness(frame: Array, good: NDArray[np.bool_]) -> float:
    """Return the mean of log(|coefficient| / its root mean square); NaN with few whole blocks."""
    blocks = _blocks(frame)[_blocks(good).all(axis=(1, 2))].astype(np.float64)
    if len(blocks) < FEWEST_BLOCKS:
        return np.nan
    cosines = _cosines()
    sizes = np.abs(cosines @ blocks @ cosines.T).reshape(len(blocks), -1)[:, 1:]
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

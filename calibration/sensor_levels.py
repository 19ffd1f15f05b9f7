"""Levels of a sensor's frames: means, temporal variances and shared charge, by parts of the frame.

Two frames of one exposure give a mean and a temporal variance: half the variance of their
difference, in which pixels' own differences cancel (EMVA 1288, release 4.0 linear, 6.6).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import step_of_values

Array = NDArray[np.floating]
Frame = NDArray[np.uint16]
Flags = NDArray[np.bool_]
BLOCKS = 12
"""Of rows: a deviation of so many is known to a fifth."""
TILES = 8
"""Across: with BLOCKS down, the parts of a frame of which the brightest show saturation."""
PHASES = 4
"""Pixels of a 2 x 2 tile, each of which may have a filter of its own."""


@dataclass(frozen=True)
class Pair:
    """Two frames (y, x) of one exposure."""

    exposure_s: float
    first: Frame
    second: Frame


class Levels(NamedTuple):
    """Statistics of a pair by block of rows, tile across and phase; of several with an axis first.

    exposure_s: (). step_dn: (), between values in use; NaN where all pixels read alike. mean,
    variance, clipped, change: (block, tile, phase), NaN without pixels; variance: temporal, of one
    frame, with the converter's rounding; clipped: share of the pixels; change: second frame's mean
    less the first's. sides_dn2, corners_dn2: (block,), sum of a pixel's temporal covariances with
    its four neighbours beside it and at its corners.
    """

    exposure_s: Array
    step_dn: Array
    mean: Array
    variance: Array
    clipped: Array
    change: Array
    wide: Array
    sides_dn2: Array
    corners_dn2: Array

    def over(self, tiles: Flags, name: str) -> Array:
        """Return the mean of a statistic over the tiles flagged, (pair, phase)."""
        return np.nanmean(getattr(self, name)[:, tiles], axis=1)


def phases_of(frame: NDArray) -> list[NDArray]:
    """Return the four phases of a frame (y, x), views."""
    return [frame[y::2, x::2] for y in range(2) for x in range(2)]


def stacked(levels: Iterable[Levels]) -> Levels:
    """Return the levels of several pairs with an axis (pair,) first."""
    return Levels(*(np.array(values) for values in zip(*levels, strict=True)))


def measure_pair(pair: Pair, good: Flags, white_level_dn: int, lit: bool) -> Levels:
    """Return the levels of a pair; good: (y, x), pixels that count.

    lit: the lamp may differ between the frames, by a smooth pattern: the mean of each tile's
    difference is no noise. In the dark only the whole frame's is not: rows that differ are noise.
    """
    if pair.first.shape != pair.second.shape or pair.first.shape != good.shape:
        raise CalibrationError(
            f"exposure of {pair.exposure_s:g} s: frames of {pair.first.shape} and "
            f"{pair.second.shape} differ from {good.shape}: are they of one camera?"
        )
    step_dn = step_of_values((pair.first, pair.second))
    top_dn = white_level_dn - (0.0 if np.isnan(step_dn) else step_dn - 1)
    parts = (BLOCKS, TILES, PHASES)
    mean, variance, clipped, change, wide = (np.full(parts, np.nan) for _ in range(5))
    noise = np.zeros(good.shape, dtype=np.float32)
    planes = zip(*map(phases_of, (pair.first, pair.second, good, noise)), strict=True)
    for phase, (first, second, use, centred) in enumerate(planes):
        whole = (second[use].astype(np.float64) - first[use]).mean() if use.any() else 0.0
        for block, tile, part in tiles_of(first.shape):
            x, y = (plane[part][use[part]].astype(np.float64) for plane in (first, second))
            if len(x) < 2:
                continue
            difference = y - x
            middle = difference.mean() if lit else whole
            mean[block, tile, phase] = (x.mean() + y.mean()) / 2
            change[block, tile, phase] = difference.mean()
            squares = np.square(difference - middle).sum()
            variance[block, tile, phase] = squares / (2 * (len(x) - 1 if lit else len(x)))
            wide[block, tile, phase] = np.mean(np.abs(difference - middle) > 1.5 * step_dn)
            clipped[block, tile, phase] = np.mean(x >= top_dn)
            centred[part][use[part]] = difference - difference.mean()
    exposure_s, step = np.array(pair.exposure_s), np.array(step_dn)
    return Levels(exposure_s, step, mean, variance, clipped, change, wide, *_shared(noise, good))


def tiles_of(shape: tuple[int, int]) -> Iterable[tuple[int, int, tuple[slice, slice]]]:
    """Yield block, tile and their part of a phase's plane."""
    rows, columns = (
        np.linspace(0, length, count + 1).astype(int)
        for length, count in zip(shape, (BLOCKS, TILES), strict=True)
    )
    for block, tile in np.ndindex(BLOCKS, TILES):
        part = slice(rows[block], rows[block + 1]), slice(columns[tile], columns[tile + 1])
        yield block, tile, part


def _shared(noise: NDArray[np.float32], good: Flags) -> tuple[Array, Array]:
    """Return the sums of covariances with neighbours at the sides and corners, (block,) each.

    noise: (y, x), difference of two frames, n = noise less its mean over its row and its column:
    whole rows that flicker are no charge that pixels share. A frame's covariance with both
    neighbours across is 2 <n(y, x) n(y, x + 1)> / 2; the mean that was taken out of a row of w
    pixels made each of them smaller by variance / w.
    """
    rows, columns = noise.shape
    spread = float(np.sum(np.square(noise, dtype=np.float64))) / max(int(good.sum()), 1) / 2
    noise = noise - noise.mean(axis=1, keepdims=True)
    noise -= noise.mean(axis=0)
    right, below = np.roll(noise, -1, axis=1), np.roll(noise, -1, axis=0)
    sides = noise * (right + below)
    corners = noise * (np.roll(right, -1, axis=0) + np.roll(below, 1, axis=1))
    edges = np.linspace(0, rows, BLOCKS + 1).astype(int)
    found = np.full((2, BLOCKS), np.nan)
    for block, (first, last) in enumerate(pairwise(edges)):
        if count := int(good[first:last].sum()):
            found[:, block] = [
                float(product[first:last].sum(dtype=np.float64)) / count
                for product in (sides, corners)
            ]
    found[0] += 2 * spread * (1 / rows + 1 / columns)
    return found[0], found[1]

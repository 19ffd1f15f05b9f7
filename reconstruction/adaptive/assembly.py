"""Psi of textured surfaces, laid out for many products: where its rays meet the texture.

Where the rays of a reading meet the texture close together, which small disparities make them do,
their taps are summed to a box of the texture, 4 bytes a sample; else each ray that is not dark is
kept, 16 bytes. Operations of a product: a sample of a box 1, a ray 32; of laying out: about 40 a
ray. Where all cells together are too many, they are laid out anew, a band of rows at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import floor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands, summed_in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]
TAPS = 4
MOST_CELLS = 240_000_000
"""That are held at a time: 4 bytes each."""
RAY = 4
"""Cells of a ray: its first tap, as an integer, the fractions along y and x, and its weight."""


class Cells(NamedTuple):
    """boxes: (reading, 4), first row and column, height and width; height 0: rays. starts:
    (reading + 1,), where each reading's cells begin. values: the cells; taps: the same as integers.
    colour: Psi's map; binning: k; size: rows and columns of a texture; stored: colours of Psi."""

    colour: Any
    binning: Any
    size: Any
    stored: Any
    boxes: Any
    starts: Any
    values: Any
    taps: Any


@njit(inline="always")
def cubic(fraction, taps):
    """Set the four weights of Catmull-Rom interpolation at a fraction in [0, 1)."""
    t = fraction
    taps[0] = ((-0.5 * t + 1.0) * t - 0.5) * t
    taps[1] = (1.5 * t - 2.5) * t * t + 1.0
    taps[2] = ((-1.5 * t + 2.0) * t + 0.5) * t
    taps[3] = (0.5 * t - 0.5) * t * t


@njit(inline="always")
def first_tap(position, margin, last):
    """Return the first of four taps within a padded texture, and the fraction beyond the second."""
    whole = floor(position)
    first = whole + margin - 1
    fraction = np.float32(position - whole)
    if first < 0:
        return 0, np.float32(0.0)
    if first > last:
        return last, np.float32(1.0)
    return first, fraction


@njit(forceinline=True, fastmath=True)
def _place(disparity, y, margin, size, taps, fractions):
    """Set taps and fractions (2, ray, x) of row y's rays, along y and x, see `first_tap`."""
    views_v, views_u, _, columns = disparity.shape
    last_y, last_x = np.float32(size[0] - TAPS), np.float32(size[1] - TAPS)
    ahead = np.float32(margin - 1)
    none, full = np.float32(0), np.float32(1)
    for v in range(views_v):
        for u in range(views_u):
            ray = v * views_u + u
            row = disparity[v, u, y]
            dv, du = np.float32(v - views_v // 2), np.float32(u - views_u // 2)
            tap_y, tap_x = taps[0, ray], taps[1, ray]
            part_y, part_x = fractions[0, ray], fractions[1, ray]
            for x in range(columns):
                at_y, at_x = np.float32(y) - row[x] * dv, np.float32(x) - row[x] * du
                whole_y, whole_x = np.floor(at_y), np.floor(at_x)
                first_y, first_x = whole_y + ahead, whole_x + ahead
                fy = none if first_y < none else at_y - whole_y
                fx = none if first_x < none else at_x - whole_x
                part_y[x] = full if first_y > last_y else fy
                part_x[x] = full if first_x > last_x else fx
                tap_y[x] = np.int32(min(max(first_y, none), last_y))
                tap_x[x] = np.int32(min(max(first_x, none), last_x))


@njit(forceinline=True)
def _bound(weights, y, taps, reach):
    """Widen reach (5, x) by row y's rays: first and last taps along y and x, and entries.

    weights: (v, u, y, stored, x) of one shot.
    """
    views_v, views_u, _, stored, columns = weights.shape
    top, bottom, left, right, entries = reach[0], reach[1], reach[2], reach[3], reach[4]
    for v in range(views_v):
        for u in range(views_u):
            ray = v * views_u + u
            tap_y, tap_x = taps[0, ray], taps[1, ray]
            for k in range(stored):
                row = weights[v, u, y, k]
                for x in range(columns):
                    seen = row[x] != 0
                    top[x] = min(top[x], tap_y[x] if seen else top[x])
                    bottom[x] = max(bottom[x], tap_y[x] if seen else bottom[x])
                    left[x] = min(left[x], tap_x[x] if seen else left[x])
                    right[x] = max(right[x], tap_x[x] if seen else right[x])
                    entries[x] += 1 if seen else 0


@njit(cache=True, nogil=True)
def _measure(weights, disparity, margin, binning, size, first_row, last_row, boxes, counts):
    """Set boxes (reading, 4) to first row and column, height and width, and counts to the cells.

    A reading whose rays are kept one by one has a height of 0.
    """
    shots, views_v, views_u, _, stored, columns = weights.shape
    pixels_y, pixels_x = weights.shape[3] // binning, columns // binning
    taps = np.empty((binning, 2, views_v * views_u, columns), np.int32)
    fractions = np.empty((2, views_v * views_u, columns), np.float32)
    reach = np.empty((5, columns), np.int32)
    for pixel_y in range(first_row, last_row):
        for sub_y in range(binning):
            _place(disparity, pixel_y * binning + sub_y, margin, size, taps[sub_y], fractions)
        for s in range(shots):
            reach[0], reach[2], reach[1], reach[3], reach[4] = size[0], size[1], 0, 0, 0
            for sub_y in range(binning):
                _bound(weights[s], pixel_y * binning + sub_y, taps[sub_y], reach)
            for pixel_x in range(pixels_x):
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                mine = reach[:, pixel_x * binning : (pixel_x + 1) * binning]
                entries = mine[4].sum()
                boxes[reading] = 0
                counts[reading] = RAY * entries
                if entries == 0:
                    continue
                top, left = mine[0].min(), mine[2].min()
                height = mine[1].max() - top + TAPS
                width = mine[3].max() - left + TAPS
                if height * width * stored <= TAPS * TAPS * entries:
                    boxes[reading, 0], boxes[reading, 1] = top, left
                    boxes[reading, 2], boxes[reading, 3] = height, width
                    counts[reading] = height * width * stored


@njit(cache=True, fastmath=True, nogil=True)
def _lay(weights, disparity, margin, laid, first_row, last_row):
    """Set the cells of readings: boxes of taps, or rays."""
    colour, binning, size, stored, boxes, starts, cells, taps_of = laid
    shots, views_v, views_u, _, _, columns = weights.shape
    pixels_y, pixels_x = weights.shape[3] // binning, columns // binning
    taps = np.empty((binning, 2, views_v * views_u, columns), np.int32)
    fractions = np.empty((binning, 2, views_v * views_u, columns), np.float32)
    wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    for pixel_y in range(first_row, last_row):
        for sub_y in range(binning):
            y = pixel_y * binning + sub_y
            _place(disparity, y, margin, size, taps[sub_y], fractions[sub_y])
        for s in range(shots):
            for pixel_x in range(pixels_x):
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                at, end = starts[reading], starts[reading + 1]
                top, left, height, width = boxes[reading]
                merged = height > 0
                if merged:
                    cells[at:end] = 0
                for sub_y in range(binning):
                    y = pixel_y * binning + sub_y
                    for sub_x in range(binning):
                        x = pixel_x * binning + sub_x
                        for ray in range(views_v * views_u):
                            v, u = ray // views_u, ray % views_u
                            for k in range(stored):
                                w = weights[s, v, u, y, k, x]
                                if w == 0:
                                    continue
                                iy, ix = taps[sub_y, 0, ray, x], taps[sub_y, 1, ray, x]
                                fy, fx = fractions[sub_y, 0, ray, x], fractions[sub_y, 1, ray, x]
                                if merged:
                                    cubic(fy, wy)
                                    cubic(fx, wx)
                                    first = at + (k * height + iy - top) * width + ix - left
                                    for i in range(TAPS):
                                        share = w * wy[i]
                                        for j in range(TAPS):
                                            cells[first + i * width + j] += share * wx[j]
                                    continue
                                c = colour[s, y, x] if stored == 1 else k
                                taps_of[at] = (c * size[0] + iy) * size[1] + ix
                                cells[at + 1] = fy
                                cells[at + 2] = fx
                                cells[at + 3] = w
                                at += RAY


@njit(cache=True, fastmath=True, nogil=True)
def _read(laid, first_row, last_row, texture, frames):
    """Set pixel rows of frames (shot, pixel_y, pixel_x) to what they see of a flat texture."""
    colour, binning, size, stored, boxes, starts, cells, taps_of = laid
    shots, pixels_y, pixels_x = frames.shape
    wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    for pixel_y in range(first_row, last_row):
        for s in range(shots):
            for pixel_x in range(pixels_x):
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                at, end = starts[reading], starts[reading + 1]
                top, left, height, width = boxes[reading]
                total = np.float32(0)
                while at < end:
                    if height == 0:
                        tap = taps_of[at]
                        cubic(cells[at + 1], wy)
                        cubic(cells[at + 2], wx)
                        seen = np.float32(0)
                        for i in range(TAPS):
                            line = np.float32(0)
                            for j in range(TAPS):
                                line += wx[j] * texture[tap + i * size[1] + j]
                            seen += wy[i] * line
                        total += cells[at + 3] * seen
                        at += RAY
                        continue
                    for k in range(stored):
                        c = colour[s, pixel_y * binning, pixel_x * binning] if stored == 1 else k
                        first = (c * size[0] + top) * size[1] + left
                        for _ in range(height):
                            for j in range(width):
                                total += cells[at + j] * texture[first + j]
                            at += width
                            first += size[1]
                frames[s, pixel_y, pixel_x] = total


@njit(cache=True, fastmath=True, nogil=True)
def _return(laid, first_row, last_row, frames, texture):
    """Add to a flat texture what `_read` would see of it, times pixel rows of frames."""
    colour, binning, size, stored, boxes, starts, cells, taps_of = laid
    shots, pixels_y, pixels_x = frames.shape
    wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    for pixel_y in range(first_row, last_row):
        for s in range(shots):
            for pixel_x in range(pixels_x):
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                at, end = starts[reading], starts[reading + 1]
                top, left, height, width = boxes[reading]
                value = frames[s, pixel_y, pixel_x]
                if value == 0:
                    continue
                while at < end:
                    if height == 0:
                        tap = taps_of[at]
                        cubic(cells[at + 1], wy)
                        cubic(cells[at + 2], wx)
                        share = value * cells[at + 3]
                        for i in range(TAPS):
                            line = share * wy[i]
                            for j in range(TAPS):
                                texture[tap + i * size[1] + j] += line * wx[j]
                        at += RAY
                        continue
                    for k in range(stored):
                        c = colour[s, pixel_y * binning, pixel_x * binning] if stored == 1 else k
                        first = (c * size[0] + top) * size[1] + left
                        for _ in range(height):
                            for j in range(width):
                                texture[first + j] += cells[at + j] * value
                            at += width
                            first += size[1]


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the readings of a band of pixel rows see a texture. reach_rows: see `reach_rows`."""

    rows: range
    cells: Cells
    reach_rows: float

    def read(self, texture: Array, frames: Array) -> None:
        """Set the rows of frames (shot, pixel_y, pixel_x) to what they see of (c, y, x)."""
        start, texture = self.rows.start, np.ascontiguousarray(texture, dtype=np.float32)

        def work(_: int, first: int, last: int) -> None:
            _read(self.cells, start + first, start + last, texture.reshape(-1), frames)

        in_bands(work, len(self.rows))

    def add_adjoint(self, frames: Array, sums: Array) -> None:
        """Add the adjoint of `read` of float32 frames to sums (2, flat texture), by two threads."""
        start = self.rows.start

        def work(which: int, first: int, last: int) -> None:
            _return(self.cells, start + first, start + last, frames, sums[which])

        summed_in_bands(work, len(self.rows), self.reach_rows)


def _reach_rows(psi: ImagingMatrix, disparity: Array) -> float:
    """Return how many rows of pixels away from its own a pixel's taps lie, at most.

    disparity: (v, u, y, x).
    """
    steps = np.abs(np.arange(len(disparity)) - len(disparity) // 2)
    furthest = float((np.abs(disparity).max(axis=(1, 2, 3)) * steps).max())
    return (furthest + TAPS / 2) / psi.binning


def laid_out(
    psi: ImagingMatrix, disparity: Array, margin: int, shape: tuple[int, int, int]
) -> Iterator[Layout]:
    """Yield where bands of pixel rows see textures (c, y, x) of a shape, MOST_CELLS at a time.

    disparity: (v, u, y, x).
    """
    readings, rows = int(np.prod(psi.frames_shape)), psi.frames_shape[1]
    counts = np.zeros(readings, dtype=np.int64)
    boxes = np.zeros((readings, 4), dtype=np.int32)
    size, stored = shape[1:], psi.weights.shape[4]

    def measure(_: int, first: int, last: int) -> None:
        _measure(psi.weights, disparity, margin, psi.binning, size, first, last, boxes, counts)

    in_bands(measure, rows)
    by_row = counts.reshape(psi.frames_shape)
    before = np.cumsum(by_row.sum(axis=(0, 2))) - 1
    cuts = np.flatnonzero(np.diff(before // max(MOST_CELLS, 1))) + 1
    for begin, end in pairwise([0, *cuts.tolist(), rows]):
        within = np.zeros_like(by_row)
        within[:, begin:end] = by_row[:, begin:end]
        starts = np.concatenate([[0], np.cumsum(within)])
        values = np.empty(starts[-1], dtype=np.float32)
        cells = Cells(
            psi.colour_map, psi.binning, size, stored, boxes, starts, values, values.view(np.int32)
        )

        def lay(_: int, first: int, last: int, begin: int = begin, cells: Cells = cells) -> None:
            _lay(psi.weights, disparity, margin, cells, begin + first, begin + last)

        in_bands(lay, end - begin)
        yield Layout(range(begin, end), cells, _reach_rows(psi, disparity))

"""Psi of textured surfaces, laid out for many products: where its rays meet the texture.

Where the rays of a reading meet the texture close together, which all but large disparities make
them do, their taps are summed to a box of the texture, 2 bytes a sample and rows of whole vectors
(`lanes`); else each ray that is not dark is kept, 16 bytes. Operations of a product: a sample of a
box 2, a ray 64; of laying out: about 60 a ray. Where all cells together are too many, they are laid
out anew, a band of rows at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands, summed_in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.lanes import (
    LANES,
    TAPS,
    add_box,
    add_taps,
    read_box,
    read_taps,
)

Array = NDArray[np.floating]
MOST_ROWS = 30_000_000
"""Of cells that are held at a time: 16 bytes each."""
BOX_ROWS = 3
"""Rows of a box for every ray that it sums, at most: a ray takes as long as three or four rows."""
FINEST = 32767
"""Steps of a box's cells up to its largest: 16 bits, of which rounding takes 1e-5 of a reading."""


class Cells(NamedTuple):
    """Where readings see a texture: as boxes of cells, or ray by ray.

    Attributes:
        colour: Psi's map of colours, (shot, y, x).
        binning: samples k along a pixel's side.
        size: rows and columns of a texture.
        stored: colours stored in Psi's weights, 1 or 3.
        boxes: first row, first column, height and vectors of a row, (reading, 4); height 0: rays.
        starts: where each reading's rows of `values` begin, (reading + 1,).
        scales: units of a box's values, (reading,).
        values: rows of a box, int16, (row, LANES); a reading of rays has a row for each ray.
        rays: the same memory as float32, (row, 4): fractions along y and x in columns 1 and 2,
            weight in column 3.
        taps: the same memory as int32, (row, 4): index of the ray's first tap in column 0.
    """

    colour: Any
    binning: Any
    size: Any
    stored: Any
    boxes: Any
    starts: Any
    scales: Any
    values: Any
    rays: Any
    taps: Any


@njit(forceinline=True, fastmath=True)
def _place(disparity, moved, y, margin, size, taps, fractions):
    """Set taps and fractions (2, ray, x) of row y's rays, along y and x.

    moved: (2, v, u, y, x), what is added to where each ray meets the texture; or one row of zeros.
    """
    views_v, views_u, _, _ = disparity.shape
    still = moved.shape[1] == 1
    ahead, none, unit = np.float32(margin - 1), np.float32(0), np.float32(1)
    last_y, last_x = np.float32(size[0] - TAPS), np.float32(size[1] - TAPS)
    for v in range(views_v):
        for u in range(views_u):
            ray, row = v * views_u + u, disparity[v, u, y]
            dv, du = np.float32(v - views_v // 2), np.float32(u - views_u // 2)
            by = moved[:, 0, 0, 0] if still else moved[:, v, u, y]
            where = taps[:, ray], fractions[:, ray]
            _along(row, by[0], np.float32(y), none, dv, ahead, last_y, where[0][0], where[1][0])
            _along(row, by[1], none, unit, du, ahead, last_x, where[0][1], where[1][1])


@njit(forceinline=True, fastmath=True)
def _along(row, moved, start, step, by, ahead, last, taps, parts):
    """Set taps and fractions of a row of rays along one axis.

    An axis at a time: a compiler vectorises no loop that sets many arrays, which might overlap.
    """
    none, full = np.float32(0), np.float32(1)
    for x in range(row.size):
        at = start + step * np.float32(np.int32(x)) - row[x] * by + moved[x]
        whole = np.floor(at)
        first = whole + ahead
        part = none if first < none else at - whole
        parts[x] = full if first > last else part
        taps[x] = np.int32(min(max(first, none), last))


@njit(forceinline=True)
def _bound(weights, y, taps, reach):
    """Widen reach (5, x) by row y's rays: first and last taps along y and x, and entries.

    weights: (v, u, y, stored, x) of one shot.
    """
    views_v, views_u, _, stored, _ = weights.shape
    for v in range(views_v):
        for u in range(views_u):
            ray = v * views_u + u
            for k in range(stored):
                row = weights[v, u, y, k]
                _widen(row, taps[0, ray], reach[0], reach[1])
                _widen(row, taps[1, ray], reach[2], reach[3])
                entries = reach[4]
                for x in range(row.size):
                    entries[x] += np.int32(1) if row[x] != 0 else np.int32(0)


@njit(forceinline=True)
def _widen(row, taps, first, last):
    """Let first and last include the taps of rays that are not dark."""
    for x in range(row.size):
        seen = row[x] != 0
        first[x] = min(first[x], taps[x] if seen else first[x])
        last[x] = max(last[x], taps[x] if seen else last[x])


@njit(cache=True, nogil=True)
def _measure(weights, disparity, moved, margin, binning, size, first_row, last_row, boxes, counts):
    """Set boxes (reading, 4) and the rows of cells that they or their rays take, see `Cells`."""
    shots, views_v, views_u, _, stored, columns = weights.shape
    pixels_y, pixels_x = weights.shape[3] // binning, columns // binning
    taps = np.empty((binning, 2, views_v * views_u, columns), np.int32)
    fractions = np.empty((2, views_v * views_u, columns), np.float32)
    reach = np.empty((5, columns), np.int32)
    for pixel_y in range(first_row, last_row):
        for sub_y in range(binning):
            y = pixel_y * binning + sub_y
            _place(disparity, moved, y, margin, size, taps[sub_y], fractions)
        for s in range(shots):
            reach[0], reach[2], reach[1], reach[3], reach[4] = size[0], size[1], 0, 0, 0
            for sub_y in range(binning):
                _bound(weights[s], pixel_y * binning + sub_y, taps[sub_y], reach)
            for pixel_x in range(pixels_x):
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                begin = pixel_x * binning
                top, bottom, left, right, entries = (
                    reach[0, begin], reach[1, begin], reach[2, begin], reach[3, begin],
                    reach[4, begin],
                )  # fmt: skip
                for x in range(begin + 1, begin + binning):
                    top, bottom = min(top, reach[0, x]), max(bottom, reach[1, x])
                    left, right = min(left, reach[2, x]), max(right, reach[3, x])
                    entries += reach[4, x]
                boxes[reading] = 0
                counts[reading] = entries
                if entries == 0:
                    continue
                height = bottom - top + TAPS
                vectors = -(-(right - left + TAPS) // LANES)
                rows = height * vectors * stored
                if rows <= BOX_ROWS * entries and vectors * LANES <= size[1]:
                    boxes[reading, 0] = top
                    boxes[reading, 1] = min(left, size[1] - vectors * LANES)
                    boxes[reading, 2], boxes[reading, 3] = height, vectors
                    counts[reading] = rows


@njit(cache=True, fastmath=True, nogil=True)
def _lay(weights, disparity, moved, margin, laid, first_row, last_row):
    """Set the cells of readings: boxes of taps, or rays.

    For each reading, over its rays that are not dark, of weight w and cubic taps W(fraction):

        box(y, x) += w W_y W_x, then rounded to FINEST steps of its largest; or
        rays(n) = (first tap, fraction along y, along x, w).
    """
    colour, binning, size, stored, boxes, starts, scales, values, rays, taps_of = laid
    shots, views_v, views_u, _, _, columns = weights.shape
    pixels_y, pixels_x = weights.shape[3] // binning, columns // binning
    views = views_v * views_u
    taps = np.empty((binning, 2, views, columns), np.int32)
    fractions = np.empty((binning, 2, views, columns), np.float32)
    lit, light = np.empty(views + 1, np.int32), np.empty(views + 1, np.float32)
    flat = values.reshape(-1)
    box = np.empty(BOX_ROWS * LANES * binning * binning * views * stored, np.float32)
    for pixel_y in range(first_row, last_row):
        for sub_y in range(binning):
            y = pixel_y * binning + sub_y
            _place(disparity, moved, y, margin, size, taps[sub_y], fractions[sub_y])
        for s in range(shots):
            for pixel_x in range(pixels_x):
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                at, end = starts[reading], starts[reading + 1]
                top, left, height = boxes[reading, 0], boxes[reading, 1], boxes[reading, 2]
                width = boxes[reading, 3] * LANES
                cells = (end - at) * LANES if height > 0 else 0
                for n in range(cells):
                    box[n] = 0
                for sub_y in range(binning):
                    y = pixel_y * binning + sub_y
                    for sub_x in range(binning):
                        x = pixel_x * binning + sub_x
                        for k in range(stored):
                            # Listed first: no processor predicts which rays are dark.
                            count = 0
                            for v in range(views_v):
                                for u in range(views_u):
                                    w = weights[s, v, u, y, k, x]
                                    lit[count], light[count] = v * views_u + u, w
                                    count += 1 if w != 0 else 0
                            c = colour[s, y, x] if stored == 1 else k
                            for n in range(count):
                                ray, w = lit[n], light[n]
                                iy, ix = taps[sub_y, 0, ray, x], taps[sub_y, 1, ray, x]
                                fy, fx = fractions[sub_y, 0, ray, x], fractions[sub_y, 1, ray, x]
                                if height > 0:
                                    first = (k * height + iy - top) * width + ix - left
                                    add_taps(box, first, width, fy, fx, w)
                                    continue
                                taps_of[at, 0] = (c * size[0] + iy) * size[1] + ix
                                rays[at, 1], rays[at, 2], rays[at, 3] = fy, fx, w
                                at += 1
                if height == 0:
                    rays[at:end] = 0
                    continue
                largest = np.float32(1e-30)
                for n in range(cells):
                    largest = max(largest, abs(box[n]))
                scales[reading] = largest / FINEST
                steps = np.float32(FINEST) / largest
                for n in range(cells):
                    flat[at * LANES + n] = np.int16(np.rint(box[n] * steps))


@njit(cache=True, fastmath=True, nogil=True)
def _pass(laid, first_row, last_row, texture, frames, precision, missed):
    """Add to a flat texture the adjoint of what a texture T misses of frames I, times precision.

    For each reading p with cells A_p (a box, or rays):

        share   = precision_p (I_p - A_p . T)
        missed += share A_p

    One pass reads and returns the cells of a reading, which then are in the processor's cache.
    missed empty: frames are set to A_p . T instead. frames, precision: (shot, pixel_y, pixel_x).
    """
    colour, binning, size, stored, boxes, starts, scales, values, rays, taps = laid
    shots, pixels_y, pixels_x = frames.shape
    wide, read_only = size[1], missed.size == 0
    for pixel_y in range(first_row, last_row):
        for s in range(shots):
            for pixel_x in range(pixels_x):
                weight = precision[s, pixel_y, pixel_x]
                if weight == 0:
                    continue
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                at, end, seen = starts[reading], starts[reading + 1], np.float32(0)
                height, vectors, scale = boxes[reading, 2], boxes[reading, 3], scales[reading]
                c = colour[s, pixel_y * binning, pixel_x * binning] if stored == 1 else 0
                first = (c * size[0] + boxes[reading, 0]) * wide + boxes[reading, 1]
                if height == 0:
                    for row in range(at, end):
                        fy, fx, w = rays[row, 1], rays[row, 2], rays[row, 3]
                        seen += w * read_taps(texture, taps[row, 0], wide, fy, fx)
                else:
                    for k in range(stored):
                        box = first + k * size[0] * wide, at + k * height * vectors
                        seen += scale * read_box(
                            texture, box[0], wide, values, box[1], height, vectors
                        )
                if read_only:
                    frames[s, pixel_y, pixel_x] = seen
                    continue
                share = weight * (frames[s, pixel_y, pixel_x] - seen)
                if height == 0:
                    for row in range(at, end):
                        fy, fx, w = rays[row, 1], rays[row, 2], rays[row, 3]
                        add_taps(missed, taps[row, 0], wide, fy, fx, share * w)
                else:
                    for k in range(stored):
                        box = first + k * size[0] * wide, at + k * height * vectors
                        add_box(
                            missed, box[0], wide, values, box[1], height, vectors, scale * share
                        )


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the readings of a band of pixel rows see a texture. reach_rows: see `reach_rows`."""

    rows: range
    cells: Cells
    reach_rows: float

    def read(self, texture: Array, frames: Array) -> None:
        """Set the rows of frames (shot, pixel_y, pixel_x) to what they see of (c, y, x)."""
        start, texture = self.rows.start, np.ascontiguousarray(texture, dtype=np.float32)
        all_of_them, nothing = np.ones_like(frames), np.empty(0, dtype=np.float32)

        def work(_: int, first: int, last: int) -> None:
            rows = start + first, start + last
            _pass(self.cells, *rows, texture.reshape(-1), frames, all_of_them, nothing)

        in_bands(work, len(self.rows))

    def add_missed(self, texture: Array, frames: Array, precision: Array, sums: Array) -> None:
        """Add the adjoint of precision * (frames - what they see of a texture) to sums.

        texture: (c, y, x); frames, precision: (shot, pixel_y, pixel_x), all float32 and contiguous.
        sums: (2, flat texture), of which bands of rows side by side take turns.
        """
        start, texture = self.rows.start, texture.reshape(-1)

        def work(which: int, first: int, last: int) -> None:
            rows = start + first, start + last
            _pass(self.cells, *rows, texture, frames, precision, sums[which])

        summed_in_bands(work, len(self.rows), self.reach_rows)


def _reach_rows(psi: Psi, disparity: Array) -> float:
    """Return how many rows of pixels away from its own a pixel's taps lie, at most.

    disparity: (v, u, y, x).
    """
    steps = np.abs(np.arange(len(disparity)) - len(disparity) // 2)
    furthest = float((np.abs(disparity).max(axis=(1, 2, 3)) * steps).max())
    return (furthest + TAPS / 2) / psi.binning


def laid_out(
    psi: Psi,
    disparity: Array,
    margin: int,
    shape: tuple[int, int, int],
    alike: Layout | None = None,
    moved: Array | None = None,
) -> Iterator[Layout]:
    """Yield where bands of pixel rows see textures (c, y, x) of a shape, MOST_ROWS at a time.

    disparity: of every ray, (v, u, y, x). alike: the layout of all rows of another Psi, both of one
    colour in store, of the same disparity; its dark rays are dark in this Psi, too. moved: (2, v,
    u, y, x), by which rays meet the texture elsewhere, along y and x.
    """
    reach_rows = _reach_rows(psi, disparity)
    if moved is None:
        moved = np.zeros((2, 1, 1, 1, psi.size[1]), dtype=np.float32)
    else:
        reach_rows += float(np.abs(moved[0]).max()) / psi.binning
    readings, rows = int(np.prod(psi.frames_shape)), psi.frames_shape[1]
    size, stored = shape[1:], psi.weights.shape[4]
    if alike is not None:
        boxes, counts = alike.cells.boxes, np.diff(alike.cells.starts)
    else:
        counts = np.zeros(readings, dtype=np.int64)
        boxes = np.zeros((readings, 4), dtype=np.int32)

        def measure(_: int, first: int, last: int) -> None:
            _measure(
                psi.weights, disparity, moved, margin, psi.binning, size, first, last, boxes, counts
            )

        in_bands(measure, rows)
    by_row = counts.reshape(psi.frames_shape)
    before = np.cumsum(by_row.sum(axis=(0, 2))) - 1
    cuts = np.flatnonzero(np.diff(before // max(MOST_ROWS, 1))) + 1
    scales = np.empty(readings, dtype=np.float32)
    for begin, end in pairwise([0, *cuts.tolist(), rows]):
        within = np.zeros_like(by_row)
        within[:, begin:end] = by_row[:, begin:end]
        starts = np.concatenate([[0], np.cumsum(within)])
        values = np.empty((starts[-1], LANES), dtype=np.int16)
        rays, taps = values.view(np.float32), values.view(np.int32)
        cells = Cells(
            psi.colour_map, psi.binning, size, stored, boxes, starts, scales, values, rays, taps
        )

        def lay(_: int, first: int, last: int, begin: int = begin, cells: Cells = cells) -> None:
            _lay(psi.weights, disparity, moved, margin, cells, begin + first, begin + last)

        in_bands(lay, end - begin)
        yield Layout(range(begin, end), cells, reach_rows)

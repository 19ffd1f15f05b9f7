"""Psi of textured surfaces as a sparse matrix: far quicker than following every ray each time.

Where the rays of a reading meet the texture close together, which small disparities make them do,
their taps are summed first: a reading then takes a few dozen entries instead of 16 for each of its
rays. The same walk, each tap times the texture's slope, makes the derivative by the disparity.
"""

from __future__ import annotations

from math import floor

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.bands import in_bands

Array = NDArray[np.floating]
TAPS = 4
MOST_ENTRIES = 120_000_000
"""Beyond which rays are followed instead: 8 bytes each."""
NO_SLOPES = np.zeros((2, 1, 1, 1), dtype=np.float32)


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


@njit(cache=True, nogil=True)
def _walk(
    weights,
    colour,
    disparity,
    hidden,
    slopes,
    margin,
    binning,
    size,
    colours,
    first_row,
    last_row,
    starts,
    columns,
    values,
):
    """Count the entries of readings into starts (reading,), or, given columns, set the entries.

    size: (y, x) of the padded texture, of so many colours. Pixel rows first_row to last_row - 1.
    starts: where each reading's entries begin, (reading + 1,), when there are columns. slopes:
    (2, c, y, x), of which derivatives by the disparity are made, or of one sample: entries of Psi.
    """
    shots, views_v, views_u, _, stored, samples_x = weights.shape
    pixels_y, pixels_x = weights.shape[3] // binning, samples_x // binning
    counting = columns.size == 0
    derivative = slopes.shape[2] > 1
    plane = size[0] * size[1]
    last_y, last_x = size[0] - TAPS, size[1] - TAPS
    wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    for s in range(shots):
        for pixel_y in range(first_row, last_row):
            for pixel_x in range(pixels_x):
                reading = (s * pixels_y + pixel_y) * pixels_x + pixel_x
                top, left, bottom, right = last_y, last_x, 0, 0
                entries, behind = 0, False
                for y in range(pixel_y * binning, (pixel_y + 1) * binning):
                    for x in range(pixel_x * binning, (pixel_x + 1) * binning):
                        for v in range(views_v):
                            for u in range(views_u):
                                here = 0
                                for k in range(stored):
                                    here += weights[s, v, u, y, k, x] != 0
                                layer = hidden[v, u, y, x]
                                if here == 0 or (derivative and layer > 0):
                                    continue
                                d = disparity[v, u, y, x]
                                iy, _ = first_tap(y - d * (v - views_v // 2), margin, last_y)
                                ix, _ = first_tap(x - d * (u - views_u // 2), margin, last_x)
                                top, bottom = min(top, iy), max(bottom, iy)
                                left, right = min(left, ix), max(right, ix)
                                behind = behind or layer > 0
                                entries += here
                if entries == 0:
                    if counting:
                        starts[reading] = 0
                    continue
                height, width = bottom - top + TAPS, right - left + TAPS
                area = height * width
                kinds = 1 if derivative else stored
                merged = not behind and area * kinds <= TAPS * TAPS * entries
                if counting:
                    starts[reading] = area * kinds if merged else TAPS * TAPS * entries
                    continue
                at = starts[reading]
                if merged:
                    for kind in range(kinds):
                        c = 0 if derivative else kind
                        if stored == 1 and not derivative:
                            c = colour[s, pixel_y * binning, pixel_x * binning]
                        for i in range(height):
                            for j in range(width):
                                n = at + kind * area + i * width + j
                                columns[n] = c * plane + (top + i) * size[1] + left + j
                                values[n] = 0
                for y in range(pixel_y * binning, (pixel_y + 1) * binning):
                    for x in range(pixel_x * binning, (pixel_x + 1) * binning):
                        for v in range(views_v):
                            for u in range(views_u):
                                layer = hidden[v, u, y, x]
                                if derivative and layer > 0:
                                    continue
                                d = disparity[v, u, y, x]
                                step_y, step_x = v - views_v // 2, u - views_u // 2
                                placed = False
                                iy, ix = 0, 0
                                for k in range(stored):
                                    w = weights[s, v, u, y, k, x]
                                    if w == 0:
                                        continue
                                    if not placed:
                                        iy, fy = first_tap(y - d * step_y, margin, last_y)
                                        ix, fx = first_tap(x - d * step_x, margin, last_x)
                                        cubic(fy, wy)
                                        cubic(fx, wx)
                                        placed = True
                                    c = colour[s, y, x] if stored == 1 else k
                                    for i in range(TAPS):
                                        for j in range(TAPS):
                                            value = w * wy[i] * wx[j]
                                            if derivative:
                                                value *= -(
                                                    step_y * slopes[0, c, iy + i, ix + j]
                                                    + step_x * slopes[1, c, iy + i, ix + j]
                                                )
                                            if merged:
                                                n = starts[reading]
                                                if not derivative and stored > 1:
                                                    n += k * area
                                                n += (iy + i - top) * width + ix + j - left
                                                values[n] += value
                                            else:
                                                place = (iy + i) * size[1] + ix + j
                                                if not derivative:
                                                    place += (layer * colours + c) * plane
                                                columns[at] = place
                                                values[at] = value
                                                at += 1


def assembled(
    psi: ImagingMatrix,
    disparity: Array,
    hidden: NDArray[np.uint8],
    margin: int,
    slopes: Array | None = None,
    colours: int = 3,
) -> sparse.csr_array | None:
    """Return Psi of surfaces, (readings, 2 x colours x texture); None where it grew too large.

    disparity, hidden: (v, u, y, x). slopes: (2, c, y, x), derivatives of the padded texture along
    y and x: then return the derivative by the centre view's disparity, (readings, texture).
    """
    rows, columns = psi.size
    size = rows + 2 * margin, columns + 2 * margin
    readings = int(np.prod(psi.frames_shape))
    derivative = slopes is not None
    slopes = NO_SLOPES if slopes is None else np.ascontiguousarray(slopes)
    counts = np.zeros(readings, dtype=np.int64)

    def walk(
        starts: NDArray[np.int64], places: NDArray[np.int32], values: NDArray[np.float32]
    ) -> None:
        def work(_: int, first: int, last: int) -> None:
            _walk(
                psi.weights,
                psi.colour_map,
                disparity,
                hidden,
                slopes,
                margin,
                psi.binning,
                size,
                colours,
                first,
                last,
                starts,
                places,
                values,
            )

        in_bands(work, psi.frames_shape[1])

    nothing = np.empty(0, dtype=np.int32)
    walk(counts, nothing, np.empty(0, dtype=np.float32))
    starts = np.concatenate([[0], np.cumsum(counts)])
    if starts[-1] > MOST_ENTRIES:
        return None
    places = np.empty(starts[-1], dtype=np.int32)
    values = np.empty(starts[-1], dtype=np.float32)
    walk(starts, places, values)
    width = size[0] * size[1] * (1 if derivative else 2 * colours)
    return sparse.csr_array((values, places, starts.astype(np.int32)), shape=(readings, width))

"""Which surface every ray sees: the centre view's disparity carried to all views, nearest in front.

Rays that no point of the centre view reaches are hidden from it: they are given the disparity of
the further of the surfaces beside them.
"""

from __future__ import annotations

from math import floor

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands
from emmc_rig.model.compiling import njit

Array = NDArray[np.floating]
REACH = 0.75
"""A point covers the samples within this distance along each axis."""
SAME_SURFACE = 0.35
"""Disparities that differ less, in pixels, are those of one surface."""


@njit(cache=True, nogil=True)
def _carry(centre, margin, nearer, dv, du, out, mark):
    """Set out and mark (y, x) to disparities and hidden rays of the view dv, du steps off."""
    rows, columns = out.shape
    for y in range(rows):
        for x in range(columns):
            out[y, x] = np.nan
            mark[y, x] = 0
    for qy in range(centre.shape[0]):
        for qx in range(centre.shape[1]):
            d = centre[qy, qx]
            ty, tx = qy - margin + d * dv, qx - margin + d * du
            y0, x0 = floor(ty), floor(tx)
            for y in range(y0, y0 + 2):
                if y < 0 or y >= rows or abs(y - ty) > REACH:
                    continue
                for x in range(x0, x0 + 2):
                    if x < 0 or x >= columns or abs(x - tx) > REACH:
                        continue
                    before = out[y, x]
                    if np.isnan(before) or nearer * (d - before) > 0:
                        out[y, x] = d
    for y in range(rows):
        for x in range(columns):
            if np.isnan(out[y, x]):
                _fill(out, y, x, nearer, mark)
    for y in range(rows):
        for x in range(columns):
            if mark[y, x] == 0:
                out[y, x] = _settled(centre, margin, out[y, x], y, x, dv, du)


@njit(forceinline=True)
def _fill(out, y, x, nearer, mark):
    """Give a ray that no point reaches the furthest disparity seen next along rows and columns."""
    rows, columns = out.shape
    found = np.float32(0)
    have = False
    for direction in range(4):
        step_y = (0, 0, -1, 1)[direction]
        step_x = (-1, 1, 0, 0)[direction]
        yy, xx = y + step_y, x + step_x
        while 0 <= yy < rows and 0 <= xx < columns:
            if not np.isnan(out[yy, xx]) and mark[yy, xx] == 0:
                if not have or nearer * (out[yy, xx] - found) < 0:
                    found = out[yy, xx]
                    have = True
                break
            yy += step_y
            xx += step_x
    out[y, x] = found
    mark[y, x] = 1


@njit(forceinline=True)
def _settled(centre, margin, d, y, x, dv, du):
    """Return the disparity of a ray on a slanted surface: that of the point it meets there."""
    last_y, last_x = centre.shape[0] - 2, centre.shape[1] - 2
    for _ in range(3):
        py, px = y + margin - d * dv, x + margin - d * du
        iy, ix = min(max(floor(py), 0), last_y), min(max(floor(px), 0), last_x)
        fy, fx = min(max(py - iy, 0.0), 1.0), min(max(px - ix, 0.0), 1.0)
        met = (1 - fy) * ((1 - fx) * centre[iy, ix] + fx * centre[iy, ix + 1]) + fy * (
            (1 - fx) * centre[iy + 1, ix] + fx * centre[iy + 1, ix + 1]
        )
        if abs(met - d) > SAME_SURFACE:
            break
        d = met
    return d


def carried(
    centre: Array, margin: int, nearer: int, shape: tuple[int, int, int, int]
) -> tuple[Array, NDArray[np.uint8]]:
    """Return every ray's disparity and whether the centre view cannot see it, both (v, u, y, x).

    centre: the centre view's disparity, padded by `margin` samples. nearer: 1 when points of
    larger disparity are in front, -1 when they are behind. shape: (v, u, y, x).
    """
    disparity = np.empty(shape, dtype=np.float32)
    hidden = np.empty(shape, dtype=np.uint8)
    centre = np.ascontiguousarray(centre, dtype=np.float32)

    def work(_: int, first: int, last: int) -> None:
        for v, u in list(np.ndindex(shape[:2]))[first:last]:
            dv, du = v - shape[0] // 2, u - shape[1] // 2
            _carry(centre, margin, nearer, dv, du, disparity[v, u], hidden[v, u])

    in_bands(work, shape[0] * shape[1])
    return disparity, hidden

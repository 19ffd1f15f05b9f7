"""Which surface every ray sees: the centre view's disparity carried to all views, nearest in front.

Rays that no point of the centre view reaches are hidden from it: they are given the disparity of
the further of the surfaces beside them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_views
from emmc_rig.model.compiling import njit

Array = NDArray[np.floating]
REACH = 0.75
"""A point covers the samples within this distance along each axis."""
SAME_SURFACE = 0.35
"""Pixels: disparities with a smaller difference belong to the same surface."""
SETTLING = 2
"""Steps to the point that a ray meets on a slanted surface."""
EMPTY = np.float32(-1e30)
"""Mark of rays that no point reaches, until a disparity is filled in."""


@njit(cache=True, fastmath=True, nogil=True)
def _carry(centre, margin, nearer, dv, du, out, mark):
    """Set out and mark (y, x) to disparities and hidden rays of the view dv, du steps off.

    A point covers one or two samples along each axis: it is written to four places, some equal.
    Points outside of the view are written to a margin of samples.
    """
    rows, columns = out.shape
    wide = columns + 2
    front = np.full((rows + 2) * wide, EMPTY, np.float32)
    top, bottom = np.empty((2, centre.shape[1]), np.int32)
    left, right = np.empty((2, centre.shape[1]), np.int32)
    far, none = np.float32(REACH), np.float32(0)
    last_y, last_x = np.float32(rows + 1), np.float32(columns + 1)
    for qy in range(centre.shape[0]):
        line = centre[qy]
        for qx in range(line.size):
            ty = np.float32(qy - margin + 1) + line[qx] * dv
            tx = np.float32(qx - margin + 1) + line[qx] * du
            top[qx] = np.int32(min(max(np.floor(ty + (1 - far)), none), last_y))
            bottom[qx] = np.int32(min(max(np.floor(ty + far), none), last_y))
            left[qx] = np.int32(min(max(np.floor(tx + (1 - far)), none), last_x))
            right[qx] = np.int32(min(max(np.floor(tx + far), none), last_x))
        for qx in range(line.size):
            d = nearer * line[qx]
            upper, lower = top[qx] * wide, bottom[qx] * wide
            for at in (
                upper + left[qx], upper + right[qx], lower + left[qx], lower + right[qx],
            ):  # fmt: skip
                front[at] = max(front[at], d)
    for y in range(rows):
        for x in range(columns):
            d = front[(y + 1) * wide + x + 1]
            out[y, x] = nearer * d
            mark[y, x] = d == EMPTY
    for y in range(rows):
        for x in range(columns):
            if mark[y, x]:
                _fill(out, y, x, nearer, mark)
    _settle(centre, margin, dv, du, out, mark)


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
            if not mark[yy, xx]:
                if not have or nearer * (out[yy, xx] - found) < 0:
                    found = out[yy, xx]
                    have = True
                break
            yy += step_y
            xx += step_x
    out[y, x] = found


@njit(forceinline=True, fastmath=True)
def _settle(centre, margin, dv, du, out, mark):
    """Set the disparity of rays on slanted surfaces to that of the points they meet there.

    Places first, then what lies there: a loop that does both is not vectorised.
    """
    flat, wide = centre.reshape(-1), np.int32(centre.shape[1])
    last_y, last_x = np.int32(centre.shape[0] - 2), np.int32(centre.shape[1] - 2)
    low, high_y, high_x = np.float32(0), np.float32(last_y + 1), np.float32(last_x + 1)
    near, columns = np.float32(SAME_SURFACE), out.shape[1]
    right, under = np.uint32(1), np.uint32(wide)
    # Unsigned: an index that may be negative is counted from the end, which takes time.
    place, parts = np.empty(columns, np.uint32), np.empty((2, columns), np.float32)
    down, along = parts[0], parts[1]
    for y in range(out.shape[0]):
        line, hidden = out[y], mark[y]
        for _ in range(SETTLING):
            for x in range(columns):
                py = min(max(np.float32(y + margin) - line[x] * dv, low), high_y)
                px = min(max(np.float32(np.int32(x) + margin) - line[x] * du, low), high_x)
                iy, ix = min(np.int32(py), last_y), min(np.int32(px), last_x)
                down[x], along[x] = py - np.float32(iy), px - np.float32(ix)
                place[x] = np.uint32(iy * wide + ix)
            for x in range(columns):
                d, at, fx = line[x], place[x], along[x]
                above = flat[at] + fx * (flat[at + right] - flat[at])
                below = flat[at + under]
                below += fx * (flat[at + under + right] - below)
                met = above + down[x] * (below - above)
                same = (abs(met - d) <= near) & (hidden[x] == 0)
                line[x] = met if same else d


def carried(
    centre: Array, margin: int, nearer: int, shape: tuple[int, int, int, int]
) -> tuple[Array, NDArray[np.uint8]]:
    """Return every ray's disparity and whether the centre view cannot see it, both (v, u, y, x).

    centre: the centre view's disparity, padded by `margin` samples. nearer: 1 when points of
    larger disparity are in front, -1 when they are behind. shape: (v, u, y, x).
    """
    disparity = np.empty(shape, dtype=np.float32)
    hidden = np.empty(shape, dtype=np.uint8)
    centre, front = np.ascontiguousarray(centre, dtype=np.float32), np.float32(nearer)

    def work(view: tuple[int, int]) -> None:
        dv, du = (np.float32(at - n // 2) for at, n in zip(view, shape, strict=False))
        _carry(centre, margin, front, dv, du, disparity[view], hidden[view])

    in_views(work, shape[:2])
    return disparity, hidden

"""Fused loops of primal-dual total variation on the kernels' axes (v, u, y, colour, x).

The dual variable has axes (v, u, y, direction, colour, x), directions x, y, u, v: forward
differences, 0 across the far border. One sweep reads and writes the light field and the dual
variable once: rows of pixels are taken in order, the primal step of a row is followed by the dual
step of the row before it while both are in cache. Bands of rows run in parallel; the dual step of
a band's last row needs the next band's first and is done after all bands.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from emmc_rig.model.kernels import correct_row, gather_row, spread_row


@njit(cache=True, inline="always", fastmath=True)
def _descend(light_field, dual, step, v, u, y, out):
    """Set out (colour, x) to the light field less step times the adjoint gradient of the dual."""
    width = light_field.shape[4]
    here = dual[v, u, y]
    for c in range(3):
        gx, gy, gu, gv = here[0, c], here[1, c], here[2, c], here[3, c]
        row = light_field[v, u, y, c]
        line = out[c]
        for x in range(width):
            line[x] = row[x] + step * (gx[x] + gy[x] + gu[x] + gv[x])
        for x in range(1, width):
            line[x] -= step * gx[x - 1]
        if y > 0:
            gy = dual[v, u, y - 1, 1, c]
            for x in range(width):
                line[x] -= step * gy[x]
        if u > 0:
            gu = dual[v, u - 1, y, 2, c]
            for x in range(width):
                line[x] -= step * gu[x]
        if v > 0:
            gv = dual[v - 1, u, y, 3, c]
            for x in range(width):
                line[x] -= step * gv[x]


@njit(cache=True, fastmath=True)
def _primal_rows(
    weights, colour, inverse, frames, binning, light_field, dual, step, relax, row, ahead, moved
):
    """Do the primal step of one row of pixels; ahead (v, u, part, colour, x) = 2 new - old."""
    shots, views_v, views_u, _, _, width = weights.shape
    base = row * binning
    for v in range(views_v):
        for u in range(views_u):
            for part in range(binning):
                _descend(light_field, dual, step, v, u, base + part, ahead[v, u, part])
    seen = np.zeros((shots, width), frames.dtype)
    for shot in range(shots):
        for part in range(binning):
            gather_row(weights, colour, ahead, part, shot, base + part, seen[shot])
    correct_row(inverse, frames, binning, row, seen)
    change = 0.0
    power = 0.0
    for v in range(views_v):
        for u in range(views_u):
            for part in range(binning):
                y = base + part
                for shot in range(shots):
                    spread_row(weights, colour, seen[shot], shot, y, v, u, ahead[v, u, part])
                for c in range(3):
                    old = light_field[v, u, y, c]
                    line = ahead[v, u, part, c]
                    row_change = np.float32(0)
                    row_power = np.float32(0)
                    for x in range(width):
                        delta = line[x] - old[x]
                        line[x] += delta
                        old[x] += relax * delta
                        row_change += delta * delta
                        row_power += old[x] * old[x]
                    change += row_change
                    power += row_power
    moved[row, 0] = change
    moved[row, 1] = power


@njit(cache=True, fastmath=True)
def _dual_rows(ahead, below, has_below, dual, base, step, bound, relax):
    """Do the dual step of the rows of `ahead` (v, u, part, colour, x); `below`: the next block."""
    views_v, views_u, parts, _, width = ahead.shape
    raised = np.empty((4, 3, width), dual.dtype)
    size = np.empty(width, dual.dtype)
    one = np.float32(1)
    tiny = np.float32(1e-30)
    for v in range(views_v):
        for u in range(views_u):
            for part in range(parts):
                here = dual[v, u, base + part]
                size[:] = 0
                for c in range(3):
                    line = ahead[v, u, part, c]
                    right = raised[0, c]
                    old = here[0, c]
                    for x in range(width - 1):
                        right[x] = old[x] + step * (line[x + 1] - line[x])
                    right[width - 1] = 0
                    for direction in range(1, 4):
                        old = here[direction, c]
                        new = raised[direction, c]
                        inside = True
                        beyond = line
                        if direction == 1:
                            if part + 1 < parts:
                                beyond = ahead[v, u, part + 1, c]
                            elif has_below:
                                beyond = below[v, u, 0, c]
                            else:
                                inside = False
                        elif direction == 2:
                            if u + 1 < views_u:
                                beyond = ahead[v, u + 1, part, c]
                            else:
                                inside = False
                        else:
                            if v + 1 < views_v:
                                beyond = ahead[v + 1, u, part, c]
                            else:
                                inside = False
                        if inside:
                            for x in range(width):
                                new[x] = old[x] + step * (beyond[x] - line[x])
                        else:
                            for x in range(width):
                                new[x] = 0
                    for direction in range(4):
                        new = raised[direction, c]
                        for x in range(width):
                            size[x] += new[x] * new[x]
                for x in range(width):
                    size[x] = relax * min(one, bound / np.sqrt(size[x] + tiny))
                for direction in range(4):
                    for c in range(3):
                        old = here[direction, c]
                        new = raised[direction, c]
                        for x in range(width):
                            old[x] = (one - relax) * old[x] + size[x] * new[x]


@njit(cache=True, parallel=True)
def sweep(
    weights,
    colour,
    inverse,
    frames,
    binning,
    light_field,
    dual,
    primal_step,
    dual_step,
    bound,
    relax,
    bands,
    moved,
):
    """Do one over-relaxed primal-dual iteration in place (Condat 2013, algorithm 3.1).

    bands: (band, 2) first and last + 1 row of pixels. moved: (pixel_y, 2) squared change and
    squared size of the light field per row of pixels.
    """
    views_v, views_u, _, _, width = light_field.shape
    count = bands.shape[0]
    first = np.empty((count, views_v, views_u, binning, 3, width), light_field.dtype)
    last = np.empty((count, views_v, views_u, binning, 3, width), light_field.dtype)
    for band in prange(count):
        begin, end = bands[band, 0], bands[band, 1]
        ring = np.empty((2, views_v, views_u, binning, 3, width), light_field.dtype)
        for row in range(begin, end):
            ahead = ring[row % 2]
            _primal_rows(
                weights,
                colour,
                inverse,
                frames,
                binning,
                light_field,
                dual,
                primal_step,
                relax,
                row,
                ahead,
                moved,
            )
            if row == begin:
                first[band] = ahead
            else:
                before = ring[(row - 1) % 2]
                _dual_rows(before, ahead, True, dual, (row - 1) * binning, dual_step, bound, relax)
        last[band] = ring[(end - 1) % 2]
    for band in prange(count):
        base = (bands[band, 1] - 1) * binning
        below = first[min(band + 1, count - 1)]
        _dual_rows(last[band], below, band + 1 < count, dual, base, dual_step, bound, relax)


@njit(cache=True, parallel=True, fastmath=True)
def total_variation_rows(light_field, totals):
    """Set totals (y,) to DV_1 of every row of the light field (v, u, y, colour, x)."""
    views_v, views_u, rows, _, width = light_field.shape
    for y in prange(rows):
        square = np.empty(width, light_field.dtype)
        total = 0.0
        for v in range(views_v):
            for u in range(views_u):
                square[:] = 0
                for c in range(3):
                    here = light_field[v, u, y, c]
                    for x in range(width - 1):
                        square[x] += (here[x + 1] - here[x]) ** 2
                    if y + 1 < rows:
                        beyond = light_field[v, u, y + 1, c]
                        for x in range(width):
                            square[x] += (beyond[x] - here[x]) ** 2
                    if u + 1 < views_u:
                        beyond = light_field[v, u + 1, y, c]
                        for x in range(width):
                            square[x] += (beyond[x] - here[x]) ** 2
                    if v + 1 < views_v:
                        beyond = light_field[v + 1, u, y, c]
                        for x in range(width):
                            square[x] += (beyond[x] - here[x]) ** 2
                for x in range(width):
                    total += np.sqrt(square[x])
        totals[y] = total

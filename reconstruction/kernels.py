"""Fused loops of primal-dual total variation on the kernels' axes (v, u, y, colour, x).

The primal step is the exact proximal point of the misfit and of a quadratic pull to a target.

The dual variable has axes (v, u, y, direction, colour, x), directions x, y, u, v: forward
differences, 0 across the far border, of the colours after multiplication by a 3 x 3 metric.

One sweep reads and writes the light field and the dual variable once: rows of pixels are taken in
order, the primal step of a row is followed by the dual step of the row before it while both are
in cache. Bands of rows run in parallel; the dual step of a band's last row needs the next band's
first and is done after all bands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from emmc_rig.model.compiling import njit
from emmc_rig.model.kernels import correct_row, gather_row, spread_row

NO_SHARE = np.zeros((0, 0), dtype=np.float32)
NO_PULL = np.zeros((0, 0, 0, 0, 0), dtype=np.float32)


class Data(NamedTuple):
    """What the frames say: Psi's weights and colour map, its inverted blocks, the frames, k.

    share, pulled: a sample q descended to becomes share q + pulled before the frames correct it;
    (y, x) and (v, u, y, colour, x), both empty without a target.
    """

    weights: Any
    colour: Any
    inverse: Any
    frames: Any
    binning: int
    share: Any = NO_SHARE
    pulled: Any = NO_PULL


class Steps(NamedTuple):
    """The steps, of the arrays' type: gamma, tau, mu, the relaxation, and the colours' metric.

    metric: (3, 3), turns colours into the coordinates in which differences are measured.
    """

    primal: Any
    dual: Any
    bound: Any
    relax: Any
    metric: Any


@njit(cache=True, fastmath=True)
def mix(metric, lines):
    """Replace lines (colour, x) by metric @ lines."""
    red, green, blue = lines[0], lines[1], lines[2]
    for x in range(red.size):
        r, g, b = red[x], green[x], blue[x]
        red[x] = metric[0, 0] * r + metric[0, 1] * g + metric[0, 2] * b
        green[x] = metric[1, 0] * r + metric[1, 1] * g + metric[1, 2] * b
        blue[x] = metric[2, 0] * r + metric[2, 1] * g + metric[2, 2] * b


@njit(cache=True, fastmath=True)
def _descend(light_field, dual, step, back, v, u, y, out):
    """Set out (colour, x) to the light field less step times the adjoint of `_dual_rows`' gradient.

    back: the transposed metric.
    """
    width = light_field.shape[4]
    here = dual[v, u, y]
    for c in range(3):
        gx, gy, gu, gv = here[0, c], here[1, c], here[2, c], here[3, c]
        line = out[c]
        for x in range(width):
            line[x] = gx[x] + gy[x] + gu[x] + gv[x]
        for x in range(1, width):
            line[x] -= gx[x - 1]
        if y > 0:
            gy = dual[v, u, y - 1, 1, c]
            for x in range(width):
                line[x] -= gy[x]
        if u > 0:
            gu = dual[v, u - 1, y, 2, c]
            for x in range(width):
                line[x] -= gu[x]
        if v > 0:
            gv = dual[v - 1, u, y, 3, c]
            for x in range(width):
                line[x] -= gv[x]
    mix(back, out)
    for c in range(3):
        row, line = light_field[v, u, y, c], out[c]
        for x in range(width):
            line[x] = row[x] + step * line[x]


@njit(cache=True, fastmath=True)
def pull_row(data, v, u, y, lines):
    """Draw lines (colour, x), row y of view (v, u), towards the target, if there is one."""
    if data.pulled.size > 0:
        share = data.share[y]
        for c in range(3):
            line, pulled = lines[c], data.pulled[v, u, y, c]
            for x in range(line.size):
                line[x] = share[x] * line[x] + pulled[x]


@njit(cache=True, fastmath=True)
def fit_rows(data, steps, light_field, row, ahead, first, moved):
    """Finish the primal step of a row of pixels, descended to in `ahead` from its row `first` on.

    Corrects by the frames, moves light_field, and sets ahead to metric (2 new - old).
    """
    weights, colour, inverse, frames, binning = data[:5]
    shots, views_v, views_u, _, _, width = weights.shape
    base = row * binning
    seen = np.zeros((shots, width), frames.dtype)
    for shot in range(shots):
        for part in range(binning):
            gather_row(weights, colour, ahead, first + part, shot, base + part, seen[shot])
    correct_row(inverse, frames, binning, row, seen)
    change = 0.0
    power = 0.0
    for v in range(views_v):
        for u in range(views_u):
            for part in range(binning):
                y = base + part
                lines = ahead[v, u, first + part]
                for shot in range(shots):
                    spread_row(weights, colour, seen[shot], shot, y, v, u, lines)
                for c in range(3):
                    old = light_field[v, u, y, c]
                    line = lines[c]
                    row_change = np.float32(0)
                    row_power = np.float32(0)
                    for x in range(width):
                        delta = line[x] - old[x]
                        line[x] += delta
                        old[x] += steps.relax * delta
                        row_change += delta * delta
                        row_power += old[x] * old[x]
                    change += row_change
                    power += row_power
                mix(steps.metric, lines)
    moved[row, 0] = change
    moved[row, 1] = power


@njit(cache=True, fastmath=True)
def _primal_rows(data, steps, light_field, dual, row, ahead, moved):
    """Do the primal step of a row of pixels; set ahead, for _dual_rows, to metric (2 new - old)."""
    back = steps.metric.T.copy()
    for v in range(light_field.shape[0]):
        for u in range(light_field.shape[1]):
            for part in range(data.binning):
                y = row * data.binning + part
                lines = ahead[v, u, part]
                _descend(light_field, dual, steps.primal, back, v, u, y, lines)
                pull_row(data, v, u, y, lines)
    fit_rows(data, steps, light_field, row, ahead, 0, moved)


@njit(cache=True, nogil=True, fastmath=True)
def _dual_rows(steps, ahead, below, has_below, dual, base):
    """Do the dual step of the rows of `ahead` (v, u, part, colour, x); `below`: the next block."""
    _, step, bound, relax, _ = steps
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


@njit(cache=True)
def _copy(source, target):
    """Copy a whole array: an assignment compiles for seconds, for its message of shapes."""
    values, places = source.reshape(-1), target.reshape(-1)
    for i in range(values.size):
        places[i] = values[i]


@njit(cache=True, nogil=True, fastmath=True)
def _sweep_band(data, steps, light_field, dual, begin, end, moved, first, last):
    """Do the rows of pixels from begin to end, but for the dual step of the last one.

    first, last: set to the `ahead` of those rows, for the dual steps at the bands' edges.
    """
    ring = np.empty((2, *first.shape), light_field.dtype)
    for row in range(begin, end):
        ahead = ring[row % 2]
        _primal_rows(data, steps, light_field, dual, row, ahead, moved)
        if row == begin:
            _copy(ahead, first)
        else:
            # A constant True would be a type of its own, and compiled once more.
            below = row > begin
            _dual_rows(steps, ring[(row - 1) % 2], ahead, below, dual, (row - 1) * data.binning)
    _copy(ring[(end - 1) % 2], last)


def sweep(
    data: Data,
    steps: Steps,
    light_field: NDArray[np.floating],
    dual: NDArray[np.floating],
    bands: NDArray[np.int64],
    moved: NDArray[np.float64],
    run: Callable[..., Iterable[object]] = map,
) -> None:
    """Do one over-relaxed primal-dual iteration in place (Condat 2013, algorithm 3.1).

    bands: (band, 2) first and last + 1 row of pixels. moved: (pixel_y, 2), set to the squared
    change and the squared size of the light field per row of pixels. run: `map`, or that of a
    thread pool: the bands are independent (numba's own parallel loop takes 15 s more to compile).
    """
    views_v, views_u, _, _, width = light_field.shape
    block = (views_v, views_u, data.binning, 3, width)
    first, last = np.empty((2, len(bands), *block), light_field.dtype)

    def rows(band: int) -> None:
        begin, end = bands[band]
        _sweep_band(data, steps, light_field, dual, begin, end, moved, first[band], last[band])

    def last_row(band: int) -> None:
        inner = band + 1 < len(bands)
        below = first[band + 1 if inner else band]
        base = (bands[band, 1] - 1) * data.binning
        _dual_rows(steps, last[band], below, inner, dual, base)

    for stage in (rows, last_row):
        for _ in run(stage, range(len(bands))):
            pass


@njit(cache=True, parallel=True, fastmath=True)
def total_variation_rows(light_field, metric, totals):
    """Set totals (y,) to the total variation of every row of the light field."""
    views_v, views_u, rows, _, width = light_field.shape
    for y in prange(rows):
        square = np.empty(width, light_field.dtype)
        step = np.empty((3, width), light_field.dtype)
        total = 0.0
        for v in range(views_v):
            for u in range(views_u):
                square[:] = 0
                for direction in range(4):
                    y_to = y + (direction == 1)
                    u_to = u + (direction == 2)
                    v_to = v + (direction == 3)
                    if y_to == rows or u_to == views_u or v_to == views_v:
                        continue
                    along = 1 if direction == 0 else 0
                    for c in range(3):
                        here, there = light_field[v, u, y, c], light_field[v_to, u_to, y_to, c]
                        step[c, width - 1] = 0
                        for x in range(width - along):
                            step[c, x] = there[x + along] - here[x]
                    mix(metric, step)
                    for c in range(3):
                        for x in range(width):
                            square[x] += step[c, x] ** 2
                for x in range(width):
                    total += np.sqrt(square[x])
        totals[y] = total

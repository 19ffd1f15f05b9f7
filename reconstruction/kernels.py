"""Fused loops of primal-dual DV_K, total variation included, on the axes (v, u, y, colour, x).

`tv` states the mathematics and the symbols. `_descend` computes q, `pull_row` z, `fit_rows` L'
and the relaxed L, `_dual_rows` the relaxed p. The dual variable p has axes (v, u, y, index, colour,
x), one index for each derivative of `Stencils`, of the colours after multiplication by a 3 x 3
metric.

One sweep reads and writes the light field and the dual variable once. Rows of the dual variable
need the rows of pixels up to K further down: they follow the primal step at that distance, so that
both find their rows in cache. Bands of rows run in parallel; the dual steps of a band's last K rows
need the next band's first and are done after all bands.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands, row_kernel
from emmc_rig.model.compiling import njit
from emmc_rig.model.kernels import correct_row, gather_row, spread_row

NO_SHARE = np.zeros((0, 0), dtype=np.float32)
NO_PULL = np.zeros((0, 0, 0, 0, 0), dtype=np.float32)


class FrameFit(NamedTuple):
    """Psi, the frames, and the target of the quadratic pull.

    weights: (shot, v, u, y, stored colour, x). colour: (shot, y, x) uint8. inverse: the blocks
    (Psi Psi^T + a)^-1. frames: (shot, pixel_y, pixel_x). binning: k. share, pulled: (y, x) and
    (v, u, y, colour, x), with z = share q + pulled; both empty without a target.
    """

    weights: Any
    colour: Any
    inverse: Any
    frames: Any
    binning: int
    share: Any = NO_SHARE
    pulled: Any = NO_PULL


class Steps(NamedTuple):
    """Steps and weights, of the arrays' type.

    primal: gamma. dual: tau. bound: mu. relax: the relaxation. metric: (3, 3), turns colours into
    the coordinates in which differences are measured.
    """

    primal: Any
    dual: Any
    bound: Any
    relax: Any
    metric: Any


@njit(forceinline=True, fastmath=True)
def mix(metric, lines):
    """Replace lines (colour, x) by metric @ lines."""
    red, green, blue = lines[0], lines[1], lines[2]
    for x in range(red.size):
        r, g, b = red[x], green[x], blue[x]
        red[x] = metric[0, 0] * r + metric[0, 1] * g + metric[0, 2] * b
        green[x] = metric[1, 0] * r + metric[1, 1] * g + metric[1, 2] * b
        blue[x] = metric[2, 0] * r + metric[2, 1] * g + metric[2, 2] * b


@njit(forceinline=True, fastmath=True)
def pull_row(data, v, u, y, lines):
    """Set lines (colour, x), row y of view (v, u), from q to z = share q + pulled."""
    if data.pulled.size > 0:
        share = data.share[y]
        for c in range(3):
            line, pulled = lines[c], data.pulled[v, u, y, c]
            for x in range(line.size):
                line[x] = share[x] * line[x] + pulled[x]


@njit(forceinline=True, fastmath=True)
def fit_rows(data, steps, light_field, row, ahead, first, moved):
    """Finish the primal step of a row of pixels, whose z is in `ahead` from its row `first` on.

        seen  = (Psi Psi^T + a)^-1 (Psi z - I)      of the row's pixels
        L'    = z - Psi^T seen
        ahead = metric (2 L' - L)
        L     = L + relax (L' - L)
    moved[row]: |L' - L|^2 and |L|^2.
    """
    weights, colour, inverse = data.weights, data.colour, data.inverse
    frames, binning = data.frames, data.binning
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


class Stencils(NamedTuple):
    """The stencils of all derivatives that fit somewhere; taps begin[i]:begin[i + 1] make the i-th.

    reach: (index, 4), how many samples beyond its own a derivative needs along x, y, u, v.
    offset: (tap, 4) along x, y, u, v. factor: (tap,), of the light field's type.
    """

    reach: Any
    begin: Any
    offset: Any
    factor: Any


@njit(forceinline=True)
def _fits(shape, reach, v, u, y):
    """Return whether a stencil fits along v, u and y."""
    return v + reach[3] < shape[0] and u + reach[2] < shape[1] and y + reach[1] < shape[2]


@njit(forceinline=True, fastmath=True)
def _differentiate(light_field, stencils, index, v, u, y, out):
    """Set out (3, x), colours apart, to a derivative that fits of a light field (v, u, y, 3 x).

    The colours of a row are taken as one line; where a stencil would reach into the next colour
    the derivative does not exist and is set to 0.
    """
    reach, begin, offset, factor = stencils
    line = out.reshape(-1)
    first, last = begin[index], begin[index + 1]
    if (last - first) % 2:
        dx, dy, du, dv = offset[first]
        source = light_field[v + dv, u + du, y + dy][dx:]
        scale = factor[first]
        for x in range(source.size):
            line[x] = scale * source[x]
    # Two taps at a time halve the passes over the line.
    for tap in range(first + (last - first) % 2, last, 2):
        dx, dy, du, dv = offset[tap]
        source = light_field[v + dv, u + du, y + dy][dx:]
        dx, dy, du, dv = offset[tap + 1]
        other = light_field[v + dv, u + du, y + dy][dx:]
        scale, weight = factor[tap], factor[tap + 1]
        if tap == first:
            for x in range(min(source.size, other.size)):
                line[x] = scale * source[x] + weight * other[x]
        else:
            for x in range(min(source.size, other.size)):
                line[x] += scale * source[x] + weight * other[x]
    out[:, out.shape[1] - reach[index, 0] :] = 0


@njit(forceinline=True, fastmath=True)
def _descend(light_field, dual, stencils, step, back, v, u, y, out):
    """Set out (3, x) to a row of q = L - step D^T p.

    dual: (v, u, y, index, 3 x), 0 where a stencil does not fit, so that no colour spills over.
    """
    reach, begin, offset, factor = stencils
    line = out.reshape(-1)
    line[:] = 0
    for index in range(len(reach)):
        for tap in range(begin[index], begin[index + 1]):
            dx, dy, du, dv = offset[tap]
            if dv > v or du > u or dy > y:
                continue
            if _fits(dual.shape, reach[index], v - dv, u - du, y - dy):
                source = dual[v - dv, u - du, y - dy, index]
                scale = factor[tap]
                moved = line[dx:]
                for x in range(moved.size):
                    moved[x] += scale * source[x]
    mix(back, out)
    row = light_field[v, u, y].reshape(-1)
    for x in range(line.size):
        line[x] = row[x] - step * line[x]


@njit(forceinline=True, fastmath=True)
def _dual_rows(steps, stencils, ahead, dual, begin, end):
    """Do the dual step of rows begin to end: ahead (v, u, y, 3 x), dual (v, u, y, index, 3 x).

    raised = p + tau D ahead
    p      = (1 - relax) p + relax raised min(1, mu / |raised|),  |.| over indices and colours
    """
    step, bound, relax = steps.dual, steps.bound, steps.relax
    views_v, views_u, _, count, values = dual.shape
    width = values // 3
    raised = np.empty((count, 3, width), dual.dtype)
    size = np.empty(width, dual.dtype)
    unit = np.float32(1)
    tiny = np.float32(1e-30)
    for y in range(begin, end):
        for v in range(views_v):
            for u in range(views_u):
                size[:] = 0
                for index in range(count):
                    if not _fits(dual.shape, stencils.reach[index], v, u, y):
                        continue
                    new, old = raised[index], dual[v, u, y, index]
                    _differentiate(ahead, stencils, index, v, u, y, new)
                    for c in range(3):
                        line, before = new[c], old[c * width : (c + 1) * width]
                        for x in range(width):
                            line[x] = before[x] + step * line[x]
                            size[x] += line[x] * line[x]
                for x in range(width):
                    size[x] = relax * min(unit, bound / np.sqrt(size[x] + tiny))
                for index in range(count):
                    if not _fits(dual.shape, stencils.reach[index], v, u, y):
                        continue
                    new, old = raised[index], dual[v, u, y, index]
                    for c in range(3):
                        line, before = new[c], old[c * width : (c + 1) * width]
                        for x in range(width):
                            before[x] = (unit - relax) * before[x] + size[x] * line[x]


@njit(cache=True, nogil=True, fastmath=True)
def _sweep_band(data, steps, stencils, light_field, dual, ahead, band, last_rows, moved):
    """Do a band of rows of pixels but for the dual steps of its last K rows; or those, last_rows.

    One place calls the dual step: compiled at two, it might round differently at each.
    """
    back = steps.metric.T.copy()
    furthest = 0
    for index in range(len(stencils.reach)):
        furthest = max(furthest, stencils.reach[index, 1])
    flat = ahead.reshape((*ahead.shape[:3], ahead.shape[3] * ahead.shape[4]))
    begin, end = band
    done = begin * data.binning
    if last_rows:
        done = max(done, end * data.binning - furthest)
    for row in range(end - 1 if last_rows else begin, end):
        base = row * data.binning
        ready = base + data.binning
        if not last_rows:
            for v in range(light_field.shape[0]):
                for u in range(light_field.shape[1]):
                    for y in range(base, base + data.binning):
                        lines = ahead[v, u, y]
                        _descend(light_field, dual, stencils, steps.primal, back, v, u, y, lines)
                        pull_row(data, v, u, y, lines)
            fit_rows(data, steps, light_field, row, ahead, base, moved)
            ready = max(done, ready - furthest)
        _dual_rows(steps, stencils, flat, dual, done, ready)
        done = ready


def sweep(
    data: FrameFit,
    steps: Steps,
    stencils: Stencils,
    light_field: NDArray[np.floating],
    dual: NDArray[np.floating],
    ahead: NDArray[np.floating],
    moved: NDArray[np.float64],
) -> None:
    """Do one over-relaxed primal-dual iteration in place (Condat 2013, algorithm 3.1).

    dual: (v, u, y, index, colour, x), 0 where no stencil fits. ahead: room for another light field.
    moved: (pixel_y, 2), set to the squared change and the squared size of the light field per row
    of pixels.
    """
    dual = dual.reshape(*dual.shape[:4], -1)
    for last_rows in (False, True):

        def work(_: int, begin: int, end: int, last_rows: bool = last_rows) -> None:
            band = begin, end
            _sweep_band(data, steps, stencils, light_field, dual, ahead, band, last_rows, moved)

        in_bands(work, len(moved))


@row_kernel("light_field", 2, fastmath=True)
def variation_rows(begin, end, light_field, stencils, metric, totals):
    """Set totals (y,) to DV_K of every row of a light field (v, u, y, colour, x)."""
    views_v, views_u, rows, _, width = light_field.shape
    flat = light_field.reshape((views_v, views_u, rows, 3 * width))
    square = np.empty(width, light_field.dtype)
    lines = np.empty((3, width), light_field.dtype)
    for y in range(begin, end):
        total = 0.0
        for v in range(views_v):
            for u in range(views_u):
                square[:] = 0
                for index in range(len(stencils.reach)):
                    if not _fits(light_field.shape, stencils.reach[index], v, u, y):
                        continue
                    _differentiate(flat, stencils, index, v, u, y, lines)
                    mix(metric, lines)
                    for c in range(3):
                        for x in range(width):
                            square[x] += lines[c, x] ** 2
                for x in range(width):
                    total += np.sqrt(square[x])
        totals[y] = total

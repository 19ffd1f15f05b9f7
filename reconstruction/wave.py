"""A few steps of total variation in one pass over the picture, as `tv` would do them one by one.

After t steps a row of pixels depends on rows at most t away. So the steps run down the picture one
behind the other, a row of pixels apart: step t + 1 is at row p - 1 when step t is at row p. What
they work on are the rows between the first and the last of them, and the light field is written
once: 4 bytes a value, where `tv` moves 46 bytes a value in each step and holds a dual variable of
16 besides. Bands of rows run in parallel, each from as many rows above it and down to as many below
as there are steps, so that the number of threads changes no value; so do tiles of columns, one
after the other, whose rows stay in cache.

The light field is held in the weighted opponent colours z = M x of `problem.colour_metric`, in
which its differences are measured: M M^T is diagonal, so that a step need mix colours only where it
reads the frames.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.kernels import correct_row
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.choices import choose_primal_step, contrast, smooth_guess
from reconstruction.kernels import FrameFit
from reconstruction.problem import Problem, colour_metric
from reconstruction.tv import TVSettings, prepared

Array = NDArray[np.floating]
TILE_BYTES = 5_000_000
"""Of the rows that a band works on. Buttercup, 13 steps, on 1 MiB of second and 32 of third cache:
half as much takes 1.2 times as long, the whole width (16 MB) 1.4 times."""
LEAST_TILE = 4
"""Own columns of a tile for each one that it computes beside them to one side, at least."""


@njit(inline="always")
def _mix(matrix, colour, shot, y, stored, mixed):
    """Set mixed (stored colour, 3 x) to the row of a matrix of the colour stored at each sample."""
    width = mixed.shape[1] // 3
    for c in range(stored):
        for i in range(len(matrix)):
            for x in range(width):
                which = colour[shot, y, x] if stored == 1 else c
                mixed[c, i * width + x] = matrix[which, i]


@njit(inline="always")
def _descend(now, dual, scale, y, above, v, u, none, line):
    """Set a line to row y of a view less scale (a line) times the adjoint on the dual variable.

    now, dual: windows of rows; y, above: where row y and the one above it are, -1 for no row above.
    """
    old = now[y, v, u]
    along, down = dual[y, v, u, 0], dual[y, v, u, 1]
    across, up = dual[y, v, u, 2], dual[y, v, u, 3]
    over = dual[above, v, u, 1] if above >= 0 else none
    left = dual[y, v, u - 1, 2] if u > 0 else none
    before = dual[y, v - 1, u, 3] if v > 0 else none
    for x in range(line.size):
        line[x] = along[x] + down[x] - over[x] + across[x] - left[x] + up[x] - before[x]
    # 0 where a colour ends, so that none reaches into the next.
    beside = line[1:]
    for x in range(beside.size):
        beside[x] -= along[x]
    for x in range(line.size):
        line[x] = old[x] + scale[x] * line[x]


@njit(inline="always")
def _raise(ahead, below, dual, steps, v, u, raised, size):
    """Do the dual step of a row of a view.

    ahead, below: (v, u, line) of this row and of the next, which is the same one at the end. dual:
    of this row, (v, u, index, line). raised (index, line), size (line): room to compute in.
    """
    views_v, views_u, indices, values = dual.shape
    width = values // 3
    _, step, bound, relax, _ = steps
    own, one, tiny = ahead[v, u], np.float32(1), np.float32(1e-30)
    size[:] = tiny
    for index in range(indices):
        if index == 0:
            other = own[1:]
        elif index == 1:
            other = below[v, u]
        elif index == 2:
            other = ahead[v, min(u + 1, views_u - 1)]
        else:
            other = ahead[min(v + 1, views_v - 1), u]
        new, old = raised[index], dual[v, u, index]
        for x in range(other.size):
            value = old[x] + step * (other[x] - own[x])
            new[x] = value
            size[x] += value * value
        if index == 0:
            for end in range(width - 1, values, width):
                new[end] = 0
                size[end] = tiny
    first, second, third = size[:width], size[width : 2 * width], size[2 * width :]
    for x in range(width):
        ratio = bound / np.sqrt(first[x] + second[x] + third[x])
        first[x] = second[x] = third[x] = relax * (ratio if ratio < one else one)
    kept = one - relax
    for index in range(indices):
        new, old = raised[index], dual[v, u, index]
        for x in range(values):
            old[x] = kept * old[x] + size[x] * new[x]


@njit(inline="always")
def _fit(data, steps, unmix, remix, row, now, ahead, mixed, seen):
    """Finish the primal step of a row of pixels: move `now` on, and set ahead to 2 new - old.

    unmix, remix: rows of M^-1 and of M^T, by colours. now, ahead: (sample row, v, u, line), the
    latter descended to. mixed (stored colour, line), seen (shot, x): room to compute in.
    """
    weights, colour, inverse, frames, binning = data[:5]
    shots, views_v, views_u, _, stored, width = weights.shape
    seen[:] = 0
    for part in range(binning):
        y = row * binning + part
        for shot in range(shots):
            _mix(unmix, colour, shot, y, stored, mixed)
            total = seen[shot]
            for v in range(views_v):
                for u in range(views_u):
                    line = ahead[part, v, u]
                    one, two, three = line[:width], line[width : 2 * width], line[2 * width :]
                    for c in range(stored):
                        weight, by = weights[shot, v, u, y, c], mixed[c]
                        first, second, third = by[:width], by[width : 2 * width], by[2 * width :]
                        for x in range(width):
                            value = first[x] * one[x] + second[x] * two[x] + third[x] * three[x]
                            total[x] += weight[x] * value
    correct_row(inverse, frames, binning, row, seen)
    for part in range(binning):
        y = row * binning + part
        for shot in range(shots):
            _mix(remix, colour, shot, y, stored, mixed)
            for c in range(stored):
                for i in range(len(unmix)):
                    for x in range(width):
                        mixed[c, i * width + x] *= seen[shot, x]
            for v in range(views_v):
                for u in range(views_u):
                    for c in range(stored):
                        weight = weights[shot, v, u, y, c]
                        for i in range(len(unmix)):
                            line = ahead[part, v, u, i * width : (i + 1) * width]
                            by = mixed[c, i * width : (i + 1) * width]
                            for x in range(width):
                                line[x] += weight[x] * by[x]
        for v in range(views_v):
            for u in range(views_u):
                line, old = ahead[part, v, u], now[part, v, u]
                for x in range(line.size):
                    delta = line[x] - old[x]
                    line[x] += delta
                    old[x] += steps.relax * delta


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _pass(data, steps, unmix, begun, count, span, own, columns, out):
    """Do `count` steps on the rows of pixels `span`, and set out to the light field of those `own`.

    data, steps: see `kernels`. unmix: M^-1. begun: (y, x, colour), with which all views begin.
    columns: of data's samples the first and last + 1 that are set, and where the first goes in out,
    (v, u, y, x, colour).
    """
    weights, _, _, frames, binning = data[:5]
    shots, views_v, views_u, _, stored, width = weights.shape
    metric, remix = steps.metric, steps.metric.T.copy()
    dark, light = np.float32(0), np.float32(1)
    top, bottom = span
    rows, values = (count + 1) * binning, 3 * width
    now = np.empty((rows, views_v, views_u, values), frames.dtype)
    dual = np.empty((rows, views_v, views_u, 4, values), frames.dtype)
    ahead = np.empty((count, 2, binning, views_v, views_u, values), frames.dtype)
    raised = np.empty((4, values), frames.dtype)
    size = np.empty(values, frames.dtype)
    none = np.zeros(values, frames.dtype)
    scale = np.empty(values, frames.dtype)
    mixed = np.empty((stored, values), frames.dtype)
    seen = np.empty((shots, width), frames.dtype)
    for c in range(3):
        scale[c * width : (c + 1) * width] = steps.primal * (metric[c] * metric[c]).sum()
    for front in range(top, bottom + count - 1):
        if front < bottom:
            for y in range(front * binning, (front + 1) * binning):
                dual[y % rows] = 0
                line = now[y % rows, 0, 0]
                for c in range(3):
                    for x in range(width):
                        red, green, blue = begun[y, x]
                        mean = metric[c, 0] * red + metric[c, 1] * green + metric[c, 2] * blue
                        line[c * width + x] = mean
                for v in range(views_v):
                    for u in range(views_u):
                        # Not as arrays: what checks their shapes takes two seconds to compile.
                        for x in range(values):
                            now[y % rows, v, u, x] = line[x]
        for step in range(max(0, front - bottom + 1), min(count, front - top + 1)):
            row = front - step
            at = row * binning % rows
            mine = ahead[step, row % 2]
            for part in range(binning):
                first = row == top and part == 0
                above = -1 if first else (row * binning + part - 1) % rows
                for v in range(views_v):
                    for u in range(views_u):
                        _descend(now, dual, scale, at + part, above, v, u, none, mine[part, v, u])
            _fit(data, steps, unmix, remix, row, now[at : at + binning], mine, mixed, seen)
            # The rows whose next one is known by now: the last of the pixels above, and all but the
            # last of these, or that one, too, where nothing follows. No step needs the last dual.
            begin = row * binning - (1 if row > top else 0)
            end = (row + 1) * binning - (0 if row == bottom - 1 else 1)
            for y in range(begin, begin if step == count - 1 else end):
                below = min(y + 1, bottom * binning - 1)
                its = ahead[step, y // binning % 2, y % binning]
                next_one = ahead[step, below // binning % 2, below % binning]
                for v in range(views_v):
                    for u in range(views_u):
                        _raise(its, next_one, dual[y % rows], steps, v, u, raised, size)
        row = front - count + 1
        if row < own[0] or row >= own[1]:
            continue
        for y in range(row * binning, (row + 1) * binning):
            for v in range(views_v):
                for u in range(views_u):
                    line, samples = now[y % rows, v, u], out[v, u, y]
                    one, two, three = line[:width], line[width : 2 * width], line[2 * width :]
                    for x in range(columns[0], columns[1]):
                        for c in range(3):
                            value = unmix[c, 0] * one[x] + unmix[c, 1] * two[x]
                            value += unmix[c, 2] * three[x]
                            samples[x - columns[0] + columns[2], c] = min(max(value, dark), light)


def few_steps(
    psi: ImagingMatrix, frames: Array, usable: NDArray[np.bool_], mu: float, count: int
) -> NDArray[np.float32]:
    """Return the light field (v, u, y, x, c) of `count` steps of total variation.

    It is that of `reconstruct_tv` after so many, with its usual settings, to rounding. frames,
    usable: (shot, pixel_y, pixel_x), checked, the frames in Psi's type and finite. mu: the weight
    of total variation.
    """
    usual, dtype, k = TVSettings(), psi.weights.dtype.type, psi.binning
    guess = smooth_guess(psi, frames, usable)
    gamma = choose_primal_step(contrast(guess), mu, usual.chroma_weight)
    metric = colour_metric(usual.chroma_weight).astype(dtype)
    problem = Problem(psi, frames, usable, mu, 1, metric)
    data, steps = prepared(problem, dtype(gamma), dtype(usual.relaxation))
    unmix = np.linalg.inv(metric)
    out = np.empty(psi.light_field_shape, dtype=np.float32)
    _, rows, columns = psi.frames_shape
    guess = guess.astype(dtype)
    for begin, end in pairwise(_tiles(psi, count)):
        first, last = max(begin - count, 0), min(end + count, columns)
        part = _columns_of(data, first, last)
        start = np.ascontiguousarray(guess[:, first * k : last * k])
        own = (begin - first) * k, (end - first) * k, begin * k

        def band(_: int, top: int, bottom: int, of_tile: Any = (part, start, own)) -> None:
            part, start, own = of_tile
            span = max(top - count, 0), min(bottom + count, rows)
            _pass(part, steps, unmix, start, count, span, (top, bottom), own, out)

        in_bands(band, rows)
    return out


def _tiles(psi: ImagingMatrix, count: int) -> list[int]:
    """Return where tiles of about equally many columns of pixels begin, and where the last ends."""
    k, (views, columns) = psi.binning, (int(np.prod(psi.views)), psi.frames_shape[2])
    values = 3 * views * k**2 * ((1 + 4) * (count + 1) + 2 * count)
    own = max(TILE_BYTES // (psi.weights.itemsize * values) - 2 * count, LEAST_TILE * count)
    return np.linspace(0, columns, -(-columns // own) + 1).round().astype(int).tolist()


def _columns_of(data: FrameFit, first: int, last: int) -> FrameFit:
    """Return what the pixels of some columns fit."""
    k = data.binning
    of_samples = {"weights": data.weights, "colour": data.colour}
    of_pixels = {"inverse": data.inverse, "frames": data.frames}
    parts = {name: all_of_it[..., first * k : last * k] for name, all_of_it in of_samples.items()}
    parts |= {name: all_of_it[..., first:last] for name, all_of_it in of_pixels.items()}
    return data._replace(**{name: np.ascontiguousarray(part) for name, part in parts.items()})

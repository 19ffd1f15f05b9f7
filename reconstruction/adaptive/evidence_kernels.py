"""Kernels of the patches' evidence: covariances of readings, their factors, log-likelihoods.

LANES patches are worked on side by side: arrays end with (..., lane), and the innermost loops run
along it. Sums are taken four terms at a time, which halves what is read and written.
"""

from __future__ import annotations

from math import log, sqrt

import numpy as np
from numba import njit

LANES = 64
TERMS = 4
"""Terms of a sum taken at a time: tables are padded with zeros to a multiple of it."""


@njit(cache=True, fastmath=True)
def _gather(
    weights, colour, usable, ridge, data, corners, places, binning, rays, known, seen, measured
):
    """Cut Psi, data, variances and colours into patches, one a lane; nothing where not usable.

    places: (reading, 3), shot, and row and column of the pixel from the corner's. corners: (lane,
    2) of pixels. rays: (part, reading, ray + 1, lane), luminance and, where three colours are
    stored, two chrominances; the last ray is left at 0. known: (2, reading, lane), data and
    variance. seen: (reading, lane) colour. measured: (lane,), how many are usable.
    """
    _, views_v, views_u, _, stored, _ = weights.shape
    lanes = corners.shape[0]
    for i in range(places.shape[0]):
        s = places[i, 0]
        for lane in range(lanes):
            y, x = corners[lane, 0] + places[i, 1], corners[lane, 1] + places[i, 2]
            if not usable[s, y, x]:
                known[0, i, lane] = 0
                known[1, i, lane] = 1
                continue
            measured[lane] += 1
            known[0, i, lane] = data[s, y, x]
            known[1, i, lane] = ridge[s, y, x]
            if stored == 1:
                seen[i, lane] = colour[s, y * binning, x * binning]
            a = 0
            for v in range(views_v):
                for u in range(views_u):
                    for sub_y in range(binning):
                        for sub_x in range(binning):
                            at_y, at_x = y * binning + sub_y, x * binning + sub_x
                            if stored == 1:
                                rays[0, i, a, lane] = weights[s, v, u, at_y, 0, at_x]
                            else:
                                r = weights[s, v, u, at_y, 0, at_x]
                                g = weights[s, v, u, at_y, 1, at_x]
                                b = weights[s, v, u, at_y, 2, at_x]
                                rays[0, i, a, lane] = (r + g + b) / np.float32(sqrt(3.0))
                                rays[1, i, a, lane] = (r - b) / np.float32(sqrt(2.0))
                                rays[2, i, a, lane] = (r - 2 * g + b) / np.float32(sqrt(6.0))
                            a += 1


@njit(cache=True, fastmath=True)
def _meet(here, there, members, meetings):
    """Add to meetings (separation, lane) the products of two pixels' rays (ray + 1, lane).

    members: (separation, pair, 2), the pairs of rays so far apart.
    """
    lanes = here.shape[1]
    for k in range(members.shape[0]):
        pairs = members[k]
        total = meetings[k]
        for n in range(0, pairs.shape[0], TERMS):
            if pairs[n, 0] == here.shape[0] - 1:
                break
            a, b = here[pairs[n, 0]], there[pairs[n, 1]]
            c, d = here[pairs[n + 1, 0]], there[pairs[n + 1, 1]]
            e, f = here[pairs[n + 2, 0]], there[pairs[n + 2, 1]]
            g, h = here[pairs[n + 3, 0]], there[pairs[n + 3, 1]]
            for lane in range(lanes):
                total[lane] += (
                    a[lane] * b[lane] + c[lane] * d[lane] + e[lane] * f[lane] + g[lane] * h[lane]
                )


@njit(cache=True, fastmath=True)
def _correlate(meetings, table, out):
    """Set out (disparity, lane) to table (disparity, separation) times meetings."""
    lanes = meetings.shape[1]
    for h in range(out.shape[0]):
        total = out[h]
        for lane in range(lanes):
            total[lane] = 0
        for k in range(0, meetings.shape[0], TERMS):
            p, q, r, s = table[h, k], table[h, k + 1], table[h, k + 2], table[h, k + 3]
            a, b, c, d = meetings[k], meetings[k + 1], meetings[k + 2], meetings[k + 3]
            for lane in range(lanes):
                total[lane] += p * a[lane] + q * b[lane] + r * c[lane] + s * d[lane]


@njit(cache=True, fastmath=True)
def _log_likelihood(matrix, measured, freedom, columns, product, square, out):
    """Set out (lane,) to the log-likelihoods of matrix (m + 1, m, lane), destroyed.

    Lower triangles of scale matrices, the data as last row, of multivariate t distributions with
    `freedom` degrees and measured (lane,) readings; constants are left out. m is a multiple of
    TERMS. columns: (TERMS, m + 1, lane), product, square: (lane,), to work in.
    """
    m, lanes = matrix.shape[1:]
    for lane in range(lanes):
        out[lane] = 0
        square[lane] = 0
    for first in range(0, m, TERMS):
        for lane in range(lanes):
            product[lane] = 1
        for k in range(first, first + TERMS):
            column = columns[k - first]
            for i in range(k, m + 1):
                row, line = matrix[i, k], column[i]
                for lane in range(lanes):
                    line[lane] = row[lane]
                for before in range(k - first):
                    a, b = columns[before, i], columns[before, k]
                    for lane in range(lanes):
                        line[lane] -= a[lane] * b[lane]
            pivot = column[k]
            for lane in range(lanes):
                pivot[lane] = max(pivot[lane], np.float32(1e-12))
                product[lane] *= pivot[lane]
                pivot[lane] = np.float32(1.0) / np.sqrt(pivot[lane])
            for i in range(k + 1, m + 1):
                line = column[i]
                for lane in range(lanes):
                    line[lane] *= pivot[lane]
            for lane in range(lanes):
                square[lane] += column[m, lane] ** 2
        for lane in range(lanes):
            out[lane] -= 0.5 * log(product[lane])
        for i in range(first + TERMS, m + 1):
            a, b, c, d = columns[0, i], columns[1, i], columns[2, i], columns[3, i]
            for j in range(first + TERMS, min(i + 1, m)):
                e, f, g, h = columns[0, j], columns[1, j], columns[2, j], columns[3, j]
                row = matrix[i, j]
                for lane in range(lanes):
                    row[lane] -= (
                        a[lane] * e[lane]
                        + b[lane] * f[lane]
                        + c[lane] * g[lane]
                        + d[lane] * h[lane]
                    )
    for lane in range(lanes):
        out[lane] -= 0.5 * (freedom + measured[lane]) * log(1 + square[lane] / freedom)


@njit(cache=True, fastmath=True)
def _fill(sums, known, seen, strength, chroma, matrix):
    """Set matrix (m + 1, m, lane) to the readings' covariance and, as last row, their values.

    sums: (part, pair, lane). strength, chroma: (lane,). seen: (reading, lane), or no reading where
    three colours are stored.
    """
    m, lanes = matrix.shape[1:]
    third = np.float32(1.0 / 3.0)
    first = 0
    for i in range(m):
        for j in range(i + 1):
            row = matrix[i, j]
            grey = sums[0, first]
            if sums.shape[0] == 1:
                a, b = seen[i], seen[j]
                for lane in range(lanes):
                    same = np.float32(1.0) if a[lane] == b[lane] else np.float32(0.0)
                    row[lane] = (
                        strength[lane] * grey[lane] * (third + chroma[lane] * (same - third))
                    )
            else:
                tint = sums[1, first]
                for lane in range(lanes):
                    row[lane] = strength[lane] * (grey[lane] + chroma[lane] * tint[lane])
            first += 1
        for lane in range(lanes):
            matrix[i, i, lane] += known[1, i, lane]
            matrix[m, i, lane] = known[0, i, lane]


@njit(cache=True, fastmath=True, nogil=True)
def evidence(
    weights,
    colour,
    usable,
    ridge,
    data,
    corners,
    places,
    binning,
    members,
    offsets,
    tables,
    probes,
    amplitudes,
    chromas,
    scales,
    freedom,
    out,
    chosen,
):
    """Set out (lane, disparity) to log-likelihoods, constants left out, and chosen (lane,).

    data, ridge: (shot, pixel_y, pixel_x), readings less those of the mean, their variances.
    corners: (batch, lane, 2) pixels. places: see `_gather`. members: see `_meet`. offsets:
    (reading, reading), the index of how far two pixels lie apart. tables: (offset, disparity,
    separation), the texture's correlation. amplitudes, chromas: (kind,), variance of luminance,
    times scales (lane,), and of a chrominance over that of luminance. probes: indices of
    the disparities at which every kind is judged; out is that of the best of them, `chosen`.
    """
    stored = weights.shape[4]
    readings = places.shape[0]
    m = -(-readings // TERMS) * TERMS
    lanes = corners.shape[0]
    disparities, separations = tables.shape[1:]
    rays_count = weights.shape[1] * weights.shape[2] * binning**2
    parts = 1 if stored == 1 else 3
    groups = 1 if stored == 1 else 2
    rays = np.zeros((parts, readings, rays_count + 1, lanes), np.float32)
    known = np.zeros((2, m, lanes), np.float32)
    known[1] = 1
    seen = np.zeros((m, lanes), np.uint8)
    measured = np.zeros(lanes, np.float32)
    _gather(
        weights,
        colour,
        usable,
        ridge,
        data,
        corners,
        places,
        binning,
        rays,
        known,
        seen,
        measured,
    )
    sums = np.zeros((disparities, groups, m * (m + 1) // 2, lanes), np.float32)
    meetings = np.empty((separations, lanes), np.float32)
    row = np.empty((disparities, lanes), np.float32)
    first = 0
    for i in range(readings):
        for j in range(i + 1):
            for part in range(parts):
                if part < 2:
                    meetings[:] = 0
                _meet(rays[part, i], rays[part, j], members, meetings)
                if part != 1:
                    _correlate(meetings, tables[offsets[i, j]], row)
                    for h in range(disparities):
                        sums[h, min(part, 1), first] = row[h]
            first += 1
    matrix = np.empty((m + 1, m, lanes), np.float32)
    columns = np.empty((TERMS, m + 1, lanes), np.float32)
    product, square = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
    likelihood = np.empty(lanes, np.float32)
    best = np.full(lanes, -np.inf, np.float32)
    strength, chroma = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
    for e in range(amplitudes.size):
        for lane in range(lanes):
            strength[lane] = amplitudes[e] * scales[lane]
            chroma[lane] = chromas[e]
        for h in probes:
            _fill(sums[h], known, seen, strength, chroma, matrix)
            _log_likelihood(matrix, measured, freedom, columns, product, square, likelihood)
            for lane in range(lanes):
                if likelihood[lane] > best[lane]:
                    best[lane] = likelihood[lane]
                    chosen[lane] = e
    for lane in range(lanes):
        kind = chosen[lane]
        strength[lane] = amplitudes[kind] * scales[lane]
        chroma[lane] = chromas[kind]
    for h in range(disparities):
        _fill(sums[h], known, seen, strength, chroma, matrix)
        _log_likelihood(matrix, measured, freedom, columns, product, square, likelihood)
        for lane in range(lanes):
            out[lane, h] = likelihood[lane]

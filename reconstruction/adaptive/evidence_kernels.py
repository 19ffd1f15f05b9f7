"""Kernels of the patches' evidence: covariances of readings, their factors, log-likelihoods.

LANES patches are worked on side by side: arrays end with (..., lane), and the innermost loops run
along it. Sums are taken four terms at a time, and of rows and columns in tiles: a value read serves
several, and tiles lie one after the other, so that no power of two lies between their rows. What is
worked on together lies a constant apart in flat arrays, else checks for overlap keep the compiler
from vectors.
"""

from __future__ import annotations

from math import log, sqrt
from typing import Any, NamedTuple

import numpy as np

from emmc_rig.model.compiling import njit

LANES = 64
TERMS = 4
"""Terms of a sum taken at a time: tables are padded with zeros to a multiple of it."""


class Hypotheses(NamedTuple):
    """The readings, and the textures that may explain them.

    weights, colour: Psi's. usable, data, variance: (shot, pixel_y, pixel_x), data being the
    readings less those of the mean. places: (reading, 3), shot, and row and column of the pixel
    from a patch's corner. binning: k. waves: (wave, ray), of which the rays' spectra are made.
    offsets: (reading, reading), the index of how far two pixels lie apart. tables: (offset,
    hypothesis, wave), the texture's correlation, padded with zeros to a multiple of TERMS
    hypotheses. amplitudes, chromas: (kind,), variance of luminance, times a patch's scale, and of a
    chrominance over that of luminance. probes: indices of the disparities at which every kind is
    compared. freedom: of the Student t.
    """

    weights: Any
    colour: Any
    usable: Any
    data: Any
    variance: Any
    places: Any
    binning: Any
    waves: Any
    offsets: Any
    tables: Any
    amplitudes: Any
    chromas: Any
    probes: Any
    freedom: Any


@njit(forceinline=True, fastmath=True)
def _gather(given, corners, rays, known, seen, measured):
    """Cut Psi, data, variances and colours into patches, one a lane; nothing where not usable.

    corners: (lane, 2) of pixels. rays: (part, reading, ray, lane), luminance and, where three
    colours are stored, two chrominances. known: (2, reading, lane), data and variance. seen:
    (reading, lane) colour. measured: (lane,), how many are usable.
    """
    weights, colour, usable, data, variance, places, binning = given[:7]
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
            known[1, i, lane] = variance[s, y, x]
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


@njit(forceinline=True, fastmath=True)
def _meet(here, there, meetings):
    """Add to meetings (wave, lane) the spectrum of how two pixels' rays are correlated.

    here, there: their own spectra (wave, lane), cosine and sine by turns. All flat.
    """
    for k in range(0, meetings.size, 2 * LANES):
        a, b, total = here[k : k + 2 * LANES], there[k : k + 2 * LANES], meetings[k : k + 2 * LANES]
        for lane in range(LANES):
            even, odd = a[lane], a[LANES + lane]
            total[lane] += even * b[lane] + odd * b[LANES + lane]
            total[LANES + lane] += odd * b[lane] - even * b[LANES + lane]


@njit(forceinline=True, fastmath=True)
def _mixed(table, terms, out):
    """Set out (row, lane) to table (row, term) times terms (term, lane), the latter two flat.

    TERMS rows and terms at a time: a value read serves as many sums.
    """
    width = TERMS * LANES
    out[:] = 0
    for h in range(0, table.shape[0], TERMS):
        total = out[h * LANES : h * LANES + width]
        first, second, third, fourth = table[h], table[h + 1], table[h + 2], table[h + 3]
        for k in range(0, table.shape[1], TERMS):
            part = terms[k * LANES : k * LANES + width]
            p, q, r, s = first[k], first[k + 1], first[k + 2], first[k + 3]
            e, f, g, i = second[k], second[k + 1], second[k + 2], second[k + 3]
            t, u, v, w = third[k], third[k + 1], third[k + 2], third[k + 3]
            x, y, z, o = fourth[k], fourth[k + 1], fourth[k + 2], fourth[k + 3]
            for lane in range(LANES):
                a, b = part[lane], part[LANES + lane]
                c, d = part[2 * LANES + lane], part[3 * LANES + lane]
                total[lane] += p * a + q * b + r * c + s * d
                total[LANES + lane] += e * a + f * b + g * c + i * d
                total[2 * LANES + lane] += t * a + u * b + v * c + w * d
                total[3 * LANES + lane] += x * a + y * b + z * c + o * d


@njit(forceinline=True, fastmath=True)
def _less_products(left, right, tile):
    """Take the product of a tile and another's transpose off a third, all (row, column, lane)."""
    for lane in range(LANES):
        for i in range(TERMS):
            at = i * TERMS * LANES + lane
            a, b, c, d = left[at], left[at + LANES], left[at + 2 * LANES], left[at + 3 * LANES]
            for j in range(TERMS):
                by = j * TERMS * LANES + lane
                tile[at + j * LANES] -= (
                    a * right[by]
                    + b * right[by + LANES]
                    + c * right[by + 2 * LANES]
                    + d * right[by + 3 * LANES]
                )


@njit(forceinline=True, fastmath=True)
def _solved(diagonal, inverses, tile):
    """Divide a tile by the transpose of a diagonal one's factor; inverses: of its pivots."""
    for i in range(TERMS):
        for j in range(TERMS):
            at = (i * TERMS + j) * LANES
            for k in range(j):
                to, by = (i * TERMS + k) * LANES, (j * TERMS + k) * LANES
                for lane in range(LANES):
                    tile[at + lane] -= tile[to + lane] * diagonal[by + lane]
            for lane in range(LANES):
                tile[at + lane] *= inverses[j * LANES + lane]


@njit(forceinline=True, fastmath=True)
def _factored(tile, inverses, product):
    """Put the Cholesky factor of a diagonal tile in its place; set product to that of its pivots.

    inverses: of the factor's diagonal, set.
    """
    product[:] = 1
    for j in range(TERMS):
        for i in range(j, TERMS):
            at = (i * TERMS + j) * LANES
            for k in range(j):
                to, by = (i * TERMS + k) * LANES, (j * TERMS + k) * LANES
                for lane in range(LANES):
                    tile[at + lane] -= tile[to + lane] * tile[by + lane]
            for lane in range(LANES):
                if i == j:
                    pivot = max(tile[at + lane], np.float32(1e-12))
                    product[lane] *= pivot
                    inverses[j * LANES + lane] = np.float32(1.0) / np.sqrt(pivot)
                else:
                    tile[at + lane] *= inverses[j * LANES + lane]


@njit(forceinline=True, fastmath=True)
def _log_likelihood(tiles, data, measured, freedom, inverses, product, square, out):
    """Set out (lane,) to the log-likelihoods of data (reading, lane), all flat.

    tiles: (tile, row, column, lane), the lower triangle of scale matrices of multivariate t
    distributions, with `freedom` degrees and measured (lane,) readings, in tiles of TERMS x TERMS,
    row by row; constants are left out. Tiles and data are destroyed. inverses: as data, product,
    square: (lane,), to work in.
    """
    size, strip = TERMS * TERMS * LANES, TERMS * LANES
    out[:] = 0
    for i in range(inverses.size // strip):
        first = i * (i + 1) // 2
        for j in range(i + 1):
            other = j * (j + 1) // 2
            tile = tiles[(first + j) * size : (first + j + 1) * size]
            for k in range(j):
                left = tiles[(first + k) * size : (first + k + 1) * size]
                right = tiles[(other + k) * size : (other + k + 1) * size]
                _less_products(left, right, tile)
            if j < i:
                diagonal = tiles[(other + j) * size : (other + j + 1) * size]
                _solved(diagonal, inverses[j * strip : (j + 1) * strip], tile)
            else:
                _factored(tile, inverses[i * strip : (i + 1) * strip], product)
        for lane in range(LANES):
            out[lane] -= 0.5 * log(product[lane])
    square[:] = 0
    for i in range(inverses.size // LANES):
        block, row = i // TERMS, i % TERMS
        own = data[i * LANES : (i + 1) * LANES]
        for k in range(i):
            at = block * (block + 1) // 2 + k // TERMS
            at = ((at * TERMS + row) * TERMS + k % TERMS) * LANES
            for lane in range(LANES):
                own[lane] -= tiles[at + lane] * data[k * LANES + lane]
        for lane in range(LANES):
            own[lane] *= inverses[i * LANES + lane]
            square[lane] += own[lane] ** 2
    for lane in range(LANES):
        out[lane] -= 0.5 * (freedom + measured[lane]) * log(1 + square[lane] / freedom)


@njit(forceinline=True, fastmath=True)
def _fill(sums, known, seen, strength, chroma, tiles, data):
    """Set tiles, see `_log_likelihood`, to the readings' covariance, and data to their values.

    sums: (part, pair, lane). strength, chroma: (lane,). seen: (reading, lane), or no reading where
    three colours are stored.
    """
    third = np.float32(1.0 / 3.0)
    first = 0
    for i in range(known.shape[1]):
        block = i // TERMS
        for j in range(i + 1):
            at = block * (block + 1) // 2 + j // TERMS
            at = ((at * TERMS + i % TERMS) * TERMS + j % TERMS) * LANES
            row = tiles[at : at + LANES]
            grey = sums[0, first]
            if sums.shape[0] == 1:
                a, b = seen[i], seen[j]
                for lane in range(LANES):
                    same = np.float32(1.0) if a[lane] == b[lane] else np.float32(0.0)
                    row[lane] = (
                        strength[lane] * grey[lane] * (third + chroma[lane] * (same - third))
                    )
            else:
                tint = sums[1, first]
                for lane in range(LANES):
                    row[lane] = strength[lane] * (grey[lane] + chroma[lane] * tint[lane])
            first += 1
        for lane in range(LANES):
            row[lane] += known[1, i, lane]
            data[i * LANES + lane] = known[0, i, lane]


@njit(cache=True, fastmath=True, nogil=True)
def evidence(given, corners, scales, out, chosen):
    """Set out (lane, hypothesis) to log-likelihoods, constants left out, and chosen (lane, length).

    given: `Hypotheses`. A hypothesis is a length of the texture, and a disparity: all disparities
    of the first, ... corners: (lane, 2) pixels. scales: (lane,), of the amplitudes. out is that of
    the best kind of texture, `chosen`.
    """
    weights, _, _, _, _, places, _, waves, offsets, tables, amplitudes, chromas = given[:12]
    probes, freedom = given[12:]
    stored = weights.shape[4]
    readings = places.shape[0]
    m = -(-readings // TERMS) * TERMS
    lanes = corners.shape[0]
    hypotheses, rows, spectrum = out.shape[1], tables.shape[1], tables.shape[2]
    parts = 1 if stored == 1 else 3
    groups = 1 if stored == 1 else 2
    rays = np.zeros((parts, readings, waves.shape[1], lanes), np.float32)
    known = np.zeros((2, m, lanes), np.float32)
    known[1] = 1
    seen = np.zeros((m, lanes), np.uint8)
    measured = np.zeros(lanes, np.float32)
    _gather(given, corners, rays, known, seen, measured)
    spectra = np.empty((parts, readings, spectrum * lanes), np.float32)
    for part in range(parts):
        for i in range(readings):
            _mixed(waves, rays[part, i].reshape(-1), spectra[part, i])
    sums = np.zeros((hypotheses, groups, m * (m + 1) // 2, lanes), np.float32)
    meetings = np.empty(spectrum * lanes, np.float32)
    row = np.empty((rows, lanes), np.float32)
    flat_row = row.reshape(-1)
    first = 0
    for i in range(readings):
        for j in range(i + 1):
            for part in range(parts):
                if part < 2:
                    meetings[:] = 0
                _meet(spectra[part, i], spectra[part, j], meetings)
                if part != 1:
                    _mixed(tables[offsets[i, j]], meetings, flat_row)
                    for h in range(hypotheses):
                        # A loop: copying an array compiles for seconds, for its message of shapes.
                        for lane in range(lanes):
                            sums[h, min(part, 1), first, lane] = row[h, lane]
            first += 1
    blocks = m // TERMS
    tiles = np.zeros(blocks * (blocks + 1) // 2 * TERMS * TERMS * LANES, np.float32)
    values, inverses = np.empty(m * LANES, np.float32), np.empty(m * LANES, np.float32)
    product, square = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
    likelihood = np.empty(lanes, np.float32)
    best = np.empty(lanes, np.float32)
    strength, chroma = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
    lengths = chosen.shape[1]
    each = hypotheses // lengths
    for length in range(lengths):
        best[:] = -np.inf
        for e in range(amplitudes.size):
            for lane in range(lanes):
                strength[lane] = amplitudes[e] * scales[lane]
                chroma[lane] = chromas[e]
            for h in probes:
                _fill(sums[length * each + h], known, seen, strength, chroma, tiles, values)
                _log_likelihood(
                    tiles, values, measured, freedom, inverses, product, square, likelihood
                )
                for lane in range(lanes):
                    if likelihood[lane] > best[lane]:
                        best[lane] = likelihood[lane]
                        chosen[lane, length] = e
        for lane in range(lanes):
            kind = chosen[lane, length]
            strength[lane] = amplitudes[kind] * scales[lane]
            chroma[lane] = chromas[kind]
        for h in range(length * each, (length + 1) * each):
            _fill(sums[h], known, seen, strength, chroma, tiles, values)
            _log_likelihood(tiles, values, measured, freedom, inverses, product, square, likelihood)
            for lane in range(lanes):
                out[lane, h] = likelihood[lane]

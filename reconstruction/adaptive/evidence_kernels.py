"""Kernels of the patches' evidence: covariances of readings, their factors, log-likelihoods.

LANES patches are worked on side by side: arrays end with (..., lane), and what takes the time is
done in tiles of vectors (`register_tiles`). Covariances of all hypotheses of a group of patches are
kept: for each pair of readings, few sums over the spectrum make them all.
"""

from __future__ import annotations

from math import log, sqrt
from typing import Any, NamedTuple

import numpy as np

from emmc_rig.model.compiling import njit
from reconstruction.adaptive.register_tiles import (
    LANES,
    SIDE,
    divided,
    factored,
    less_products,
    load_tile,
    plus_outer,
    store_tile,
    substitute,
    take_applied,
    zero_tile,
)

SIZE = SIDE * SIDE * LANES
"""Numbers of a tile."""
LEAST = 1e-12
"""Of a squared pivot: of a covariance that is not positive definite in float32."""
LOGS = 8
"""Tiles of pivots between logarithms: 32 of 1e6 each are far from the end of float64."""


class Hypotheses(NamedTuple):
    """The readings, and the textures that may explain them.

    weights, colour: Psi's. usable, data, variance: (shot, pixel_y, pixel_x), data being the
    readings less those of the mean. places: (reading, 3), shot, and row and column of the pixel
    from a patch's corner. binning: k. waves: (wave, ray), of which the rays' spectra are made, in
    multiples of SIDE. pairs: (set, SIDE, 2), the pairs of readings, first >= second, SIDE of them
    with pixels equally far apart a set. offsets: (set,), how far, an index of tables. tables:
    (offset, texture, wave), the texture's correlation; a texture is a length and a disparity: all
    disparities of the first length, ... amplitudes, chromas: (kind,), variance of luminance, times
    a patch's scale, and of a chrominance over that of luminance. kept: of the kinds, how many are
    compared further after a patch's first probe. freedom: of the Student t.
    """

    weights: Any
    colour: Any
    usable: Any
    data: Any
    variance: Any
    places: Any
    binning: Any
    waves: Any
    pairs: Any
    offsets: Any
    tables: Any
    amplitudes: Any
    chromas: Any
    kept: Any
    freedom: Any


@njit(forceinline=True, fastmath=True)
def _gather(given, corners, rays, known, seen, measured):
    """Cut Psi, data, variances and colours into patches, one a lane; nothing where not usable.

    corners: (lane, 2) of pixels. rays: (part, reading, ray, lane), luminance and, where three
    colours are stored, two chrominances. known: (2, reading, lane), data and variance. seen:
    (reading, lane) colour. measured: (lane,), how many are usable. All are set.
    """
    rays[:] = 0
    known[0] = 0
    known[1] = 1
    seen[:] = 0
    measured[:] = 0
    weights, colour, usable, data, variance, places, binning = given[:7]
    _, views_v, views_u, _, stored, _ = weights.shape
    lanes = corners.shape[0]
    for i in range(places.shape[0]):
        s = places[i, 0]
        for lane in range(lanes):
            y, x = corners[lane, 0] + places[i, 1], corners[lane, 1] + places[i, 2]
            if not usable[s, y, x]:
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
def _copy(source, start, target, at):
    """Copy the vector at source[start] to target[at], both flat.

    A loop: copying a part of an array compiles for seconds, for its message of shapes.
    """
    values, into = source[start : start + LANES], target[at : at + LANES]
    for lane in range(LANES):
        into[lane] = values[lane]


@njit(forceinline=True, fastmath=True)
def _product(table, rows, first, vectors, at, apart, terms):
    """Return a tile, SIDE rows of a table (flat, their starts in `rows`) times SIDE of vectors.

    vectors: (column, term, lane), flat, from `at`; columns lie `apart`.
    """
    tile = zero_tile()
    for term in range(terms):
        tile = plus_outer(tile, table, rows, first, term, vectors, at + term * LANES, apart)
    return tile


@njit(forceinline=True, fastmath=True)
def _analyse(waves, rays, starts, row, spectra):
    """Set spectra (part, reading, wave * lane) to waves (wave, ray) times rays, see `_gather`.

    starts: (wave,), of the rows of waves. row: a tile, flat, to work in.
    """
    inputs, table = waves.shape[1], waves.reshape(-1)
    width = inputs * LANES
    for part in range(rays.shape[0]):
        given = rays[part].reshape(-1)
        for i in range(0, rays.shape[1], SIDE):
            for wave in range(0, waves.shape[0], SIDE):
                tile = _product(table, starts, wave, given, i * width, width, inputs)
                store_tile(tile, row, 0)
                for r in range(SIDE):
                    for c in range(SIDE):
                        _copy(row, (r * SIDE + c) * LANES, spectra[part, i + c], (wave + r) * LANES)


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
def _tile_at(i, j):
    """Return where the entry of row i and column j <= i lies among tiles, lane 0."""
    block = i // SIDE
    tile = block * (block + 1) // 2 + j // SIDE
    return tile * SIZE + (i % SIDE * SIDE + j % SIDE) * LANES


@njit(forceinline=True, fastmath=True)
def _correlate(given, spectra, starts, meetings, row, sums):
    """Set sums (hypothesis, part, tile), flat tiles, to the correlations of all pairs of readings.

    spectra: (part, reading, wave * lane). starts: (hypothesis,), of its row of an offset's table.
    meetings: (pair, wave * lane), row: a tile, both flat, to work in.
    """
    pairs, offsets, tables = given.pairs, given.offsets, given.tables
    terms = tables.shape[2]
    width = terms * LANES
    for one in range(pairs.shape[0]):
        table = tables[offsets[one]].reshape(-1)
        for part in range(spectra.shape[0]):
            if part < 2:
                meetings[:] = 0
            for pair in range(SIDE):
                here, there = spectra[part, pairs[one, pair, 0]], spectra[part, pairs[one, pair, 1]]
                _meet(here, there, meetings[pair * width : (pair + 1) * width])
            if part == 1:
                continue
            for h in range(0, starts.size, SIDE):
                tile = _product(table, starts, h, meetings, 0, width, terms)
                store_tile(tile, row, 0)
                for pair in range(SIDE):
                    at = _tile_at(pairs[one, pair, 0], pairs[one, pair, 1])
                    for i in range(SIDE):
                        _copy(row, (i * SIDE + pair) * LANES, sums[h + i, min(part, 1)], at)


@njit(forceinline=True, fastmath=True)
def _fill(sums, known, alike, strength, chroma, tiles, values):
    """Set tiles to the readings' covariance, and values to the readings.

    sums: (part, tiles). alike: as tiles, by how much more than a third two pixels' colours are the
    same, of no tile where three colours are stored. strength, chroma: (lane,).
    """
    third = np.float32(1.0 / 3.0)
    grey = sums[0]
    if sums.shape[0] == 1:
        for at in range(0, tiles.size, LANES):
            own, same, out = grey[at : at + LANES], alike[at : at + LANES], tiles[at : at + LANES]
            for lane in range(LANES):
                out[lane] = strength[lane] * own[lane] * (third + chroma[lane] * same[lane])
    else:
        tint = sums[1]
        for at in range(0, tiles.size, LANES):
            own, other, out = grey[at : at + LANES], tint[at : at + LANES], tiles[at : at + LANES]
            for lane in range(LANES):
                out[lane] = strength[lane] * (own[lane] + chroma[lane] * other[lane])
    for i in range(known.shape[1]):
        at = _tile_at(i, i)
        for lane in range(LANES):
            tiles[at + lane] += known[1, i, lane]
            values[i * LANES + lane] = known[0, i, lane]


@njit(forceinline=True, fastmath=True)
def _log_likelihood(tiles, values, measured, freedom, product, square, out):
    """Set out (lane,) to the log-likelihoods of values (reading, lane), flat.

    tiles: (tile, row, column, lane), flat, the lower triangle of scale matrices of multivariate t
    distributions, with `freedom` degrees and measured (lane,) readings, row by row; constants are
    left out. Tiles and values are destroyed. product, square: (lane,), to work in.
    """
    out[:] = 0
    product[:] = 1
    square[:] = 0
    strip = SIDE * LANES
    blocks = values.size // strip
    for i in range(blocks):
        first = i * (i + 1) // 2
        for j in range(i + 1):
            other = j * (j + 1) // 2
            tile = load_tile(tiles, (first + j) * SIZE)
            for k in range(j):
                tile = less_products(tile, tiles, (first + k) * SIZE, (other + k) * SIZE)
            if j < i:
                tile = divided(tile, tiles, (other + j) * SIZE)
                take_applied(tile, values, j * strip, i * strip)
            else:
                tile = factored(tile, np.float32(LEAST))
                substitute(tile, values, i * strip)
            store_tile(tile, tiles, (first + j) * SIZE)
        for row in range(SIDE):
            at = (first + i) * SIZE + row * (SIDE + 1) * LANES
            value = values[(i * SIDE + row) * LANES : (i * SIDE + row + 1) * LANES]
            for lane in range(LANES):
                product[lane] *= tiles[at + lane]
                square[lane] += value[lane] ** 2
        if i % LOGS == LOGS - 1 or i == blocks - 1:
            for lane in range(LANES):
                out[lane] += log(product[lane])
            product[:] = 1
    for lane in range(LANES):
        out[lane] -= 0.5 * (freedom + measured[lane]) * log(1 + square[lane] / freedom)


@njit(forceinline=True, fastmath=True)
def _compare_colours(seen, alike):
    """Set alike, flat tiles, to by how much more than a third the colours seen are the same."""
    for i in range(seen.shape[0]):
        for j in range(i + 1):
            at = _tile_at(i, j)
            for lane in range(LANES):
                same = np.float32(1.0) if seen[i, lane] == seen[j, lane] else np.float32(0.0)
                alike[at + lane] = same - np.float32(1.0 / 3.0)


@njit(forceinline=True, fastmath=True)
def _rank(best, ranks):
    """Order ranks (rank, lane), indices of rows of best (kind, lane), the largest first."""
    for lane in range(LANES):
        for end in range(1, ranks.shape[0]):
            at, kind = end, ranks[end, lane]
            while at > 0 and best[kind, lane] > best[ranks[at - 1, lane], lane]:
                ranks[at, lane] = ranks[at - 1, lane]
                at -= 1
            ranks[at, lane] = kind


@njit(cache=True, fastmath=True, nogil=True)
def evidence(given, corners, scales, textures, counts, probes, out, chosen):
    """Set out (patch, texture) to log-likelihoods, constants left out, and chosen (patch, length).

    given: `Hypotheses`. Every LANES patches are a group. corners: (patch, 2) pixels. scales:
    (patch,), of the amplitudes. textures: (group, texture), those to compare, counts: (group,), how
    many. probes: (group, probe), at which of a length's textures kinds are compared: all at the
    first, those kept at the others. out is set at the group's textures only, for the kind that
    explains the patch best at any of the probes, `chosen`; without probes that is given.
    """
    stored, kinds = given.weights.shape[4], given.amplitudes.size
    m = -(-given.places.shape[0] // SIDE) * SIDE
    terms, inputs = given.waves.shape
    blocks = m // SIDE
    entries = blocks * (blocks + 1) // 2 * SIZE
    most = -(-counts.max() // SIDE) * SIDE
    parts = 1 if stored == 1 else 3
    rays = np.empty((parts, m, inputs, LANES), np.float32)
    spectra = np.empty((parts, m, terms * LANES), np.float32)
    known = np.empty((2, m, LANES), np.float32)
    seen = np.empty((m, LANES), np.uint8)
    alike = np.zeros(entries if stored == 1 else 0, np.float32)
    # What is no pair of readings, within diagonal tiles and beyond the last reading, stays 0.
    sums = np.zeros((most, 1 if stored == 1 else 2, entries), np.float32)
    meetings = np.empty(SIDE * terms * LANES, np.float32)
    row, tiles = np.empty(SIZE, np.float32), np.empty(entries, np.float32)
    values = np.empty(m * LANES, np.float32)
    measured, square = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    product, likelihood = np.empty(LANES, np.float64), np.empty(LANES, np.float32)
    strength, chroma = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    best, ranks = np.empty((kinds, LANES), np.float32), np.empty((kinds, LANES), np.int64)
    wave_starts = np.arange(terms) * inputs
    trials = kinds + given.kept * (probes.shape[1] - 1) if probes.shape[1] else 0
    lengths = chosen.shape[1]
    for group in range(counts.size):
        first = group * LANES
        _gather(given, corners[first : first + LANES], rays, known, seen, measured)
        _analyse(given.waves, rays, wave_starts, row, spectra)
        count = counts[group]
        starts = np.empty(-(-count // SIDE) * SIDE, np.int64)
        for h in range(starts.size):
            starts[h] = textures[group, min(h, count - 1)] * terms
        _correlate(given, spectra, starts, meetings, row, sums)
        if stored == 1:
            _compare_colours(seen, alike)
        each = count // lengths
        # Of each length, first kinds are tried at probes, then all textures with the best kind: one
        # loop, since what it calls is compiled once for each place where it is called.
        for one in range(lengths * (trials + each)):
            length, turn = one // (trials + each), one % (trials + each)
            later = turn - kinds
            if turn == 0:
                best[:] = -np.inf
                for kind in range(kinds):
                    ranks[kind, :] = kind
            if turn >= trials:
                rank, h = 0, turn - trials
            elif turn < kinds:
                rank, h = turn, probes[group, 0]
            else:
                rank, h = later % given.kept, probes[group, 1 + later // given.kept]
            if rank == 0 and 0 < turn <= trials:
                _rank(best, ranks)
                for lane in range(LANES):
                    chosen[first + lane, length] = ranks[0, lane]
            h += length * each
            for lane in range(LANES):
                kind = ranks[rank, lane] if turn < trials else chosen[first + lane, length]
                strength[lane] = given.amplitudes[kind] * scales[first + lane]
                chroma[lane] = given.chromas[kind]
            _fill(sums[h], known, alike, strength, chroma, tiles, values)
            _log_likelihood(tiles, values, measured, given.freedom, product, square, likelihood)
            for lane in range(LANES):
                if turn < trials:
                    kind = ranks[rank, lane]
                    best[kind, lane] = max(best[kind, lane], likelihood[lane])
                else:
                    out[first + lane, textures[group, h]] = likelihood[lane]

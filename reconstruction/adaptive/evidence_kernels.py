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
from emmc_rig.reconstruction.adaptive.register_tiles import (
    LANES,
    SIDE,
    combined,
    divided,
    factored,
    less_products,
    load_tile,
    meet,
    meet_too,
    multiplied,
    plus_diagonal,
    plus_outer,
    scatter_tile,
    store_tile,
    substitute,
    take_applied,
    zero_tile,
)

SIZE = SIDE * SIDE * LANES
"""Numbers of a tile."""
LEAST = 1e-12
"""Of a squared pivot: of a covariance that is not positive definite in float32."""
LOWEST = np.float32(-1e30)
"""Below any log-likelihood; fast arithmetic knows no infinity."""
UNKNOWN = np.float32(1e6)
"""Variance of a reading that is not usable, where all patches share covariances."""
LOGS = 8
"""Tiles of pivots between logarithms: 32 of 1e6 each are far from the end of float64."""


class Hypotheses(NamedTuple):
    """The readings, and the textures that may explain them.

    A texture is a length and a disparity: all disparities of the first length, then of the next.

    Attributes:
        weights: Psi's, (shot, v, u, y, stored colour, x).
        colour: Psi's map of colours, (shot, y, x).
        usable: readings that count, (shot, pixel_y, pixel_x).
        data: readings less those of the smooth picture, (shot, pixel_y, pixel_x).
        variance: of the readings, (shot, pixel_y, pixel_x).
        places: shot, row and column of a reading from the patch's corner, (reading, 3).
        binning: samples k along a pixel's side.
        waves: of which the rays' spectra are made, (wave, ray), both in multiples of SIDE.
        pairs: of readings, first >= second; the pairs of a set lie equally far apart, (set, SIDE,
            2).
        spots: where a pair lies in the tiles of the covariance, (set, SIDE).
        offsets: how far the pairs of a set lie apart, an index of `tables`, (set,).
        tables: spectrum of the textures' correlation, (offset, texture, wave).
        amplitudes: of kinds, variance of luminance over a patch's scale, (kind,).
        chromas: of kinds, variance of a chrominance over that of luminance, (kind,).
        trials: length, probe and rank of the kinds to try, in order, (trial, 3).
        freedom: degrees of the Student t.
        shared: textures whose covariances all patches share, if Psi is the same at every pixel;
            empty if Psi differs.
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
    spots: Any
    offsets: Any
    tables: Any
    amplitudes: Any
    chromas: Any
    trials: Any
    freedom: Any
    shared: Any


@njit(forceinline=True, fastmath=True)
def _gather(given, corners, rays, known, seen, measured):
    """Cut Psi, data, variances and colours into patches, one a lane; nothing where not usable.

    corners: (lane, 2) of pixels. rays: (part, reading, ray, lane), luminance and, where three
    colours are stored, two chrominances, of usable readings, or all where they are shared. known:
    (2, reading, lane), data and variance. seen: (reading, lane) colour. measured: (lane,), how many
    are usable. All are set.
    """
    shared = given.shared.size > 0
    rays[:] = 0
    known[0] = 0
    known[1] = UNKNOWN if shared else np.float32(1)
    seen[:] = 0
    measured[:] = 0
    weights, colour, usable, data, variance, places, binning = given[:7]
    _, views_v, views_u, _, stored, _ = weights.shape
    lanes = corners.shape[0]
    for i in range(places.shape[0]):
        s = places[i, 0]
        for lane in range(lanes):
            y, x = corners[lane, 0] + places[i, 1], corners[lane, 1] + places[i, 2]
            if usable[s, y, x]:
                measured[lane] += 1
                known[0, i, lane] = data[s, y, x]
                known[1, i, lane] = variance[s, y, x]
            elif not shared:
                continue
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
def _product(table, rows, first, vectors, at, apart, terms):
    """Return a tile, SIDE rows of a table (flat, their starts in `rows`) times SIDE of vectors.

    vectors: (column, term, lane), flat, from `at`; columns lie `apart`.
    """
    tile = zero_tile()
    for term in range(terms):
        tile = plus_outer(tile, table, rows, first, term, vectors, at + term * LANES, apart)
    return tile


@njit(forceinline=True, fastmath=True)
def _analyse(waves, rays, starts, columns, spectra):
    """Set spectra (part, reading, wave * lane) to waves (wave, ray) times rays, see `_gather`.

    starts: (wave,), of the rows of waves. columns: of SIDE readings in the spectra.
    """
    inputs, table = waves.shape[1], waves.reshape(-1)
    width = inputs * LANES
    for part in range(rays.shape[0]):
        given, out = rays[part].reshape(-1), spectra[part].reshape(-1)
        for i in range(0, rays.shape[1], SIDE):
            for wave in range(0, waves.shape[0], SIDE):
                tile = _product(table, starts, wave, given, i * width, width, inputs)
                at = i * spectra.shape[2] + wave * LANES
                scatter_tile(tile, out, at, LANES, columns, 0)


@njit(forceinline=True, fastmath=True)
def _correlate(given, spectra, starts, meetings, sums):
    """Set sums (hypothesis, part, tile), flat tiles, to the correlations of all pairs of readings.

        sums_h(i, j) = sum_wave table_h(wave) Re, Im of (spectrum_i(wave) conj(spectrum_j(wave)))

    spectra: (part, reading, wave * lane), waves being cosines and sines by turns. starts:
    (hypothesis,), of its row of an offset's table. meetings: (pair, wave * lane), flat, to work in.
    The two chrominances are added in one part of the sums.
    """
    pairs, spots, tables = given.pairs, given.spots.reshape(-1), given.tables
    terms = tables.shape[2]
    width, apart = terms * LANES, sums.shape[1] * sums.shape[2]
    flat = sums.reshape(-1)
    for number in range(pairs.shape[0]):
        table = tables[given.offsets[number]].reshape(-1)
        for part in range(sums.shape[1]):
            own = spectra[part].reshape(-1)
            for pair in range(SIDE):
                here, there = pairs[number, pair, 0] * width, pairs[number, pair, 1] * width
                for wave in range(0, width, 2 * LANES):
                    meet(own, here + wave, there + wave, meetings, pair * width + wave)
                if part == 1:
                    other = spectra[2].reshape(-1)
                    for wave in range(0, width, 2 * LANES):
                        meet_too(other, here + wave, there + wave, meetings, pair * width + wave)
            for h in range(0, starts.size, SIDE):
                tile = _product(table, starts, h, meetings, 0, width, terms)
                at = h * apart + part * sums.shape[2]
                scatter_tile(tile, flat, at, apart, spots, number * SIDE)


@njit(forceinline=True, fastmath=True)
def _log_likelihood(
    sums, alike, mix, known, measured, freedom, tiles, values, product, square, out
):
    """Set out (lane,) to the log-likelihoods of readings, each lane a patch.

    Of a multivariate t distribution with f = `freedom` degrees and m measured readings y, without
    constants:

        C = diag(variance) + mix_0 sums_0 + mix_1 sums_1      (luminance and chrominances)
        C = L L^T                                             (tile by tile, row by row)
        out = sum(log 1 / L_ii) - (f + m) / 2 log(1 + |L^-1 y|^2 / f)

    sums: (part, tile entries), the lower triangle in tiles (row, column, lane). Where there is a
    single part, sums_1 = sums_0 * alike, entry by entry. mix: (2 * lane,). known: data y and
    variance, (2, reading, lane). measured: m, (lane,). Work space: tiles (the factor's), values
    (reading * lane), product and square (lane,).
    """
    out[:] = 0
    product[:] = 1
    square[:] = 0
    strip = SIDE * LANES
    blocks = values.size // strip
    data, variances = known[0].reshape(-1), known[1].reshape(-1)
    for at in range(values.size):
        values[at] = data[at]
    for i in range(blocks):
        first = i * (i + 1) // 2
        for j in range(i + 1):
            other = j * (j + 1) // 2
            at = (first + j) * SIZE
            tile = load_tile(sums[0], at)
            if sums.shape[0] == 1:
                tint = multiplied(tile, load_tile(alike, at))
            else:
                tint = load_tile(sums[1], at)
            tile = combined(tile, tint, mix)
            # C_ij - sum_k L_ik L_jk^T, then divided by L_jj^T, or factored on the diagonal.
            for k in range(j):
                tile = less_products(tile, tiles, (first + k) * SIZE, (other + k) * SIZE)
            if j < i:
                tile = divided(tile, tiles, (other + j) * SIZE)
                take_applied(tile, values, j * strip, i * strip)
            else:
                tile = factored(plus_diagonal(tile, variances, i * strip), np.float32(LEAST))
                substitute(tile, values, i * strip)
            store_tile(tile, tiles, at)
        # Diagonals of factors are stored inverted.
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
def _compare_colours(given, seen, alike):
    """Set alike, flat tiles, to by how much more than a third the colours seen are the same."""
    third = np.float32(1.0 / 3.0)
    for number in range(given.pairs.shape[0]):
        for pair in range(SIDE):
            i, j = given.pairs[number, pair]
            at = given.spots[number, pair]
            for lane in range(LANES):
                same = np.float32(1.0) if seen[i, lane] == seen[j, lane] else np.float32(0.0)
                alike[at + lane] = same - third


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
    many. probes: (group, probe), at which of a length's textures kinds are tried. out is set at the
    group's textures only, for the kind that explains the patch best at any of the probes,
    `chosen`; without trials that is given.
    """
    stored, kinds = given.weights.shape[4], given.amplitudes.size
    m = -(-given.places.shape[0] // SIDE) * SIDE
    terms, inputs = given.waves.shape
    blocks = m // SIDE
    entries = blocks * (blocks + 1) // 2 * SIZE
    # With shared covariances the first group's are those of all groups, at `where`.
    shared = given.shared.size
    most = -(-shared // SIDE) * SIDE
    if shared == 0:
        for count in counts:
            most = max(most, -(-count // SIDE) * SIDE)
    where = np.arange(max(most, given.tables.shape[1]))
    for h in range(shared):
        where[given.shared[h]] = h
    parts = 1 if stored == 1 else 3
    rays = np.empty((parts, m, inputs, LANES), np.float32)
    spectra = np.empty((parts, m, terms * LANES), np.float32)
    known = np.empty((2, m, LANES), np.float32)
    seen = np.empty((m, LANES), np.uint8)
    alike = np.zeros(entries if stored == 1 else 0, np.float32)
    # What is no pair of readings, within diagonal tiles and beyond the last reading, stays 0.
    sums = np.zeros((most, 1 if stored == 1 else 2, entries), np.float32)
    meetings = np.empty(SIDE * terms * LANES, np.float32)
    tiles, values = np.empty(entries, np.float32), np.empty(m * LANES, np.float32)
    measured, square = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    product, likelihood = np.empty(LANES, np.float64), np.empty(LANES, np.float32)
    mix = np.empty(2 * LANES, np.float32)
    # One colour seen is a third luminance.
    grey = np.float32(1.0 / 3.0) if stored == 1 else np.float32(1.0)
    best, ranks = np.empty((kinds, LANES), np.float32), np.empty((kinds, LANES), np.int64)
    most_likely = np.empty(LANES, np.float32)
    wave_starts, columns = np.arange(terms) * inputs, np.arange(SIDE) * terms * LANES
    trials, lengths = given.trials.shape[0], chosen.shape[1]
    for group in range(counts.size):
        first = group * LANES
        _gather(given, corners[first : first + LANES], rays, known, seen, measured)
        count = counts[group]
        if shared == 0 or group == 0:
            _analyse(given.waves, rays, wave_starts, columns, spectra)
            correlated = given.shared if shared > 0 else textures[group, :count]
            starts = np.empty(-(-correlated.size // SIDE) * SIDE, np.int64)
            for h in range(starts.size):
                starts[h] = correlated[min(h, correlated.size - 1)] * terms
            _correlate(given, spectra, starts, meetings, sums)
        if stored == 1:
            _compare_colours(given, seen, alike)
        each = count // lengths
        best[:] = LOWEST
        for kind in range(kinds):
            ranks[kind, :] = kind
        # First kinds are tried, then all textures with the best: one loop, since each call in the
        # source compiles the helper once more.
        for turn in range(-trials, count):
            if turn < 0:
                length, probe, rank = given.trials[turn + trials]
                h = length * each + probes[group, probe]
                if rank == 0:
                    _rank(best, ranks)
                    if probe == 0:
                        best[:] = LOWEST
                        most_likely[:] = LOWEST
            else:
                length, rank, h = turn // each, 0, turn
            for lane in range(LANES):
                kind = ranks[rank, lane] if turn < 0 else chosen[first + lane, length]
                strength = given.amplitudes[kind] * scales[first + lane]
                mix[lane] = strength * grey
                mix[LANES + lane] = strength * given.chromas[kind]
            _log_likelihood(
                sums[where[textures[group, h]] if shared > 0 else h],
                alike,
                mix,
                known,
                measured,
                given.freedom,
                tiles,
                values,
                product,
                square,
                likelihood,
            )
            for lane in range(LANES):
                if turn >= 0:
                    out[first + lane, textures[group, h]] = likelihood[lane]
                    continue
                kind = ranks[rank, lane]
                best[kind, lane] = max(best[kind, lane], likelihood[lane])
                if likelihood[lane] > most_likely[lane]:
                    most_likely[lane] = likelihood[lane]
                    chosen[first + lane, length] = kind

"""Fused loops of the imaging matrix, over rows of pixels in parallel: see `row_kernel`.

Axes: weights (shot, v, u, y, stored colour, x); frames (shot, pixel_y, pixel_x); light fields as
stated for each. `colour` (shot, y, x): number of the only stored colour. A pixel sums
binning x binning samples; samples belong to one pixel only, so Psi Psi^T is one small block
(shot x shot) per pixel. Solvers keep the colours of a row apart, (v, u, y, colour, x): their
loops then run along x.
"""

from __future__ import annotations

import numpy as np

from emmc_rig.model.bands import row_kernel
from emmc_rig.model.compiling import njit


@njit(forceinline=True, fastmath=True)
def gather_row(weights, colour, block, part, shot, y, total):
    """Add a row of Psi L before binning: total[x] += sum_vuc W[shot, v, u, y, c, x] L[v, u, c, x].

    block[:, :, part] is row y of L, (v, u, colour, x).
    """
    views_v, views_u, stored, width = weights.shape[1], weights.shape[2], *weights.shape[4:]
    for v in range(views_v):
        for u in range(views_u):
            if stored == 1:
                weight = weights[shot, v, u, y, 0]
                which = colour[shot, y]
                lines = block[v, u, part]
                for x in range(width):
                    total[x] += weight[x] * lines[which[x], x]
            else:
                for c in range(3):
                    weight = weights[shot, v, u, y, c]
                    line = block[v, u, part, c]
                    for x in range(width):
                        total[x] += weight[x] * line[x]


@njit(forceinline=True, fastmath=True)
def spread_row(weights, colour, frame_row, shot, y, v, u, lines):
    """Add a row of Psi^T f for view (v, u): lines[c, x] += W[shot, v, u, y, c, x] frame_row[x]."""
    stored, width = weights.shape[4:]
    if stored == 1:
        weight = weights[shot, v, u, y, 0]
        which = colour[shot, y]
        for x in range(width):
            lines[which[x], x] += weight[x] * frame_row[x]
    else:
        for c in range(3):
            weight = weights[shot, v, u, y, c]
            line = lines[c]
            for x in range(width):
                line[x] += weight[x] * frame_row[x]


@njit(forceinline=True, fastmath=True)
def correct_row(inverse, frames, binning, row, seen):
    """Turn sums over views per sample, seen (shot, x), into the correction of a row of pixels.

    With the sums s of a pixel's samples, f its frames, and inverse = (Psi Psi^T + Lambda)^-1:

        residual[shot] = s[shot] - f[shot]
        seen[shot] = -sum_other inverse[shot, other] residual[other]    at each of its samples
    """
    shots, width = seen.shape
    pixels = width // binning
    residual = np.zeros((shots, pixels), frames.dtype)
    corrected = np.empty(pixels, frames.dtype)
    for shot in range(shots):
        for x in range(width):
            residual[shot, x // binning] += seen[shot, x]
        for x in range(pixels):
            residual[shot, x] -= frames[shot, row, x]
    for shot in range(shots):
        corrected[:] = 0
        for other in range(shots):
            for x in range(pixels):
                corrected[x] -= inverse[shot, other, row, x] * residual[other, x]
        for x in range(width):
            seen[shot, x] = corrected[x // binning]


@row_kernel("frames", 1, fastmath=True)
def project(begin, end, weights, colour, light_field, binning, frames):
    """Set frames f = Psi L of a light field L in its natural order (v, u, y, x, colour).

    f[s, i, j] = sum of W[s, v, u, y, c, x] L[v, u, y, x, c], over v, u, c and the samples (y, x)
                 of the pixel (i, j)
    """
    shots, views_v, views_u, _, stored, width = weights.shape
    for row in range(begin, end):
        total = np.empty(width, frames.dtype)
        for shot in range(shots):
            total[:] = 0
            for part in range(binning):
                y = row * binning + part
                for v in range(views_v):
                    for u in range(views_u):
                        samples = light_field[v, u, y]
                        if stored == 1:
                            weight = weights[shot, v, u, y, 0]
                            which = colour[shot, y]
                            for x in range(width):
                                total[x] += weight[x] * samples[x, which[x]]
                        else:
                            red, green, blue = weights[shot, v, u, y]
                            for x in range(width):
                                total[x] += (
                                    red[x] * samples[x, 0]
                                    + green[x] * samples[x, 1]
                                    + blue[x] * samples[x, 2]
                                )
            frames[shot, row, :] = 0
            for x in range(width):
                frames[shot, row, x // binning] += total[x]


@row_kernel("frames", 1, fastmath=True)
def back_project(begin, end, weights, colour, frames, binning, light_field):
    """Set a contiguous light field L = Psi^T f, in its natural order (v, u, y, x, colour).

        L[v, u, y, x, c] = sum_s W[s, v, u, y, c, x] f[s, y // k, x // k]

    The first shot sets the samples and the others add to them: every row is written once.
    """
    shots, views_v, views_u, _, stored, width = weights.shape
    for row in range(begin, end):
        spread = np.empty((shots, 3, width), frames.dtype)
        for part in range(binning):
            y = row * binning + part
            for shot in range(shots):
                for c in range(3):
                    for x in range(width):
                        seen = stored == 3 or colour[shot, y, x] == c
                        spread[shot, c, x] = frames[shot, row, x // binning] if seen else 0
            for v in range(views_v):
                for u in range(views_u):
                    samples = light_field[v, u, y].reshape(-1)
                    for shot in range(shots):
                        red, green, blue = spread[shot]
                        for_red = weights[shot, v, u, y, 0]
                        for_green = weights[shot, v, u, y, 1 % stored]
                        for_blue = weights[shot, v, u, y, 2 % stored]
                        if shot > 0:
                            for x in range(width):
                                samples[3 * x] += for_red[x] * red[x]
                                samples[3 * x + 1] += for_green[x] * green[x]
                                samples[3 * x + 2] += for_blue[x] * blue[x]
                        elif stored == 1:
                            for x in range(width):
                                weight = for_red[x]
                                samples[3 * x] = weight * red[x]
                                samples[3 * x + 1] = weight * green[x]
                                samples[3 * x + 2] = weight * blue[x]
                        else:
                            for x in range(width):
                                samples[3 * x] = for_red[x] * red[x]
                                samples[3 * x + 1] = for_green[x] * green[x]
                                samples[3 * x + 2] = for_blue[x] * blue[x]


@row_kernel("blocks", 2)
def gram(begin, end, weights, colour, binning, blocks):
    """Set blocks (shot, shot, pixel_y, pixel_x), float64, to those of Psi Psi^T.

    blocks[a, b, i, j] = sum of W_a W_b, over v, u, c and the samples of the pixel (i, j)
    """
    shots, views_v, views_u, _, stored, width = weights.shape
    total = np.empty(width)
    for row in range(begin, end):
        for a in range(shots):
            for b in range(a + 1):
                total[:] = 0
                for part in range(binning):
                    y = row * binning + part
                    for v in range(views_v):
                        for u in range(views_u):
                            for c in range(stored):
                                first, second = weights[a, v, u, y, c], weights[b, v, u, y, c]
                                for x in range(width):
                                    if stored == 3 or colour[a, y, x] == colour[b, y, x]:
                                        total[x] += np.float64(first[x]) * np.float64(second[x])
                for x in range(blocks.shape[3]):
                    value = 0.0
                    for sample in range(x * binning, (x + 1) * binning):
                        value += total[sample]
                    blocks[a, b, row, x] = blocks[b, a, row, x] = value


@row_kernel("blocks", 2)
def invert_blocks(begin, end, blocks, ridge, inverse, failed):
    """Set inverse to (blocks + diag(ridge))^-1 per pixel, by Cholesky in float64.

        blocks + diag(ridge) = lower lower^T
        lower solved = 1
        inverse = solved^T solved

    ridge: (shot, pixel_y, pixel_x), may be infinite (a measurement not to use).
    failed: (pixel_y,) counts the pixels of each row whose block is not positive definite.
    """
    shots = blocks.shape[0]
    for row in range(begin, end):
        lower = np.zeros((shots, shots))
        solved = np.zeros((shots, shots))
        for x in range(blocks.shape[3]):
            good = True
            for i in range(shots):
                for j in range(i + 1):
                    value = blocks[i, j, row, x]
                    if i == j:
                        value += ridge[i, row, x]
                    for k in range(j):
                        value -= lower[i, k] * lower[j, k]
                    if i == j:
                        scale = blocks[i, i, row, x] + ridge[i, row, x]
                        if not value > 1e-13 * scale and not np.isinf(scale):
                            good = False
                            value = 1.0
                        lower[i, i] = np.sqrt(value)
                    else:
                        lower[i, j] = value / lower[j, j]
            if not good:
                failed[row] += 1
                continue
            for column in range(shots):
                for i in range(shots):
                    value = 1.0 if i == column else 0.0
                    for k in range(i):
                        value -= lower[i, k] * solved[k, column]
                    solved[i, column] = value / lower[i, i]
            for i in range(shots):
                for j in range(shots):
                    value = 0.0
                    for k in range(max(i, j), shots):
                        value += solved[k, i] * solved[k, j]
                    inverse[i, j, row, x] = value

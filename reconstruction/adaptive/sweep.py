"""The disparity again, once the texture is nearly known: a plane sweep in the measurement domain.

The texture T predicts the frames for every plane, F_d = Psi L(T, d), one product each. Given that
pixel p lies at d its reading differs from F_d(p) by noise and by what the texture is wrong by
there. That variance is estimated from the frames: the mean square, around p, of the residual of the
present surfaces. Its tails are heavy (occlusions), so the log-likelihood is that of a Student t,

    l_d(p) = -(nu + 1) / 2 sum_shots log(1 + (I - F_d)^2(p) / (nu s^2(p))).

It is averaged along the picture's edges (guided filter, He, Sun and Tang 2013) and added to the
patches' beliefs: alone it would favour the disparity of T's fit. Neighbours agree by belief
propagation as in the search.
"""

from __future__ import annotations

from dataclasses import replace
from math import floor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.lanes import CUBIC, TAPS
from emmc_rig.reconstruction.adaptive.rays import Surfaces
from emmc_rig.reconstruction.adaptive.search import (
    FLOOR,
    SMOOTH_PX,
    Volume,
    compatibility,
    interpolated,
    places,
    posteriors,
)
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.inputs import Readings

Array = NDArray[np.floating]
RADIUS_PX, EDGE = 3, 1e-3
"""Of the guided filter; EDGE is the variance of the picture, in [0, 1], that counts as an edge.
RADIUS_PX: 2x +0.03, 0.5x -0.01 dB; EDGE: 2x 0.00, 0.5x 0.00 dB."""
WINDOW_PX = 4.0
"""Deviation of the window in which squared residuals of all readings are averaged. 2x 0.00, 0.5x
+0.01 dB."""
STRIDE = 2
"""Pixels between those whose disparity is asked for. 2x -0.01, 0.5x 0.00 dB."""


@njit(inline="always")
def cubic(fraction, taps):
    """Set the four weights of Catmull-Rom interpolation at a fraction in [0, 1)."""
    for tap in range(TAPS):
        weight = CUBIC[0][tap]
        for power in range(1, TAPS):
            weight = weight * fraction + CUBIC[power][tap]
        taps[tap] = weight


@njit(cache=True, fastmath=True, nogil=True)
def _see(weights, colour, texture, disparity, margin, binning, first, last, frames):
    """Add to pixel rows of frames (shot, pixel_y, pixel_x) what they see of a plane.

    texture: (c, y, x), padded by a margin that no ray leaves. Rows are interpolated once for all
    views beside each other, and only in the colours that a row of the sensor has.
    """
    shots, views_v, views_u, _, stored, columns = weights.shape
    colours, _, wide = texture.shape
    wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    line, seen = np.empty((colours, wide), np.float32), np.empty(columns, np.float32)
    has, sums = np.empty((shots, colours), np.bool_), np.empty((shots, columns), np.float32)
    none = np.float32(0)
    for y in range(first * binning, last * binning):
        for s in range(shots):
            for c in range(colours):
                has[s, c] = stored > 1 or np.any(colour[s, y] == c)
            for x in range(columns):
                sums[s, x] = 0
        for v in range(views_v):
            down = -disparity * (v - views_v // 2)
            cubic(np.float32(down - floor(down)), wy)
            p, q, r, t = wy[0], wy[1], wy[2], wy[3]
            top = y + margin + floor(down) - 1
            for c in range(colours):
                a, b = texture[c, top], texture[c, top + 1]
                d, e = texture[c, top + 2], texture[c, top + 3]
                for x in range(wide):
                    line[c, x] = p * a[x] + q * b[x] + r * d[x] + t * e[x]
            for u in range(views_u):
                right = -disparity * (u - views_u // 2)
                cubic(np.float32(right - floor(right)), wx)
                f, g, h, i = wx[0], wx[1], wx[2], wx[3]
                left = margin + floor(right) - 1
                for c in range(colours):
                    if not has[:, c].any():
                        continue
                    taps = line[c, left : left + columns + TAPS - 1]
                    for x in range(columns):
                        seen[x] = f * taps[x] + g * taps[x + 1] + h * taps[x + 2] + i * taps[x + 3]
                    for s in range(shots):
                        if not has[s, c]:
                            continue
                        row, filters = sums[s], colour[s, y]
                        for k in range(stored):
                            if stored > 1 and min(k, colours - 1) != c:
                                continue
                            w = weights[s, v, u, y, k]
                            for x in range(columns):
                                open = stored > 1 or filters[x] == c
                                row[x] += (w[x] if open else none) * seen[x]
        for s in range(shots):
            for x in range(columns):
                frames[s, y // binning, x // binning] += sums[s, x]


def plane_frames(psi: Psi, texture: Array, disparity: float, margin: int) -> Array:
    """Return the frames (shot, pixel_y, pixel_x) of a texture (c, y, x) on one plane.

    texture: padded by a margin, which the rays of the outermost views must not leave.
    """
    frames = np.zeros(psi.frames_shape, dtype=np.float32)
    texture = np.ascontiguousarray(texture, dtype=np.float32)

    def work(_: int, first: int, last: int) -> None:
        _see(
            psi.weights,
            psi.colour_map,
            texture,
            float(disparity),
            margin,
            psi.binning,
            first,
            last,
            frames,
        )

    in_bands(work, psi.frames_shape[1])
    return frames


def _likelihood(residual: Array, variance: Array, used: Array, alike: Any, freedom: float) -> Array:
    """Return the log-likelihood of every pixel (y, x) of residuals (shot, y, x), averaged.

    alike: the guided filter of the picture.
    """
    surprise = np.log1p(np.square(residual) / (freedom * variance)) * used
    each = (-(freedom + 1) / 2 * surprise.sum(axis=0)).astype(np.float32)
    return np.asarray(alike.filter(each), dtype=np.float32) * (2 * RADIUS_PX + 1) ** 2


def mean_around(values: Array, used: Array, window_px: float = WINDOW_PX) -> Array:
    """Return the mean over the used pixels around, shots apart, of (shot, y, x).

    used: 1 or 0, of the type of the values.
    """
    blurred = [
        cv2.GaussianBlur(a * b, (0, 0), window_px)
        / np.maximum(cv2.GaussianBlur(b, (0, 0), window_px), 1e-6)
        for a, b in zip(values, used, strict=True)
    ]
    return np.stack(blurred)


def swept(
    volume: Volume,
    given: Readings,
    texture: Array,
    surfaces: Surfaces,
    settings: AdaptiveSettings,
) -> Volume:
    """Return what to believe of every STRIDE-th pixel's disparity, given texture and patches.

    volume: of the search. given: readings over the scale; those usable count. texture: (c, y, x) of
    the present surfaces, padded by their margin.
    """
    psi, frames, noise, margin = given.psi, given.frames, given.noise, surfaces.margin
    residual = frames - surfaces.forward(texture)
    weight = given.usable.astype(np.float32)
    missed = mean_around(np.square(residual), weight).mean(axis=0)
    variance = np.maximum(missed, noise.mean(axis=0))
    k = psi.binning
    inner = texture[:, margin : margin + psi.size[0], margin : margin + psi.size[1]]
    pixels = inner.reshape(len(inner), psi.size[0] // k, k, psi.size[1] // k, k).mean(axis=(2, 4))
    guide = np.ascontiguousarray(np.moveaxis(pixels, 0, -1).astype(np.float32))
    rows, columns = (np.arange(0, length, STRIDE) for length in psi.frames_shape[1:])
    at = places(volume, rows.astype(float), columns.astype(float))
    half = max(psi.light_field_shape[:2]) // 2
    likeliest = volume.disparities[volume.probability.argmax(axis=-1)]
    # One evaluated disparity beyond the patches' likeliest, to both sides.
    low, high = likeliest.min() - SMOOTH_PX, likeliest.max() + SMOOTH_PX
    within = (volume.disparities >= low) & (volume.disparities <= high)
    within &= np.abs(volume.disparities) * half + TAPS <= margin
    labels = volume.disparities[within]
    evidence = np.empty((len(rows), len(columns), len(labels)), dtype=np.float32)
    all_known = np.flatnonzero(within)

    def work(_: int, first: int, last: int) -> None:
        alike = cv2.ximgproc.createGuidedFilter(guide, RADIUS_PX, EDGE)
        for label, known in enumerate(all_known[first:last], first):
            of_plane = frames - plane_frames(psi, texture, labels[label], margin)
            likelihood = _likelihood(of_plane, variance, weight, alike, settings.freedom)
            likelihood = likelihood[::STRIDE, ::STRIDE]
            believed = interpolated(
                volume, lambda grid, known=known: grid.probability[..., known], at
            )
            evidence[..., label] = likelihood + np.log(believed + np.float32(FLOOR / len(labels)))

    in_bands(work, len(labels))
    chances = posteriors(evidence, compatibility(labels, settings.slope_px * STRIDE, settings.jump))
    return replace(
        volume,
        disparities=labels,
        centres=(rows.astype(float), columns.astype(float)),
        probability=chances,
        evidence=evidence,
        between=None,
    )

"""Psi of textured surfaces: what the frames read when every ray sees a texture at its disparity.

A ray is a sample (y, x) of a view (v, u); at disparity d it sees the texture at
(y - d (v - V // 2), x - d (u - U // 2)), the place of that point in the centre view, by cubic
interpolation (Catmull-Rom). Textures reach beyond the centre view by a margin on all sides, since
other views see there. Operations: 2 x 16 per ray of weight not 0 (half of those of an RGBW mask)
and colour.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray
from scipy import sparse

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.assembly import TAPS, assembled, cubic, first_tap

Array32 = NDArray[np.float32]


@njit(cache=True, fastmath=True, parallel=True)
def project(weights, colour, disparity, hidden, factors, textures, margin, binning, frames):
    """Set frames (shot, pixel_y, pixel_x) to what rays see of textures.

    textures: (part, layer, c, y, x), padded; a ray sees the sum of the parts times factors
    (part, v, u). hidden: (v, u, y, x) uint8, the layer of a ray. disparity: (v, u, y, x).
    """
    shots, views_v, views_u, rows, stored, columns = weights.shape
    parts = textures.shape[0]
    last_y, last_x = textures.shape[3] - TAPS, textures.shape[4] - TAPS
    for pixel_row in prange(frames.shape[1]):
        wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
        for s in range(shots):
            for x in range(frames.shape[2]):
                frames[s, pixel_row, x] = 0
        for y in range(pixel_row * binning, (pixel_row + 1) * binning):
            for v in range(views_v):
                for u in range(views_u):
                    for x in range(columns):
                        seen = False
                        for s in range(shots):
                            for k in range(stored):
                                seen = seen or weights[s, v, u, y, k, x] != 0
                        if not seen:
                            continue
                        d = disparity[v, u, y, x]
                        layer = hidden[v, u, y, x]
                        iy, fy = first_tap(y - d * (v - views_v // 2), margin, last_y)
                        ix, fx = first_tap(x - d * (u - views_u // 2), margin, last_x)
                        cubic(fy, wy)
                        cubic(fx, wx)
                        for s in range(shots):
                            total = np.float32(0)
                            for k in range(stored):
                                w = weights[s, v, u, y, k, x]
                                if w == 0:
                                    continue
                                c = colour[s, y, x] if stored == 1 else k
                                for part in range(parts):
                                    t = textures[part, layer, c]
                                    value = np.float32(0)
                                    for j in range(TAPS):
                                        line = t[iy + j]
                                        value += wy[j] * (
                                            wx[0] * line[ix]
                                            + wx[1] * line[ix + 1]
                                            + wx[2] * line[ix + 2]
                                            + wx[3] * line[ix + 3]
                                        )
                                    total += w * factors[part, v, u] * value
                            frames[s, pixel_row, x // binning] += total


@njit(cache=True, fastmath=True, parallel=True)
def back_project(weights, colour, disparity, hidden, factors, frames, margin, binning, banded):
    """Add Psi^T frames to banded (band, part, layer, c, y, x): one buffer for each band of rows."""
    shots, views_v, views_u, rows, stored, columns = weights.shape
    bands, parts = banded.shape[:2]
    last_y, last_x = banded.shape[4] - TAPS, banded.shape[5] - TAPS
    for band in prange(bands):
        wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
        for y in range(rows * band // bands, rows * (band + 1) // bands):
            for v in range(views_v):
                for u in range(views_u):
                    for x in range(columns):
                        seen = False
                        for s in range(shots):
                            for k in range(stored):
                                seen = seen or weights[s, v, u, y, k, x] != 0
                        if not seen:
                            continue
                        d = disparity[v, u, y, x]
                        layer = hidden[v, u, y, x]
                        iy, fy = first_tap(y - d * (v - views_v // 2), margin, last_y)
                        ix, fx = first_tap(x - d * (u - views_u // 2), margin, last_x)
                        cubic(fy, wy)
                        cubic(fx, wx)
                        for s in range(shots):
                            reading = frames[s, y // binning, x // binning]
                            for k in range(stored):
                                w = weights[s, v, u, y, k, x] * reading
                                if w == 0:
                                    continue
                                c = colour[s, y, x] if stored == 1 else k
                                for part in range(parts):
                                    share = w * factors[part, v, u]
                                    t = banded[band, part, layer, c]
                                    for j in range(TAPS):
                                        line = t[iy + j]
                                        here = share * wy[j]
                                        line[ix] += here * wx[0]
                                        line[ix + 1] += here * wx[1]
                                        line[ix + 2] += here * wx[2]
                                        line[ix + 3] += here * wx[3]


@njit(cache=True, fastmath=True, parallel=True)
def render(disparity, hidden, textures, margin, out):
    """Set out (v, u, y, x, c) to the light field of textures (layer, c, y, x), padded."""
    views_v, views_u, rows, columns, colours = out.shape
    last_y, last_x = textures.shape[2] - TAPS, textures.shape[3] - TAPS
    for y in prange(rows):
        wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
        for v in range(views_v):
            for u in range(views_u):
                for x in range(columns):
                    d = disparity[v, u, y, x]
                    layer = hidden[v, u, y, x]
                    iy, fy = first_tap(y - d * (v - views_v // 2), margin, last_y)
                    ix, fx = first_tap(x - d * (u - views_u // 2), margin, last_x)
                    cubic(fy, wy)
                    cubic(fx, wx)
                    for c in range(colours):
                        t = textures[layer, c]
                        value = np.float32(0)
                        for j in range(TAPS):
                            line = t[iy + j]
                            value += wy[j] * (
                                wx[0] * line[ix]
                                + wx[1] * line[ix + 1]
                                + wx[2] * line[ix + 2]
                                + wx[3] * line[ix + 3]
                            )
                        out[v, u, y, x, c] = value


class Surfaces:
    """Psi of textures on surfaces: forward and adjoint between textures and frames.

    disparity: (v, u, y, x) of every ray, hidden: (v, u, y, x) uint8, 1 where the ray sees what the
    centre view does not. Textures have the shape `textures_shape`, (layer, c, y, x), padded by
    `margin` samples on all sides.
    """

    def __init__(
        self, psi: ImagingMatrix, disparity: Array32, hidden: NDArray[np.uint8], margin: int
    ) -> None:
        self.psi, self.disparity, self.hidden, self.margin = psi, disparity, hidden, margin
        rows, columns = psi.size
        self.textures_shape = (2, 3, rows + 2 * margin, columns + 2 * margin)
        views = psi.light_field_shape[:2]
        self._even = np.ones((1, *views), dtype=np.float32)
        steps = np.indices(views, dtype=np.float32)
        self._slopes = -np.stack([steps[0] - views[0] // 2, steps[1] - views[1] // 2])

    @cached_property
    def _matrix(self) -> sparse.csr_array | None:
        return assembled(self.psi, self.disparity, self.hidden, self.margin)

    @cached_property
    def _transposed(self) -> sparse.csc_array | None:
        return None if self._matrix is None else self._matrix.T

    def _project(self, textures: Array32, factors: Array32) -> Array32:
        frames = np.empty(self.psi.frames_shape, dtype=np.float32)
        project(
            self.psi.weights,
            self.psi.colour_map,
            self.disparity,
            self.hidden,
            factors,
            textures,
            self.margin,
            self.psi.binning,
            frames,
        )
        return frames

    def _back(self, frames: Array32, factors: Array32) -> Array32:
        bands = get_num_threads()
        banded = np.zeros((bands, len(factors), *self.textures_shape), dtype=np.float32)
        back_project(
            self.psi.weights,
            self.psi.colour_map,
            self.disparity,
            self.hidden,
            factors,
            np.ascontiguousarray(frames, dtype=np.float32),
            self.margin,
            self.psi.binning,
            banded,
        )
        return banded.sum(axis=0) if bands > 1 else banded[0]

    def forward(self, textures: Array32) -> Array32:
        """Return the frames (shot, pixel_y, pixel_x) of textures (layer, c, y, x)."""
        if self._matrix is not None:
            return (self._matrix @ textures.ravel()).reshape(self.psi.frames_shape)
        return self._project(textures[None], self._even)

    def adjoint(self, frames: Array32) -> Array32:
        """Return the adjoint of `forward`, (layer, c, y, x)."""
        if self._transposed is not None:
            return (self._transposed @ frames.ravel()).reshape(self.textures_shape)
        return self._back(frames, self._even)[0]

    def derivative(self, slopes: Array32) -> tuple[Callable, Callable]:
        """Return how frames change with the centre view's disparity, and the adjoint of that.

        slopes: (2, c, y, x), derivatives of the centre view's texture along y and x. The first maps
        (y, x), padded, to (shot, pixel_y, pixel_x); layers behind keep their disparity.
        """
        frames, size = self.psi.frames_shape, self.textures_shape[2:]
        matrix = assembled(self.psi, self.disparity, self.hidden, self.margin, slopes)
        if matrix is not None:
            transposed = matrix.T
            return (
                lambda change: (matrix @ change.ravel()).reshape(frames),
                lambda missed: (transposed @ missed.ravel()).reshape(size),
            )

        def forward(change: Array32) -> Array32:
            both = np.zeros((2, *self.textures_shape), dtype=np.float32)
            both[:, 0] = slopes * change
            return self._project(both, self._slopes)

        def adjoint(missed: Array32) -> Array32:
            return (slopes * self._back(missed, self._slopes)[:, 0]).sum(axis=(0, 1))

        return forward, adjoint

    def light_field(self, textures: Array32) -> Array32:
        """Return the light field (v, u, y, x, c) of textures (layer, c, y, x)."""
        out = np.empty(self.psi.light_field_shape, dtype=np.float32)
        render(self.disparity, self.hidden, textures, self.margin, out)
        return out

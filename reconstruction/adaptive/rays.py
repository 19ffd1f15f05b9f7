"""Psi of textured surfaces: what the frames read when every ray sees a texture at its disparity.

A ray is a sample (y, x) of a view (v, u); at disparity d it sees the texture at
(y - d (v - V // 2), x - d (u - U // 2)), the place of that point in the centre view, by cubic
interpolation (Catmull-Rom). Textures reach beyond the centre view by a margin on all sides, since
other views see there. Where memory allows, the rays are assembled to a sparse matrix (`assembly`);
else each is followed anew: 2 x 16 operations for every weight that is not 0.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numba import get_num_threads, njit
from numpy.typing import NDArray
from scipy import sparse

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.assembly import TAPS, assembled, cubic, first_tap
from reconstruction.adaptive.bands import in_bands

Array = NDArray[np.floating]


@njit(cache=True, fastmath=True, nogil=True)
def _follow(
    weights,
    colour,
    disparity,
    hidden,
    factors,
    margin,
    binning,
    first,
    last,
    back,
    textures,
    frames,
):
    """Project textures to the pixel rows first to last - 1 of frames, or, back, frames to textures.

    textures: (part, layer, c, y, x), padded; a ray sees the sum of the parts times factors
    (part, v, u). frames: (shot, pixel_y, pixel_x). What is projected to is added to.
    """
    shots, views_v, views_u, _, stored, columns = weights.shape
    parts = textures.shape[0]
    last_y, last_x = textures.shape[3] - TAPS, textures.shape[4] - TAPS
    wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    for y in range(first * binning, last * binning):
        for v in range(views_v):
            for u in range(views_u):
                for x in range(columns):
                    placed = False
                    iy, ix = 0, 0
                    layer = hidden[v, u, y, x]
                    for s in range(shots):
                        total = np.float32(0)
                        for k in range(stored):
                            w = weights[s, v, u, y, k, x]
                            if w == 0:
                                continue
                            if not placed:
                                d = disparity[v, u, y, x]
                                iy, fy = first_tap(y - d * (v - views_v // 2), margin, last_y)
                                ix, fx = first_tap(x - d * (u - views_u // 2), margin, last_x)
                                cubic(fy, wy)
                                cubic(fx, wx)
                                placed = True
                            c = colour[s, y, x] if stored == 1 else k
                            if back:
                                w *= frames[s, y // binning, x // binning]
                            for part in range(parts):
                                texture = textures[part, layer, c]
                                share = w * factors[part, v, u]
                                for i in range(TAPS):
                                    for j in range(TAPS):
                                        tap = share * wy[i] * wx[j]
                                        if back:
                                            texture[iy + i, ix + j] += tap
                                        else:
                                            total += tap * texture[iy + i, ix + j]
                        if not back:
                            frames[s, y // binning, x // binning] += total


@njit(cache=True, fastmath=True, nogil=True)
def _render(disparity, hidden, textures, margin, first, last, out):
    """Set rows first to last - 1 of out (v, u, y, x, c) to what rays see of (layer, c, y, x)."""
    views_v, views_u, _, columns, colours = out.shape
    last_y, last_x = textures.shape[2] - TAPS, textures.shape[3] - TAPS
    wy, wx = np.empty(TAPS, np.float32), np.empty(TAPS, np.float32)
    for v in range(views_v):
        for u in range(views_u):
            for y in range(first, last):
                for x in range(columns):
                    d = disparity[v, u, y, x]
                    texture = textures[hidden[v, u, y, x]]
                    iy, fy = first_tap(y - d * (v - views_v // 2), margin, last_y)
                    ix, fx = first_tap(x - d * (u - views_u // 2), margin, last_x)
                    cubic(fy, wy)
                    cubic(fx, wx)
                    for c in range(colours):
                        value = np.float32(0)
                        for i in range(TAPS):
                            for j in range(TAPS):
                                value += wy[i] * wx[j] * texture[c, iy + i, ix + j]
                        out[v, u, y, x, c] = value


class Surfaces:
    """Psi of textures on surfaces: forward and adjoint between textures and frames.

    disparity: (v, u, y, x) of every ray, hidden: (v, u, y, x) uint8, 1 where the ray sees what the
    centre view does not. Textures have the shape `textures_shape`, (layer, c, y, x), padded by
    `margin` samples on all sides; colours: of them, 1 for a Psi that sees only the first.
    """

    def __init__(
        self,
        psi: ImagingMatrix,
        disparity: Array,
        hidden: NDArray[np.uint8],
        margin: int,
        colours: int = 3,
    ) -> None:
        self.psi, self.disparity, self.hidden, self.margin = psi, disparity, hidden, margin
        rows, columns = psi.size
        self.textures_shape = (2, colours, rows + 2 * margin, columns + 2 * margin)
        views = psi.light_field_shape[:2]
        self._even = np.ones((1, *views), dtype=np.float32)
        steps = np.indices(views, dtype=np.float32)
        self._slopes = -np.stack([steps[0] - views[0] // 2, steps[1] - views[1] // 2])

    @cached_property
    def _matrix(self) -> sparse.csr_array | None:
        colours = self.textures_shape[1]
        return assembled(self.psi, self.disparity, self.hidden, self.margin, colours=colours)

    @cached_property
    def _transposed(self) -> sparse.csc_array | None:
        return None if self._matrix is None else self._matrix.T

    def _project(self, textures: Array, factors: Array) -> Array:
        frames = np.zeros(self.psi.frames_shape, dtype=np.float32)
        psi, rows = self.psi, self.psi.frames_shape[1]

        def work(_: int, first: int, last: int) -> None:
            _follow(
                psi.weights,
                psi.colour_map,
                self.disparity,
                self.hidden,
                factors,
                self.margin,
                psi.binning,
                first,
                last,
                False,
                textures,
                frames,
            )

        in_bands(work, rows)
        return frames

    def _back(self, frames: Array, factors: Array) -> Array:
        psi, rows = self.psi, self.psi.frames_shape[1]
        frames = np.ascontiguousarray(frames, dtype=np.float32)
        # Bands of rows reach the same texture: each adds to its own.
        textures = [
            np.zeros((len(factors), *self.textures_shape), dtype=np.float32)
            for _ in range(min(rows, get_num_threads()))
        ]

        def work(band: int, first: int, last: int) -> None:
            _follow(
                psi.weights,
                psi.colour_map,
                self.disparity,
                self.hidden,
                factors,
                self.margin,
                psi.binning,
                first,
                last,
                True,
                textures[band],
                frames,
            )

        in_bands(work, rows, len(textures))
        return sum(textures[1:], start=textures[0])

    def forward(self, textures: Array) -> Array:
        """Return the frames (shot, pixel_y, pixel_x) of textures (layer, c, y, x)."""
        if self._matrix is None:
            return self._project(textures[None], self._even)
        return (self._matrix @ textures.ravel()).reshape(self.psi.frames_shape)

    def adjoint(self, frames: Array) -> Array:
        """Return the adjoint of `forward`, (layer, c, y, x)."""
        if self._transposed is None:
            return self._back(frames, self._even)[0]
        return (self._transposed @ frames.ravel()).reshape(self.textures_shape)

    def derivative(self, slopes: Array) -> tuple[Callable, Callable]:
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

        def forward(change: Array) -> Array:
            both = np.zeros((2, *self.textures_shape), dtype=np.float32)
            both[:, 0] = slopes * change
            return self._project(both, self._slopes)

        def adjoint(missed: Array) -> Array:
            return (slopes * self._back(missed, self._slopes)[:, 0]).sum(axis=(0, 1))

        return forward, adjoint

    def light_field(self, textures: Array) -> Array:
        """Return the light field (v, u, y, x, c) of textures (layer, c, y, x)."""
        out = np.empty((*self.disparity.shape, textures.shape[1]), dtype=np.float32)

        def work(_: int, first: int, last: int) -> None:
            _render(self.disparity, self.hidden, textures, self.margin, first, last, out)

        in_bands(work, self.psi.size[0])
        return out

"""Psi of textured surfaces: what the frames read when every ray sees a texture at its disparity.

A ray is a sample (y, x) of a view (v, u); at disparity d it sees the texture at
(y - d (v - V // 2), x - d (u - U // 2)), the place of that point in the centre view, by cubic
interpolation (Catmull-Rom). Textures reach beyond the centre view by a margin on all sides, since
other views see there. The rays are laid out (`assembly`), once where memory allows.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.assembly import Layout, laid_out
from emmc_rig.reconstruction.adaptive.lanes import TAPS, read_taps

Array = NDArray[np.floating]


@njit(inline="always")
def _first_tap(position, margin, last):
    """Return the first of four taps within a padded texture, and the fraction beyond the second."""
    whole = np.floor(position)
    first = np.int64(whole) + margin - 1
    fraction = position - whole
    if first < 0:
        first, fraction = np.int64(0), np.float32(0)
    if first > last:
        first, fraction = last, np.float32(1)
    return first, fraction


@njit(cache=True, fastmath=True, nogil=True)
def _render(disparity, texture, margin, first, last, out):
    """Set rows first to last - 1 of out (v, u, y, x, c) to what rays see of (c, y, x)."""
    views_v, views_u, _, columns, colours = out.shape
    last_y, wide = texture.shape[1] - TAPS, texture.shape[2]
    flat, plane = texture.reshape(-1), texture.shape[1] * wide
    for v in range(views_v):
        for u in range(views_u):
            down, right = np.float32(views_v // 2 - v), np.float32(views_u // 2 - u)
            for y in range(first, last):
                for x in range(columns):
                    d = disparity[v, u, y, x]
                    iy, fy = _first_tap(np.float32(y) + d * down, margin, last_y)
                    ix, fx = _first_tap(np.float32(x) + d * right, margin, wide - TAPS)
                    for c in range(colours):
                        at = c * plane + iy * wide + ix
                        out[v, u, y, x, c] = read_taps(flat, at, wide, fy, fx)


@njit(cache=True, fastmath=True, nogil=True)
def _steepen(weights, colour, disparity, hidden, slopes, margin, first, last, out):
    """Set rows first to last - 1 of out (shot, v, u, y, 1, x): weights times what rays change by.

    slopes: (2, c, y, x), derivatives of the nearest texture, padded, along y and x. The change is
    that by the ray's disparity; none where the ray sees what lies behind.
    """
    shots, views_v, views_u, _, stored, columns = weights.shape
    last_y, wide = slopes.shape[2] - TAPS, slopes.shape[3]
    flat, plane = slopes.reshape(-1), slopes.shape[2] * wide
    other = slopes.shape[1] * plane
    lit = np.empty(columns + 1, np.int64)
    for y in range(first, last):
        for v in range(views_v):
            for u in range(views_u):
                down, right = np.float32(views_v // 2 - v), np.float32(views_u // 2 - u)
                if down == 0 and right == 0:
                    continue
                # Listed first: no processor predicts which rays are dark.
                count = 0
                for x in range(columns):
                    seen = False
                    for s in range(shots):
                        for k in range(stored):
                            seen |= weights[s, v, u, y, k, x] != 0
                    lit[count] = x
                    count += 1 if seen & (hidden[v, u, y, x] == 0) else 0
                for n in range(count):
                    x = lit[n]
                    d = disparity[v, u, y, x]
                    iy, fy = _first_tap(np.float32(y) + d * down, margin, last_y)
                    ix, fx = _first_tap(np.float32(x) + d * right, margin, wide - TAPS)
                    for s in range(shots):
                        change = np.float32(0)
                        for k in range(stored):
                            w = weights[s, v, u, y, k, x]
                            c = colour[s, y, x] if stored == 1 else k
                            at = c * plane + iy * wide + ix
                            steep = down * read_taps(flat, at, wide, fy, fx)
                            steep += right * read_taps(flat, at + other, wide, fy, fx)
                            change += w * steep
                        out[s, v, u, y, 0, x] = change


class Surfaces:
    """Psi of textures on surfaces: forward and adjoint between textures and frames.

    disparity: (v, u, y, x) of every ray, hidden: (v, u, y, x) uint8, 1 where the ray sees what the
    centre view does not: there it sees the texture beside it. Textures have the shape
    `texture_shape`, (c, y, x), padded by `margin` samples on all sides; colours: of them, 1 for a
    Psi that sees only the first. alike, moved: see `laid_out`; neither `derivative` nor
    `light_field` is of moved rays.
    """

    _whole: Layout | None

    def __init__(
        self,
        psi: Psi,
        disparity: Array,
        hidden: NDArray[np.uint8],
        margin: int,
        colours: int = 3,
        alike: Layout | None = None,
        moved: Array | None = None,
    ) -> None:
        self.psi, self.disparity, self.hidden, self.margin = psi, disparity, hidden, margin
        rows, columns = psi.size
        self.texture_shape = (colours, rows + 2 * margin, columns + 2 * margin)
        self._alike, self._moved, self._whole = alike, moved, None

    def release(self) -> None:
        """Give back the memory of the rays' layout; a later product lays them out again."""
        self._whole = None

    def _bands(self) -> Iterable[Layout]:
        """Return the layouts of bands of rows; one of all rows is kept."""
        if self._whole is None:
            bands = laid_out(
                self.psi, self.disparity, self.margin, self.texture_shape, self._alike, self._moved
            )
            first = next(bands)
            if len(first.rows) < self.psi.frames_shape[1]:
                return chain([first], bands)
            self._whole = first
        return [self._whole]

    def forward(self, texture: Array) -> Array:
        """Return the frames (shot, pixel_y, pixel_x) of a texture (c, y, x)."""
        frames = np.empty(self.psi.frames_shape, dtype=np.float32)
        for band in self._bands():
            band.read(texture, frames)
        return frames

    def adjoint(self, frames: Array) -> Array:
        """Return the adjoint of `forward`, (c, y, x)."""
        nothing = np.zeros(self.texture_shape, dtype=np.float32)
        return self.missed(nothing, frames, np.ones_like(frames, dtype=np.float32))

    def missed(self, texture: Array, frames: Array, precision: Array) -> Array:
        """Return the adjoint of precision * (frames - forward(texture)), see `add_missed`."""
        sums = np.zeros((2, *self.texture_shape), dtype=np.float32)
        self.add_missed(texture, frames, precision, sums)
        sums[0] += sums[1]
        return sums[0]

    def add_missed(self, texture: Array, frames: Array, precision: Array, sums: Array) -> None:
        """Add the adjoint of precision * (frames - forward(texture)) to the sum of sums[0, 1].

        texture: (c, y, x). frames, precision: (shot, pixel_y, pixel_x). sums: (2, c, y, x).
        """
        texture, frames, precision = (
            np.ascontiguousarray(given, dtype=np.float32) for given in (texture, frames, precision)
        )
        for band in self._bands():
            band.add_missed(texture, frames, precision, sums.reshape(2, -1))

    def derivative(self, slopes: Array) -> Surfaces:
        """Return how frames change with the centre view's disparity (1, y, x), padded.

        slopes: (2, c, y, x), derivatives of the centre view's texture along y and x. What is hidden
        keeps its disparity.
        """
        psi = self.psi
        slopes = np.ascontiguousarray(slopes, dtype=np.float32)
        steep = np.zeros((*psi.weights.shape[:4], 1, psi.size[1]), dtype=np.float32)

        def work(_: int, first: int, last: int) -> None:
            seen = psi.weights, psi.colour_map, self.disparity, self.hidden
            _steepen(*seen, slopes, self.margin, first, last, steep)

        in_bands(work, psi.size[0])
        colours = np.zeros((psi.shots, *psi.size), np.uint8)
        steep_psi = Psi(steep, colours, psi.binning)
        alike = self._whole if psi.weights.shape[4] == 1 else None
        return Surfaces(steep_psi, self.disparity, self.hidden, self.margin, 1, alike)

    def light_field(self, texture: Array) -> Array:
        """Return the light field (v, u, y, x, c) of a texture (c, y, x)."""
        out = np.empty((*self.disparity.shape, texture.shape[0]), dtype=np.float32)
        texture = np.ascontiguousarray(texture, dtype=np.float32)

        def work(_: int, first: int, last: int) -> None:
            _render(self.disparity, texture, self.margin, first, last, out)

        in_bands(work, self.psi.size[0])
        return out

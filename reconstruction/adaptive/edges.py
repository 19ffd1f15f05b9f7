"""Edges that views do not reach: outermost rows and columns, black or nearly so.

Light fields that were rectified often end so. The edge does not move with the surfaces beside it,
and spoils their fit: that of begonia (434x625, one shot) by 3 dB over the whole. Its readings show
it: in every line of it they are darker than those of the next lines within, and at its inner end
more suddenly so than brightness changes within. How much of the scene its pixels show is then read
from the frames, given the scene.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.settings import SIDES, Side

Array = NDArray[np.floating]
WIDEST = 5
"""Pixels that an edge may be wide. 2x 0.00, 0.5x 0.00 dB."""
BESIDE = 4
"""Pixels within to which a line's readings are compared. 2x 0.00, 0.5x 0.00 dB."""
ALONG_PX = 6.0
"""Deviation of the blur along an edge. 2x 0.00, 0.5x 0.00 dB."""
DARKER = 0.15
"""Share by which every line of an edge is darker than what is within, and the next line by less
than half of it: 0.22 to 1, and 0.05 at most, on four real light fields. 2x 0.00, 0.5x +1.03 dB."""
ALL_ALONG = 0.9
"""Share of its length over which a line of an edge is darker by half of DARKER: on corners of four
real light fields all of it; of a dark object that ends beside the picture's edge (dragons) 0.73."""
SUDDEN = 3.0
"""Times more that brightness changes, in squares, at the edge than at the next lines within: at
least 3.5 on those four. 2x 0.00, 0.5x 0.00 dB."""
TINY = 1e-20


@dataclass(frozen=True, eq=False)
class DarkEdges:
    """widths: in pixels, of the SIDES. within: (pixel_y, pixel_x)."""

    widths: tuple[int, int, int, int]
    within: NDArray[np.bool_]


def _blurred(line: Array) -> Array:
    """Return the values along an edge, (along, any), blurred."""
    size = 2 * int(np.ceil(3 * ALONG_PX)) + 1
    wide = np.ascontiguousarray(line.reshape(len(line), -1), dtype=np.float32)
    out = cv2.GaussianBlur(wide, (1, size), 1e-6, sigmaY=ALONG_PX)
    return np.asarray(out, dtype=np.float32).reshape(line.shape)


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines of pixels parallel to an edge, outermost first.

    seen: flat Psi, (line, shot, along, c), readings: (line, shot, along).
    """

    seen: Array
    readings: Array

    def colours(self, lines: slice) -> Array:
        """Return the colours (along, c) that these lines share, blurred along the edge."""
        seen, readings = self.seen[lines], self.readings[lines]
        total = seen.sum(axis=-1)
        above, below = (
            _blurred(np.einsum("lsac,lsa->ac", seen, part)) for part in (readings, total)
        )
        floor = 1e-3 * max(float(below.mean()), TINY)
        return np.maximum(above, 0) / np.maximum(below, floor)

    def change(self, line: int) -> tuple[float, float, float]:
        """Return by how much a line is brighter than those within: its mean, and mean square.

        As a share of their brightness. Last, over which share of its length it is darker.
        """
        beside = self.colours(slice(line + 1, line + 1 + BESIDE))
        seen = self.seen[line]
        missed = self.readings[line] - np.einsum("sac,ac->sa", seen, beside)
        light = seen.sum(axis=-1)
        above, below = (_blurred((light * part).sum(axis=0)) for part in (missed, light))
        relative = above / np.maximum(below, TINY)
        brightness = beside.mean(axis=-1)
        return (
            float(relative.mean() / max(brightness.mean(), TINY)),
            float(np.square(relative).mean() / max(np.square(brightness).mean(), TINY)),
            float((relative < -DARKER / 2 * brightness).mean()),
        )


def _lines(psi: ImagingMatrix, frames: Array, usable: NDArray[np.bool_], side: Side) -> _Lines:
    """Return the lines at a side that are looked at."""
    (axis, far), k = divmod(SIDES.index(side), 2), psi.binning
    pixels = [slice(0, length) for length in frames.shape[1:]]
    length, looked = frames.shape[1 + axis], WIDEST + 1 + BESIDE
    pixels[axis] = slice(length - looked, length) if far else slice(0, looked)
    rows, columns = pixels
    part = psi.window(*(slice(one.start * k, one.stop * k) for one in pixels))
    used = usable[:, rows, columns]
    seen = part.picture_weights.reshape(*used.shape[:2], k, used.shape[2], k, -1).sum(axis=(2, 4))
    kept = np.where(used, frames[:, rows, columns], 0)
    seen = np.where(used[..., None], seen, 0)
    if axis:
        seen, kept = seen.swapaxes(1, 2), kept.swapaxes(1, 2)
    if far:
        seen, kept = seen[:, ::-1], kept[:, ::-1]
    return _Lines(seen.swapaxes(0, 1), kept.swapaxes(0, 1))


def _width(lines: _Lines) -> int:
    """Return how many lines are an edge."""
    mean, square, darker = zip(*(lines.change(line) for line in range(WIDEST + 1)), strict=True)
    width = 0
    for last in range(WIDEST):
        if mean[last] >= -DARKER or darker[last] < ALL_ALONG:
            break
        ends = mean[last + 1] > -DARKER / 2
        if ends and square[last] > SUDDEN * max(square[last + 1 :]):
            width = last + 1
    return width


def dark_edges(
    psi: ImagingMatrix,
    frames: Array,
    usable: NDArray[np.bool_],
    sides: Collection[Side] = SIDES,
) -> DarkEdges | None:
    """Return the edges of the frames (shot, pixel_y, pixel_x) that are no part of the scene.

    None if all are, and for frames too small to tell. sides: those that may have one.
    """
    rows, columns = frames.shape[1:]
    if min(rows, columns) < 4 * (WIDEST + 1 + BESIDE):
        return None
    top, bottom, left, right = (
        _width(_lines(psi, frames, usable, side)) if side in sides else 0 for side in SIDES
    )
    within = np.ones((rows, columns), dtype=bool)
    within[top : rows - bottom, left : columns - right] = False
    return DarkEdges((top, bottom, left, right), within) if within.any() else None


def faded(
    edges: DarkEdges,
    psi: ImagingMatrix,
    light_field: Array,
    frames: Array,
    usable: NDArray[np.bool_],
) -> Array:
    """Return a light field (v, u, y, x, c) with its edges as dark as the frames say.

    light_field: of the scene, continued to the edges. Each pixel there shows a share of it, 0 to 1,
    the same in all views: the one that explains its usable readings best.
    """
    seen = np.where(usable & edges.within, psi.forward(light_field), 0)
    shown = (seen * frames).sum(axis=0) / np.maximum(np.square(seen).sum(axis=0), TINY)
    share = np.where(edges.within & seen.any(axis=0), np.clip(shown, 0, 1), 1)
    k = psi.binning
    samples = share.repeat(k, axis=0).repeat(k, axis=1).astype(np.float32)
    return light_field * samples[..., None]

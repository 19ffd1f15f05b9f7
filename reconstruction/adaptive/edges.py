"""Edges that views do not reach: outermost rows and columns, black or nearly so.

Light fields that were rectified often end so. The edge does not move with the surfaces beside it,
and spoils their fit: that of begonia (434x625, one shot) by 3 dB over the whole. Readings of every
line of an edge are darker than those of the next lines within. Which share of the scene the pixels
of an edge show is then estimated from the frames, given the scene.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.reconstruction.adaptive.settings import SIDES, Side

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


def _colours(seen: Array, readings: Array) -> Array:
    """Return the colours (along, c) of lines, as if all had the same, blurred along the edge.

    seen: flat Psi, (line, shot, along, c). readings: (line, shot, along).
    """
    above, below = (
        _blurred(np.einsum("lsac,lsa->ac", seen, part)) for part in (readings, seen.sum(axis=-1))
    )
    floor = 1e-3 * max(float(below.mean()), TINY)
    return np.maximum(above, 0) / np.maximum(below, floor)


def _width(seen: Array, readings: Array) -> int:
    """Return how many lines are an edge; seen, readings: see `_colours`, the outermost first.

    A line's brightness is compared with that of BESIDE lines within: r, the change relative to it,
    in the mean along the line, and the share of the line where r < -DARKER / 2.
    """
    change, share = [], []
    for line in range(WIDEST + 1):
        within = slice(line + 1, line + 1 + BESIDE)
        beside = _colours(seen[within], readings[within])
        missed = readings[line] - np.einsum("sac,ac->sa", seen[line], beside)
        light = seen[line].sum(axis=-1)
        above, below = (_blurred((light * part).sum(axis=0)) for part in (missed, light))
        relative, brightness = above / np.maximum(below, TINY), beside.mean(axis=-1)
        change.append(relative.mean() / max(brightness.mean(), TINY))
        share.append((relative < -DARKER / 2 * brightness).mean())
    width = 0
    for last in range(WIDEST):
        if change[last] >= -DARKER or share[last] < ALL_ALONG:
            break
        if change[last + 1] > -DARKER / 2:
            width = last + 1
    return width


def dark_edges(
    psi: ImagingMatrix,
    frames: Array,
    usable: NDArray[np.bool_],
    sides: Collection[Side] = SIDES,
) -> DarkEdges | None:
    """Return the edges of the frames (shot, pixel_y, pixel_x) that are no part of the scene.

    None without any, and for frames too small to tell. sides: those that may have one.
    """
    (shots, rows, columns), k = frames.shape, psi.binning
    looked = WIDEST + 1 + BESIDE
    if min(rows, columns) < 4 * looked:
        return None
    seen = psi.picture_weights.reshape(shots, rows, k, columns, k, -1).sum(axis=(2, 4))
    seen, readings = np.where(usable[..., None], seen, 0), np.where(usable, frames, 0)
    widths = [0] * len(SIDES)
    for number, side in enumerate(SIDES):
        if side in sides:
            axis, far = 1 + number // 2, number % 2
            lines = (np.moveaxis(part, axis, 0) for part in (seen, readings))
            widths[number] = _width(*(part[:: -1 if far else 1][:looked] for part in lines))
    top, bottom, left, right = widths
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

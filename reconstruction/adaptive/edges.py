"""Edges that views do not reach: outermost rows and columns that are black or nearly so.

Light fields that were rectified often end so, most with a single line. The edge does not move with
the surfaces beside it, and spoils their fit: that of begonia (434x625, one shot) by 3 dB over the
whole. An edge is left out of the fit. Afterwards the share of the scene's light that each of its
pixels shows is estimated from the frames, given the fitted scene.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.adaptive.settings import SIDES, Side

Array = NDArray[np.floating]
BESIDE = 4
"""Lines within to which a line is compared: two periods of the colour filters. An edge is at most
as wide."""
ALONG_PX = 6.0
"""Deviation of the blur along a line: it averages noise and colour filters."""
DARKER = 0.3
"""Share by which a line of an edge is darker than the lines within, at nine tenths of its length:
0.39 to 0.94 on corners of four real light fields (begonia, bikes, buttercup, isochart). With 0.2
the built-in scene `dark`, which has no edges, seems to have some in noise."""
ALL_ALONG = 0.9
"""Share of its length over which a line of an edge is darker: 1 on these corners, 0.73 for a dark
object that ends beside the picture's edge (dragons)."""
PART = 0.2
"""If a side has an edge, another side's outermost line is an edge, too, if it is dark over more of
its length than each line within, by this share. For the lowest row of begonia (434x625) the share
is 0.27, and leaving the row out gains 0.2 dB. Without the condition of another edge, 33 of 736
crops of group A seem to have an edge, and the six crops measured lost 0.1 to 5 dB."""
TINY = 1e-20


@dataclass(frozen=True, eq=False)
class DarkEdges:
    """Edges that are no part of the scene.

    Attributes:
        widths: in pixels, of the top, bottom, left and right edge (`SIDES`).
        within: pixels that lie in an edge, (pixel_y, pixel_x).
    """

    widths: tuple[int, int, int, int]
    within: NDArray[np.bool_]


def _blurred(line: Array) -> Array:
    """Return values along a line, (along, any), blurred."""
    size = 2 * int(np.ceil(3 * ALONG_PX)) + 1
    wide = np.ascontiguousarray(line.reshape(len(line), -1), dtype=np.float32)
    out = cv2.GaussianBlur(wide, (1, size), 1e-6, sigmaY=ALONG_PX)
    return np.asarray(out, dtype=np.float32).reshape(line.shape)


def _dark_share(seen: Array, readings: Array) -> float:
    """Return the share of a first line's length where it is darker than the BESIDE lines after it.

    The lines within have the colours B(along, c) = sum(seen * readings) / sum(seen), blurred along
    the line, sums over line and shot. The first line reads seen . B if it is as bright. Where its
    reading, weighted by the received light and blurred, is lower by more than DARKER, it is dark.

    seen: sums of Psi's rows, (line, shot, along, c). readings: (line, shot, along).
    """
    within = slice(1, 1 + BESIDE)
    light, weight = (
        _blurred(np.einsum("lsac,lsa->ac", seen[within], part[within]))
        for part in (readings, seen.sum(axis=-1))
    )
    floor = 1e-3 * max(float(weight.mean()), TINY)
    colours = np.maximum(light, 0) / np.maximum(weight, floor)
    expected = np.einsum("sac,ac->sa", seen[0], colours)
    received = seen[0].sum(axis=-1)
    bright, missed = (
        _blurred((received * part).sum(axis=0)) for part in (expected, expected - readings[0])
    )
    return float((missed > DARKER * bright).mean())


def dark_edges(
    psi: Psi,
    frames: Array,
    usable: NDArray[np.bool_],
    sides: Collection[Side] = SIDES,
) -> DarkEdges | None:
    """Return the edges of the frames (shot, pixel_y, pixel_x) that are no part of the scene.

    None without any, and for frames of fewer than 8 BESIDE rows or columns. usable: readings that
    count, of the frames' shape. sides: of the picture that may have an edge.
    """
    (shots, rows, columns), k = frames.shape, psi.binning
    if min(rows, columns) < 8 * BESIDE:
        return None
    seen = psi.picture_weights.reshape(shots, rows, k, columns, k, -1).sum(axis=(2, 4))
    seen, readings = np.where(usable[..., None], seen, 0), np.where(usable, frames, 0)
    widths = [0] * len(SIDES)

    def dark_share(number: int, line: int) -> float:
        axis, step = 1 + number // 2, -1 if number % 2 else 1
        return _dark_share(*(np.moveaxis(a, axis, 0)[::step][line:] for a in (seen, readings)))

    able = [number for number, side in enumerate(SIDES) if side in sides]
    for number in able:
        while widths[number] < BESIDE and dark_share(number, widths[number]) >= ALL_ALONG:
            widths[number] += 1
    if any(widths):
        # Rectified light fields end so at several sides, at some along a part of their length.
        for number in (number for number in able if not widths[number]):
            first, *within = (dark_share(number, line) for line in range(1 + BESIDE))
            if first - max(within) >= PART:
                widths[number] = 1
    top, bottom, left, right = widths
    within = np.ones((rows, columns), dtype=bool)
    within[top : rows - bottom, left : columns - right] = False
    return DarkEdges((top, bottom, left, right), within) if within.any() else None


def faded(
    edges: DarkEdges,
    psi: Psi,
    light_field: Array,
    frames: Array,
    usable: NDArray[np.bool_],
) -> Array:
    """Return a light field (v, u, y, x, c) with its edges as dark as the frames say.

    A pixel of an edge shows the share a of the scene, the same in all views, that explains its
    usable readings I best in least squares: a = I . F / |F|^2, clipped to [0, 1], with the readings
    F = Psi L of the scene L; sums over shots.

    light_field: of the scene, continued to the edges. frames, usable: (shot, pixel_y, pixel_x).
    """
    foretold = np.where(usable & edges.within, psi.forward(light_field), 0)
    square = np.square(foretold).sum(axis=0)
    shown = np.clip((foretold * frames).sum(axis=0) / np.maximum(square, TINY), 0, 1)
    share = np.where(square > 0, shown, 1)
    k = psi.binning
    samples = share.repeat(k, axis=0).repeat(k, axis=1).astype(np.float32)
    return light_field * samples[..., None]

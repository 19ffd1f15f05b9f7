"""Pictures that a page draws a light field from: all views in one, and the disparity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.live.picture import disparity_png, encoded
from emmc_rig.live.server import Picture, Pictured, Query
from emmc_rig.pages.frame_view import srgb_codes

Array = NDArray[np.floating]
LONGEST_SHEET_PX = 4096
SURE_PX = 0.15
"""Deviation of a disparity, coarse pixels per view step, above which it is not shown."""
WINDOW_PX = 7


@dataclass(frozen=True, eq=False)
class Pictures:
    """All views side by side, and the centre view's disparity.

    sheet: (V y, U x, BGR). disparity: (y, x) in pixels of the sheet per view step, NaN where the
    views do not tell.
    """

    number: int
    views: tuple[int, int]
    sheet: NDArray[np.uint8]
    disparity: NDArray[np.float32]

    def facts(self) -> dict[str, Any]:
        """Return what the page's script needs to draw them, plain data."""
        known = self.disparity[np.isfinite(self.disparity)]
        rows, columns = self.sheet.shape[:2]
        return {
            "number": self.number,
            "views": list(self.views),
            "size": [rows // self.views[0], columns // self.views[1]],
            "disparities": [float(d) for d in np.percentile(known, (5, 95))]
            if known.size
            else None,
        }


def drawn(light_field: Array, disparity: Array | None, number: int) -> Pictures:
    """Return pictures of a light field (v, u, y, x, c); disparity: (y, x), None: estimated."""
    views_v, views_u, high, wide, _ = light_field.shape
    shrink = max(1, int(np.ceil(max(views_v * high, views_u * wide) / LONGEST_SHEET_PX)))
    size = wide // shrink, high // shrink
    tiles = [[_fitted(light_field[v, u], size) for u in range(views_u)] for v in range(views_v)]
    linear = np.concatenate([np.concatenate(row, axis=1) for row in tiles], axis=0)
    if disparity is None:
        found = disparity_of(np.stack([np.stack(row) for row in tiles]))
    else:
        found = _fitted(np.asarray(disparity), size) / np.float32(shrink)
    sheet = np.ascontiguousarray(srgb_codes(linear)[..., ::-1])
    return Pictures(number, (views_v, views_u), sheet, found)


def field_pictures(
    newest: Callable[[], Pictures | None],
) -> dict[str, Pictured]:
    """Return what a `emmc_rig.live.server.Page` serves of a light field."""

    def views(query: Query) -> Picture | None:
        shown = newest()
        return shown and Picture("views", shown.number, lambda: encoded(shown.sheet))

    def disparity(query: Query) -> Picture | None:
        shown = newest()
        return shown and Picture(
            "disparity", shown.number, lambda: disparity_png(shown.disparity), "image/png"
        )

    return {"views.jpg": views, "disparity.png": disparity}


def _fitted(view: Array, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return a picture (y, x[, c]) at size (x, y)."""
    if view.shape[1::-1] == size:
        return np.asarray(view, np.float32)
    whole = np.ascontiguousarray(view, np.float32)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.float32)


def disparity_of(light_field: Array) -> NDArray[np.float32]:
    """Return the disparity of small views, (y, x), pixels per view step; NaN where not decided.

    light_field: (v, u, y, x, c). Where views are shifted by less than a pixel, brightness stays
    along lines of slope d: L_u = -d L_x and L_v = -d L_y, solved by least squares over a window
    and all views (Bolles, Baker and Marimont 1987; as Lucas and Kanade 1981 for flow).
    """
    grey = light_field @ np.full(light_field.shape[-1], 1 / light_field.shape[-1], np.float32)
    by_v, by_u, by_y, by_x = (
        np.gradient(grey, axis=axis) if grey.shape[axis] > 1 else np.zeros_like(grey)
        for axis in range(4)
    )

    def gathered(*products: tuple[Array, Array]) -> Array:
        summed = sum(np.einsum("vuyx,vuyx->yx", one, other) for one, other in products)
        return cv2.blur(np.asarray(summed), (WINDOW_PX, WINDOW_PX))

    power = gathered((by_x, by_x), (by_y, by_y))
    product = gathered((by_u, by_x), (by_v, by_y))
    change = gathered((by_u, by_u), (by_v, by_v))
    safe = np.maximum(power, 1e-12)
    found = -product / safe
    left = np.maximum(change - product**2 / safe, 0)
    # Views that differ by interpolation are no independent witnesses: one window of pixels counts.
    deviation = np.sqrt(left / safe / WINDOW_PX)
    sure = (deviation < SURE_PX) & (power > 1e-4 * float(power.max() + 1e-12))
    return np.where(sure, found, np.nan).astype(np.float32)

"""What a page turns a light field by: views, disparities and maps, as `viewer.js` reads them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.formats import Export
from emmc_rig.live.server import Picture, Pictured, Query
from emmc_rig.pages.display import PART_PIXELS
from emmc_rig.pages.viewer import viewer_data

Array = NDArray[np.floating]
SURE_PX = 0.15
"""Deviation of a disparity, coarse pixels per view step, above which it is not shown."""
WINDOW_PX = 7


@dataclass(frozen=True, eq=False)
class Pictures:
    """A light field and its maps; each has another number.

    block: how many of the camera's samples, along each axis, one of the light field is.
    """

    number: int
    export: Export
    block: int = 1

    def facts(self) -> dict[str, Any]:
        """Return what the page needs before it asks for them, as plain data."""
        return {"number": self.number, "views": list(self.export.light_field.shape[:2])}

    def encoded(self) -> bytes:
        """Return what the viewer reads, JSON."""
        data = viewer_data(self.export, most_pixels=PART_PIXELS)
        data["scale"] = float(str(data["scale"])) / self.block
        return json.dumps(data, allow_nan=False, separators=(",", ":")).encode()


def export_of(
    light_field: Array, maps: Mapping[str, NDArray], misfit: Array | None = None
) -> Export:
    """Return a light field with those of a method's maps that the viewer shows."""
    disparity, sigma = (maps.get(name) for name in ("disparity", "sigma"))
    return Export("", "", light_field, None, disparity, sigma, misfit)


def field_pictures(
    newest: Callable[[], Pictures | None],
) -> dict[str, Pictured]:
    """Return what a `emmc_rig.live.server.Page` serves of a light field."""

    def light_field(query: Query) -> Picture | None:
        shown = newest()
        return shown and Picture("light field", shown.number, shown.encoded, "application/json")

    return {"light-field.json": light_field}


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
        return np.asarray(cv2.blur(np.asarray(summed), (WINDOW_PX, WINDOW_PX)), np.float32)

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

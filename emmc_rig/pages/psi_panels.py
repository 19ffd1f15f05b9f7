"""Slices of Psi, and of its standard deviation, as figures of a page."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from emmc_rig.pages.display import DisplayCurve, finite, heat, montage, png_of, round_up
from emmc_rig.pages.page import fragment

Array = NDArray[np.floating]
OfView = Callable[[int, int], Array]
DETAIL_PX = 40
"""Side of the piece of a slice that is shown pixel for pixel."""
THUMBNAIL_PX = 120
"""Side of a whole slice."""


def psi_panels(views: tuple[int, int], psi: OfView, deviation: OfView | None) -> Markup:
    """Return the figures of one shot; psi, deviation: return a view's (y, x), of (v, u).

    One view is in memory at a time.
    """
    rows, columns = views
    thumbnails, piece = (_of_every_view(views, psi, change) for change in (_thumbnail, _centre))
    layout = f"rows are v 0 to {rows - 1} downwards, columns u 0 to {columns - 1}"
    side = f"{piece.shape[3]} × {piece.shape[2]}"
    panels = [
        _panel("Whole field", f"one tile per view, averaged down; {layout}", thumbnails, 3),
        _panel(
            "Centre, pixel for pixel", f"the middle {side} pixels of each view's weights", piece, 2
        ),
    ]
    if deviation is not None:
        middle, centre = (_of_every_view(views, deviation, change) for change in (_median, _centre))
        note = f"same pixels; of the views' medians the median is {np.median(middle):.2g}"
        panels.append(_panel("Its standard deviation", note, centre, 2, "heat"))
    return fragment("psi.html", panels=panels)


def _of_every_view(
    views: tuple[int, int], of_view: OfView, change: Callable[[Array], Array]
) -> Array:
    """Return what becomes of each view, (v, u, ...)."""
    found = np.array([change(finite(of_view(v, u))) for v, u in np.ndindex(views)], np.float32)
    return found.reshape(*views, *found.shape[1:])


def _panel(
    name: str, note: str, slices: Array, gap_px: int, ramp: str = "grey"
) -> dict[str, object]:
    """Return a figure of slices (v, u, y, x) side by side; ramp: its scale of colours."""
    scale = round_up(float(np.percentile(slices, 99.9)))
    codes = DisplayCurve(1 / scale, 1.0).encode(slices)
    picture = png_of(montage(heat(codes) if ramp == "heat" else codes, gap_px))
    return {"name": name, "note": note, "picture": picture, "scale": scale, "ramp": ramp}


def _centre(view: Array) -> Array:
    height, width = view.shape
    top, left = max((height - DETAIL_PX) // 2, 0), max((width - DETAIL_PX) // 2, 0)
    return view[top : top + DETAIL_PX, left : left + DETAIL_PX]


def _median(view: Array) -> Array:
    return np.asarray(np.median(view))


def _thumbnail(view: Array) -> Array:
    height, width = view.shape
    shrink = min(1.0, THUMBNAIL_PX / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    return np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.float32)

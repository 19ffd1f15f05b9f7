"""Slices of Psi, and of its standard deviation, as figures of a page."""

from __future__ import annotations

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from emmc_rig.pages.display import DisplayCurve, finite, heat, montage, png_of, round_up
from emmc_rig.pages.page import fragment

Array = NDArray[np.floating]
DETAIL_PX = 40
"""Side of the piece of a slice that is shown pixel for pixel."""
THUMBNAIL_PX = 120
"""Side of a whole slice."""


def psi_panels(psi: Array, psi_std: Array | None) -> Markup:
    """Return the figures; both arrays are (v, u, y, x), the weights of one shot."""
    rows, columns = psi.shape[:2]
    piece = finite(_centre(psi))
    layout = f"rows are v 0 to {rows - 1} downwards, columns u 0 to {columns - 1}"
    side = f"{piece.shape[3]} × {piece.shape[2]}"
    panels = [
        _panel("Whole field", f"one tile per view, averaged down; {layout}", _thumbnails(psi), 3),
        _panel(
            "Centre, pixel for pixel", f"the middle {side} pixels of each view's weights", piece, 2
        ),
    ]
    if psi_std is not None:
        typical = float(np.median(finite(psi_std)))
        note = f"same pixels; median over all coefficients {typical:.2g}"
        panels.append(_panel("Its standard deviation", note, finite(_centre(psi_std)), 2, "heat"))
    return fragment("psi.html", panels=panels)


def _panel(
    name: str, note: str, slices: Array, gap_px: int, ramp: str = "grey"
) -> dict[str, object]:
    """Return a figure of slices (v, u, y, x) side by side; ramp: its scale of colours."""
    scale = round_up(float(np.percentile(slices, 99.9)))
    codes = DisplayCurve(1 / scale, 1.0).encode(slices)
    picture = png_of(montage(heat(codes) if ramp == "heat" else codes, gap_px))
    return {"name": name, "note": note, "picture": picture, "scale": scale, "ramp": ramp}


def _centre(slices: Array) -> Array:
    height, width = slices.shape[2:]
    top, left = max((height - DETAIL_PX) // 2, 0), max((width - DETAIL_PX) // 2, 0)
    return slices[:, :, top : top + DETAIL_PX, left : left + DETAIL_PX]


def _thumbnails(slices: Array) -> Array:
    rows, columns, height, width = slices.shape
    shrink = min(1.0, THUMBNAIL_PX / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    small = [
        cv2.resize(finite(one), size, interpolation=cv2.INTER_AREA)
        for one in slices.reshape(-1, height, width)
    ]
    return np.asarray(small, np.float32).reshape(rows, columns, size[1], size[0])

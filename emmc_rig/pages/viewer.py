"""A light field to turn, focus and look into: one HTML page, or a part of one; loads nothing.

    views and truth   JPEG atlases of all views, as screen codes
    disparity         one PNG atlas of what every view sees, 256 levels
    overlays          one PNG each, of the centre view: disparity, deviation, residual

`viewer.js` draws with WebGL2, by the formulas of `emmc_rig.model.novel_view`; without it, the
views themselves by canvas. A pixel between four views takes 12 texture reads where disparity is
even, 36 at outlines, a fourth of it at a view, and one per view that an open aperture takes in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.formats import Export, Format
from emmc_rig.model.files import write_text
from emmc_rig.model.novel_view import centre_disparity, view_disparities
from emmc_rig.model.view_axes import axis_names, place_name, shows_parallax
from emmc_rig.pages.display import (
    HEAT,
    SPRITE_PIXELS,
    TILE_MULTIPLE_PX,
    DisplayCurve,
    ends,
    finite,
    png_of,
    reduced,
    round_up,
    sprite,
    three_colours,
    tiled,
)
from emmc_rig.pages.page import estimated, fragment, light_field_head

Array = NDArray[np.floating]
BYTES_PER_PIXEL = 0.36
"""Of the atlases: 25 views of 376x541, the truth and the maps stay below 6 MB."""
DEPTH = (
    (48, 18, 59),
    (50, 108, 222),
    (38, 188, 190),
    (140, 216, 84),
    (252, 194, 52),
    (196, 40, 28),
)
"""Colours of disparity, far to near."""


@dataclass(frozen=True)
class Overlay:
    """One map (y, x) of the centre view, as the viewer lays it over the picture.

    label, unit: for people. low, high: values at the first and the last colour.
    """

    key: str
    label: str
    unit: str
    values: NDArray
    low: float
    high: float
    colours: Sequence[tuple[int, int, int]] = HEAT


def render_viewer(content: Export, lossless: bool = False) -> str:
    """Return the page as text; lossless: pictures as PNG, for comparisons to the last code."""
    return fragment(
        "viewer_page.html",
        title=content.title,
        about=[*([content.caption] if content.caption else []), *estimated(content.metrics)],
        caveats=(), sections=(), lead="",
        summary=light_field_head(content.metrics, content.source, viewer=True),
        styles=("viewer.css",), scripts=("viewer.js",),
        data={"viewer-data": viewer_data(content, lossless=lossless)}, poster=poster(content),
    )  # fmt: skip


def poster(content: Export, most_pixels: int = SPRITE_PIXELS) -> dict[str, object]:
    """Return the centre view, shown until the light field can be turned, and the canvas's size.

    most_pixels: of all views together.
    """
    views, (rows, columns) = content.light_field, content.light_field.shape[:2]
    centre = views[rows // 2, columns // 2][None, None]
    shown = reduced(centre, most_pixels // (rows * columns))
    curve = DisplayCurve.fitted_to(views if content.truth is None else content.truth)
    codes = three_colours(curve.encode(shown))
    picture = sprite(codes, int(BYTES_PER_PIXEL * codes.size / 3), tile=1)
    name = "centre view"
    if not shows_parallax(content.view_axes):
        name = place_name(content.view_axes, (rows, columns), (rows // 2, columns // 2))
    return {
        "picture": picture, "height": shown.shape[2], "width": shown.shape[3],
        "name": name[0].upper() + name[1:],
    }  # fmt: skip


def viewer_data(
    content: Export, lossless: bool = False, most_pixels: int = SPRITE_PIXELS
) -> dict[str, object]:
    """Return what viewer.js reads.

    Disparity is estimated where the light field comes without; bands and times have none.
    most_pixels: of all views.
    """
    shown = reduced(content.light_field, most_pixels)
    rows, columns, height, width, _ = shown.shape
    shrink = width / content.light_field.shape[3]
    truth = content.truth
    curve = DisplayCurve.fitted_to(content.light_field if truth is None else truth)
    parallax = shows_parallax(content.view_axes)
    if parallax:
        centre = _resized(centre_disparity(content.light_field, content.disparity), shown)
    else:
        centre = np.zeros((height, width), np.float32)
    centre = centre * np.float32(shrink)
    maps = view_disparities(centre, (rows, columns))
    low, high = float(maps.min()), float(maps.max())
    span = max(high - low, 1e-3)
    codes = np.rint((maps - low) * (255 / span)).astype(np.uint8)
    back, middle, front = (
        float(d) * shrink for d in (np.percentile(centre, (2, 50, 98)) / shrink).tolist()
    )
    return {
        "views": {"rows": rows, "columns": columns, "height": height, "width": width},
        "axes": None if parallax else axis_names(content.view_axes, (rows, columns)),
        "scale": shrink,
        "tile": TILE_MULTIPLE_PX,
        "gamma": curve.gamma,
        "estimate": _atlas(curve, shown, lossless),
        "truth": None if truth is None else _atlas(curve, reduced(truth, most_pixels), lossless),
        "disparity": {"atlas": _grey_atlas(codes), "low": low, "high": low + span},
        "focus": {"low": back - 0.25 * span, "high": front + 0.25 * span, "at": middle},
        "overlays": [_overlay(one, shown) for one in overlays_of(content)],
    }


def overlays_of(content: Export) -> list[Overlay]:
    """Return the maps that there are, ready to be drawn."""
    found = []
    rows, columns = content.light_field.shape[:2]
    if content.disparity is not None and shows_parallax(content.view_axes):
        low, high = ends([content.disparity])
        found.append(
            Overlay("disparity", "disparity", "px per view", content.disparity, low, high, DEPTH)
        )
    if content.sigma is not None:
        values = content.sigma[rows // 2, columns // 2]
        high = round_up(ends([values])[1])
        found.append(Overlay("sigma", "standard deviation", "", values, 0, high))
    if content.misfit is not None:
        found.append(Overlay("doubt", "unexplained residual", "x noise", content.misfit, 1.0, 5.0))
    return found


def _resized(values: NDArray, shown: Array) -> NDArray:
    height, width = shown.shape[2:4]
    return cv2.resize(
        finite(np.asarray(values, np.float32)), (width, height), interpolation=cv2.INTER_NEAREST
    )


def _overlay(one: Overlay, shown: Array) -> dict[str, object]:
    levels = np.clip((_resized(one.values, shown) - one.low) / (one.high - one.low), 0, 1)
    picture = np.rint(levels * 255).astype(np.uint8)
    if np.isnan(one.values).any():  # clear where nothing is known
        known = _resized(~np.isnan(one.values), shown)
        picture = np.dstack([picture, picture, picture, np.rint(known * 255).astype(np.uint8)])
    return {
        "key": one.key, "label": one.label, "unit": one.unit, "low": one.low, "high": one.high,
        "colours": one.colours, "picture": png_of(picture),
    }  # fmt: skip


def _atlas(curve: DisplayCurve, views: Array, lossless: bool) -> str:
    codes = three_colours(curve.encode(views))
    return (
        png_of(np.ascontiguousarray(tiled(codes)[..., ::-1]))
        if lossless
        else sprite(codes, int(BYTES_PER_PIXEL * codes.size / 3))
    )


def _grey_atlas(codes: NDArray[np.uint8]) -> str:
    return png_of(tiled(codes[..., None])[..., 0])


def _write(folder: Path, export: Export) -> None:
    write_text(folder / "viewer.html", render_viewer(export))


VIEWER = Format(
    "viewer", "viewer.html, one page to turn, focus and look into", "8-bit pictures, maps", _write
)

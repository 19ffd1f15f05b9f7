"""A light field to turn, focus and look into: one HTML page, or a part of one; loads nothing.

    views and truth   JPEG atlases of all views, as screen codes
    disparity         one PNG atlas of what every view sees, 256 levels
    overlays          one PNG each, of the centre view: disparity, deviation, residual; and the
                      centre view of all views together, all in focus

`viewer.js` draws with WebGL2, by the formulas of `emmc_rig.model.novel_view`; without it, the
views themselves by canvas. A pixel between four views takes 12 texture reads where disparity is
even, 36 at outlines, a fourth of it at a view, and one per view that an open aperture takes in.

Of a film the page has every frame's light field, in fewer pixels where it is long, and all centre
views in one atlas: `film.js` draws a row of them over time. Pictures are WebP, which takes a sixth
to a third less than JPEG there. A video of the atlases (VP9) has 2 dB more for the same bytes, but
browsers reach a frame of it only by those before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import ceil, sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.formats.format import Export, Film, Format
from emmc_rig.model.errors import CameraError
from emmc_rig.model.files import write_text
from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.novel_view import all_in_focus, centre_disparity, view_disparities
from emmc_rig.model.optics import optics_of
from emmc_rig.model.view_axes import axis_names, grid_name, place_name, shows_parallax
from emmc_rig.report.display import (
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
    webp_of,
    webp_quality,
)
from emmc_rig.report.page import VERDICTS, Head, estimated, fragment, framed, light_field_head

Array = NDArray[np.floating]
BYTES_PER_PIXEL = 0.36
"""Of the atlases: 25 views of 376x541, the truth and the maps stay below 6 MB."""
FILM_BYTES = 18_000_000
"""Of all light fields of a film; with centre views and in base64 the page stays about 30 MB."""
FILM_BYTES_PER_PIXEL = 0.15
"""Of their atlases: longer films have fewer pixels. By half as many bytes a pixel 200 frames of
192x256 are a third too large at WebP's coarsest quality; twice as many lose 0.3 to 1.1 dB."""
MAP_QUALITY, MAP_BYTES_PER_PIXEL = 40, 0.025
"""Of WebP, for maps of a film: disparity to 0.03 px, in a fifth of PNG's bytes or less."""
BYTES_PER_ROW_PIXEL = 0.2
"""Of the atlas of centre views, a row of which is drawn over time."""
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


def render_viewer(content: Export) -> str:
    """Return the page as text."""
    return framed(
        content.title,
        [*([content.caption] if content.caption else []), *estimated(content.metrics)],
        head=light_field_head(content.metrics, content.source, viewer=True),
        lead=fragment("viewer.html", poster=poster(content)),
        kind="viewer-page", styles=("viewer.css",), scripts=("viewer.js",),
        data={"viewer-data": viewer_data(content)},
    )  # fmt: skip


def poster(
    content: Export, most_pixels: int = SPRITE_PIXELS, like: Export | None = None
) -> dict[str, object]:
    """Return the centre view, shown until the light field can be turned, and the canvas's size.

    most_pixels: of all views together. like: whose brightness is taken, of a film.
    """
    views, (rows, columns) = content.light_field, content.light_field.shape[:2]
    centre = views[rows // 2, columns // 2][None, None]
    shown = reduced(centre, most_pixels // (rows * columns))
    codes = three_colours(curve_of(like or content).encode(shown))
    picture = sprite(codes, int(BYTES_PER_PIXEL * codes.size / 3), tile=1)
    name = "centre view"
    if not shows_parallax(content.view_axes):
        name = place_name(content.view_axes, (rows, columns), (rows // 2, columns // 2))
    return {
        "picture": picture, "height": shown.shape[2], "width": shown.shape[3],
        "name": name[0].upper() + name[1:],
    }  # fmt: skip


def viewer_data(
    content: Export,
    most_pixels: int = SPRITE_PIXELS,
    like: Export | None = None,
    webp: int | None = None,
) -> dict[str, Any]:
    """Return what viewer.js reads.

    Disparity is estimated where the light field comes without; bands and times have none.
    most_pixels: of all views. like: whose brightness and scales of colour are taken, of a film.
    webp: quality of pictures, where they are to be small.
    """
    shown = reduced(content.light_field, most_pixels)
    rows, columns, height, width, _ = shown.shape
    shrink = width / content.light_field.shape[3]
    truth = content.truth
    curve = curve_of(like or content)
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
    map_of = png_of if webp is None else lambda picture: webp_of(picture, MAP_QUALITY)
    overlays = [_overlay(overlay, shown, map_of) for overlay in overlays_of(content, like)]

    def atlas(views: Array, tile: int = TILE_MULTIPLE_PX) -> str:
        picture = three_colours(curve.encode(views))
        if webp is None:
            return sprite(picture, int(BYTES_PER_PIXEL * picture.size / 3), tile)
        return webp_of(np.ascontiguousarray(tiled(picture, tile)[..., ::-1]), webp)

    if parallax:
        sharp = all_in_focus(shown, centre)[None, None]
        overlays.append({"key": "sharp", "label": "all in focus", "picture": atlas(sharp, tile=1)})

    return {
        "views": {"rows": rows, "columns": columns, "height": height, "width": width},
        "axes": None if parallax else axis_names(content.view_axes, (rows, columns)),
        "scale": shrink,
        "tile": TILE_MULTIPLE_PX,
        "gamma": curve.gamma,
        "estimate": atlas(shown),
        "truth": None if truth is None else atlas(reduced(truth, most_pixels)),
        "disparity": {
            "atlas": map_of(tiled(codes[..., None])[..., 0]), "low": low, "high": low + span,
        },
        "focus": {"low": back - 0.25 * span, "high": front + 0.25 * span, "at": middle},
        "overlays": overlays,
        **_optics(content),
    }  # fmt: skip


def _optics(content: Export) -> dict[str, object]:
    """Return the optics that turn disparity into depth, or in words what is missing for that."""
    missing = ""
    if shows_parallax(content.view_axes):
        try:
            return {"optics": asdict(optics_of(content.camera, None)), "no_depth": missing}
        except CameraError as fault:
            missing = f"{fault}.".replace("depth", "Depth", 1)
    return {"optics": None, "no_depth": missing}


def curve_of(content: Export) -> DisplayCurve:
    """Return the display curve of a light field, fitted to its truth if known."""
    return DisplayCurve.fitted_to(content.light_field if content.truth is None else content.truth)


def overlays_of(content: Export, like: Export | None = None) -> list[Overlay]:
    """Return the maps that there are, ready to be drawn. like: whose ends of scales are taken."""
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
    if content.disparity_sigma is not None and shows_parallax(content.view_axes):
        values, name = content.disparity_sigma, "deviation of disparity"
        high = round_up(ends([values])[1])
        found.append(Overlay("disparity_sigma", name, "px per view", values, 0, high))
    scales = overlays_of(like) if like else []
    ends_of = {overlay.key: {"low": overlay.low, "high": overlay.high} for overlay in scales}
    return [replace(overlay, **ends_of.get(overlay.key, {})) for overlay in found]


def _resized(values: NDArray, shown: Array) -> NDArray:
    height, width = shown.shape[2:4]
    return cv2.resize(
        finite(np.asarray(values, np.float32)), (width, height), interpolation=cv2.INTER_NEAREST
    )


def _overlay(overlay: Overlay, shown: Array, encode: Callable[[NDArray], str]) -> dict[str, object]:
    levels = np.clip(
        (_resized(overlay.values, shown) - overlay.low) / (overlay.high - overlay.low), 0, 1
    )
    picture = np.rint(levels * 255).astype(np.uint8)
    if np.isnan(overlay.values).any():  # clear where nothing is known
        known = _resized(~np.isnan(overlay.values), shown)
        picture = np.dstack([picture, picture, picture, np.rint(known * 255).astype(np.uint8)])
    return {
        "key": overlay.key, "label": overlay.label, "unit": overlay.unit, "low": overlay.low,
        "high": overlay.high, "colours": overlay.colours, "picture": encode(picture),
    }  # fmt: skip


def render_film(film: Film) -> str:
    """Return the page of a film as text.

    One frame in the middle gives all of them their brightness and scales of colour.
    """
    places, count = list(film.frames), len(film.times_s)
    like = film.opened(places[len(places) // 2])
    curve, columns = curve_of(like), ceil(sqrt(count))
    most_pixels = min(SPRITE_PIXELS, int(FILM_BYTES / FILM_BYTES_PER_PIXEL / len(places)))
    shown = reduced(like.light_field, most_pixels)
    picture = np.ascontiguousarray(tiled(three_colours(curve.encode(shown)))[..., ::-1])
    quality = webp_quality(
        picture, int(FILM_BYTES / len(places) - MAP_BYTES_PER_PIXEL * shown[..., 0].size)
    )
    frames: list[dict[str, Any] | None] = [None] * count
    metrics: dict[int, Mapping[str, object]] = {}
    small = reduced(like.light_field[:1, :1], SPRITE_PIXELS // count)
    centres = np.zeros((ceil(count / columns), columns, *small.shape[2:4], 3), np.uint8)
    for place, export in film.each():
        frames[place] = viewer_data(export, most_pixels=most_pixels, like=like, webp=quality)
        metrics[place] = export.metrics
        centre = reduced(centre_view(export.light_field)[None, None], SPRITE_PIXELS // count)
        centres[divmod(place, columns)] = three_colours(curve.encode(centre))[0, 0]
    focus = [frame["focus"] for frame in frames if frame]
    ends_of_slider = {"low": min(f["low"] for f in focus), "high": max(f["high"] for f in focus)}
    for slider in focus:
        slider.update(ends_of_slider)
    data = {
        "rate": film.rate,
        "times_s": film.times_s,
        "frames": frames,
        "levels": [_level(metrics.get(place, {})) for place in range(count)],
        "rows": {
            "picture": sprite(centres, int(BYTES_PER_ROW_PIXEL * centres.size / 3)),
            "columns": columns, "height": small.shape[2], "width": small.shape[3],
            "tile": TILE_MULTIPLE_PX,
        },
    }  # fmt: skip
    rows, columns, height, width, _ = film.shape
    about = (
        f"{len(places)} of {count} frames at {film.rate:g} Hz, "
        f"{grid_name(like.view_axes, (rows, columns))} of {height}x{width}"
    )
    if shown.shape != film.shape:
        about += f", shown as {shown.shape[2]}x{shown.shape[3]}"
    return framed(
        film.folder.resolve().name, [f"{about}."], head=_film_head(film, metrics),
        lead=fragment("viewer.html", poster=poster(film.first, most_pixels, like), film=True),
        kind="viewer-page", styles=("viewer.css",), scripts=("viewer.js", "film.js"),
        data={"film-data": data},
    )  # fmt: skip


def _level(metrics: Mapping[str, object]) -> str:
    """Return the level of a verdict, "" where there is none."""
    verdict = metrics.get("verdict")
    return str(verdict.get("level")) if isinstance(verdict, Mapping) else ""


def _film_head(film: Film, metrics: Mapping[int, Mapping[str, object]]) -> Head:
    """Return the head of a film's page: that of its worst frames, with their number."""
    order = ["trust", "", *list(VERDICTS)[1:]]
    worst = max(metrics, key=lambda place: order.index(_level(metrics[place])))
    head = light_field_head(metrics[worst], str(film.folder), viewer=True)
    alike = [place for place in metrics if _level(metrics[place]) == _level(metrics[worst])]
    if len(alike) == len(metrics):
        return head
    first = f"{len(alike)} of {len(metrics)} frames, the first at {film.times_s[worst]:.2f} s"
    return replace(head, why=f"{first}: {head.why}")


VIEWER = Format(
    "viewer", "viewer.html, one page to turn, focus and look into", "8-bit pictures, maps",
    lambda folder, export: write_text(folder / "viewer.html", render_viewer(export)),
    write_film=lambda folder, film: write_text(folder / "viewer.html", render_film(film)),
)  # fmt: skip

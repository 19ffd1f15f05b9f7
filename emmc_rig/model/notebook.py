"""Pictures of arrays for notebooks: HTML with the pictures inside, as `_repr_html_` returns it."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.srgb import codes_of, srgb_of

Array = NDArray[np.floating]
KINDS = {
    ".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml", ".webp": "image/webp"
}  # fmt: skip
WIDE_PX, LONGEST_PX = 215, 645
"""Of a picture on the page, where four fit side by side, and of its file, for fine screens."""
MIDDLE = 48, 64
"""Rows and columns that are shown where single pixels count."""
MOST_SHOTS, UNUSABLE = 3, (0.6, 0.0, 0.0)


def data_address(data: bytes, kind: str) -> str:
    """Return bytes as a data URL. kind: the suffix of such a file."""
    return f"data:{KINDS[kind]};base64,{base64.b64encode(data).decode()}"


def picture_address(image: NDArray[np.uint8], extension: str, *options: int) -> str:
    """Return a picture as a data URL: (y, x) or (y, x, 3), blue first; options: OpenCV's."""
    done, encoded = cv2.imencode(extension, image, options)
    if not done:
        raise ValueError(f"cannot encode a picture of shape {image.shape} as {extension}")
    return data_address(encoded.tobytes(), extension)


def figure_html(caption: str, pictures: Mapping[str, Array]) -> str:
    """Return pictures of linear light, (y, x) or (y, x, 3), below their titles, and a caption."""
    shown = "".join(
        f'<figure style="display:inline-block;margin:0 8px 4px 0;vertical-align:top">'
        f'<figcaption style="font-size:12px;width:{WIDE_PX}px">{html.escape(title)}</figcaption>'
        f'<img alt="{html.escape(title)}" src="{_address(values)}" '
        f'style="width:{WIDE_PX}px;border:1px solid #ccc;image-rendering:pixelated"></figure>'
        for title, values in pictures.items()
    )
    return f"<div>{shown}<br>{html.escape(caption)}</div>"


def _address(values: Array) -> str:
    """Return linear light as a PNG, without more pixels than are shown."""
    light = np.ascontiguousarray(values[..., ::-1] if values.ndim == 3 else values, np.float32)
    shrink = max(light.shape) / LONGEST_PX
    if shrink > 1:
        size = round(light.shape[1] / shrink), max(1, round(light.shape[0] / shrink))
        light = np.asarray(cv2.resize(light, size, interpolation=cv2.INTER_AREA), np.float32)
    return picture_address(codes_of(srgb_of(light)), ".png")


def middle(values: NDArray) -> NDArray:
    """Return the middle MIDDLE rows and columns of (y, x, ...)."""
    top, left = (max(0, (values.shape[k] - MIDDLE[k]) // 2) for k in (0, 1))
    return values[top : top + MIDDLE[0], left : left + MIDDLE[1]]


def light_field_pictures(light_field: Array, disparity: Array | None) -> dict[str, Array]:
    """Return the centre view, the epipolar image of its middle row, and the disparity if known."""
    v, u, rows = (count // 2 for count in light_field.shape[:3])
    lines = light_field[v, :, rows]
    lines = np.repeat(lines, max(1, lines.shape[1] // (4 * len(lines))), axis=0)
    pictures = {f"view ({v}, {u})": light_field[v, u], f"epipolar image of row {rows}": lines}
    if disparity is not None:
        low, high = float(np.nanmin(disparity)), float(np.nanmax(disparity))
        shown = np.nan_to_num((disparity - low) / max(high - low, 1e-12))
        pictures[f"disparity {low:.2g} (black) to {high:.2g}"] = shown
    return pictures


def frame_pictures(readings: Array, usable: NDArray[np.bool_]) -> dict[str, Array]:
    """Return the first shots of readings (shot, y, x), unusable pixels in red."""
    good = readings[usable]
    white = max(float(np.percentile(good, 99.7)), 1e-6) if good.size else 1.0
    pictures = {}
    for shot in range(min(len(readings), MOST_SHOTS)):
        grey = np.repeat((readings[shot] / white)[..., None], 3, axis=-1)
        shown = np.where(usable[shot][..., None], grey, UNUSABLE)
        pictures[f"shot {shot + 1}, white is {white:.2g}"] = shown
    return pictures


def shadow_pictures(weights: Array, colour: NDArray[np.uint8] | None) -> dict[str, Array]:
    """Return what the first shot's pixels see of two open views, outer and inner, and of all.

    weights: (shot, v, u, y, stored colour, x). colour: (shot, y, x), of one stored colour.
    """
    _, rows, columns = weights.shape[:3]
    grid = np.ndindex(rows, columns)
    views = {place: middle(np.moveaxis(weights[0, *place], 1, 2)) for place in grid}
    opened = [place for place, values in views.items() if values.any()] or list(views)
    inner = min(opened, key=lambda place: np.hypot(place[0] - rows // 2, place[1] - columns // 2))
    seen = {f"view {place}": views[place] for place in (opened[0], inner)}
    seen[f"all {rows}x{columns} views"] = np.sum(list(views.values()), axis=0)
    if colour is not None:
        filters = np.eye(3, dtype=np.float32)[middle(colour[0])]
        seen = {name: values * filters for name, values in seen.items()}
    high, wide = next(iter(seen.values())).shape[:2]
    return {
        f"shadow in {name}, middle {high}x{wide}": values / max(values.max(), 1e-12)
        for name, values in seen.items()
    }

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
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".svg": "image/svg+xml",
    ".webp": "image/webp",
}
WIDE_PX, LONGEST_PX = 215, 645
"""Of a picture on the page; of its file, which a screen of three pixels for each of the page's
shows. Four pictures fit side by side into a notebook."""
MIDDLE = 48, 64
"""Rows and columns that are shown where single pixels count."""
MOST_SHOTS = 3
UNUSABLE = 0.6, 0.0, 0.0


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
    """Return pictures side by side, each below its title, and a caption below them all.

    pictures: linear light by title, (y, x) or (y, x, 3); 1 is white.
    """
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
    return values[tuple(
        slice(max(0, (have - want) // 2), max(0, (have - want) // 2) + want)
        for have, want in zip(values.shape, MIDDLE, strict=False)
    )]  # fmt: skip


def stretched(values: Array) -> Array:
    """Return finite values of [least, most] as [0, 1]; others are 0."""
    finite = np.isfinite(values)
    if not finite.any():
        return np.zeros_like(values)
    low, high = float(values[finite].min()), float(values[finite].max())
    return np.where(finite, (values - low) / max(high - low, 1e-12), 0)


def light_field_pictures(light_field: Array, disparity: Array | None) -> dict[str, Array]:
    """Return the centre view, the epipolar image of its middle row, and the disparity if known."""
    v, u, rows = (count // 2 for count in light_field.shape[:3])
    lines = light_field[v, :, rows]
    high = max(1, lines.shape[1] // (4 * len(lines)))
    pictures = {
        f"view ({v}, {u})": light_field[v, u],
        f"epipolar image of row {rows}": np.repeat(lines, high, axis=0),
    }
    if disparity is not None:
        ends = f"{np.nanmin(disparity):.2g} (black) to {np.nanmax(disparity):.2g}"
        pictures[f"disparity {ends}"] = stretched(disparity)
    return pictures


def frame_pictures(readings: Array, usable: NDArray[np.bool_]) -> dict[str, Array]:
    """Return the first shots of readings (shot, y, x), unusable pixels in red."""
    good = readings[usable]
    white = max(float(np.percentile(good, 99.7)), 1e-6) if good.size else 1.0
    pictures = {}
    for shot in range(min(len(readings), MOST_SHOTS)):
        grey = np.repeat((readings[shot] / white)[..., None], 3, axis=-1)
        pictures[f"shot {shot + 1}, white is {white:.2g}"] = np.where(
            usable[shot][..., None], grey, UNUSABLE
        )
    return pictures


def shadow_pictures(weights: Array, colour: NDArray[np.uint8] | None) -> dict[str, Array]:
    """Return what the first shot's pixels see of two open views, outer and inner, and of all.

    weights: (shot, v, u, y, stored colour, x). colour: (shot, y, x), of one stored colour.
    """
    _, rows, columns = weights.shape[:3]
    views = {
        (v, u): middle(np.moveaxis(weights[0, v, u], 1, 2)) for v, u in np.ndindex(rows, columns)
    }
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

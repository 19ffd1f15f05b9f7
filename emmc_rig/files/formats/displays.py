"""For displays: quilts of views between the views, and parallax as video and animation. sRGB."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.formats.format import Array, Export, Format, write_picture
from emmc_rig.model.novel_view import between, centre_disparity, view_disparities
from emmc_rig.model.srgb import codes_of, srgb_of

QUILT_COLUMNS, QUILT_ROWS = 8, 6
FRAMES, FRAMES_PER_S = 48, 24
REACH = 0.9
"""How far out of the circle of views the walk goes, of the way to the outermost."""


def _all_disparities(export: Export) -> Array:
    centre = centre_disparity(export.light_field, export.disparity)
    rows, columns = export.light_field.shape[:2]
    return view_disparities(centre, (rows, columns))


def _write_quilt(folder: Path, export: Export) -> None:
    """Views from left to right along the middle row, the leftmost at the bottom left.

    Near points move right with u here, which is what a camera moving left sees: u falls. The
    views are off-axis: disparity 0 lies in the display's plane. Source: Looking Glass, "Quilts".
    """
    rows, columns, height, width, _ = export.light_field.shape
    disparities = _all_disparities(export)
    count = QUILT_COLUMNS * QUILT_ROWS
    quilt = np.empty((QUILT_ROWS * height, QUILT_COLUMNS * width, 3), np.uint8)
    for place, u in enumerate(np.linspace(columns - 1, 0, count)):
        row, column = divmod(place, QUILT_COLUMNS)
        top, left = (QUILT_ROWS - 1 - row) * height, column * width
        view = between(export.light_field, disparities, rows // 2, float(u))
        quilt[top : top + height, left : left + width] = codes_of(srgb_of(view))
    name = f"quilt_qs{QUILT_COLUMNS}x{QUILT_ROWS}a{width / height:.3g}.png"
    write_picture(folder / name, quilt)


def walk(export: Export) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures (y, x, rgb), in sRGB, of one round over the views."""
    rows, columns = export.light_field.shape[:2]
    disparities = _all_disparities(export)
    for angle in np.linspace(0, 2 * np.pi, FRAMES, endpoint=False):
        v = (rows - 1) / 2 * (1 + REACH * np.sin(angle))
        u = (columns - 1) / 2 * (1 + REACH * np.cos(angle))
        yield codes_of(srgb_of(between(export.light_field, disparities, float(v), float(u))))


def _write_video(folder: Path, export: Export, ending: str, codec: str) -> None:
    path = folder / f"parallax.{ending}"
    height, width = (n // 2 * 2 for n in export.light_field.shape[2:4])  # codecs want even sides
    fourcc = cv2.VideoWriter.fourcc(*codec)
    video = cv2.VideoWriter(str(path), fourcc, FRAMES_PER_S, (width, height))
    if not video.isOpened():
        raise AppError(f"{path.name}: this OpenCV has no encoder {codec}; choose --format gif")
    for picture in walk(export):
        video.write(np.ascontiguousarray(picture[:height, :width, ::-1]))
    video.release()


def _write_gif(folder: Path, export: Export) -> None:
    # OpenCV's GIF has 216 fixed colours, seven times as far off.
    from PIL import Image

    first, *others = (Image.fromarray(picture).quantize(256) for picture in walk(export))
    first.save(
        folder / "parallax.gif", save_all=True, append_images=others,
        duration=1000 // FRAMES_PER_S, loop=0,
    )  # fmt: skip


FORMATS = (
    Format(
        "quilt", f"quilt of {QUILT_COLUMNS * QUILT_ROWS} views for light-field displays",
        "8-bit sRGB, views of the middle row and between them", _write_quilt, parallax=True,
    ),
    Format(
        "video", "parallax.mp4, a round over the views", "8-bit video",
        partial(_write_video, ending="mp4", codec="mp4v"), parallax=True,
    ),
    Format(
        "webm", "parallax.webm (VP8), the same for web pages", "8-bit video",
        partial(_write_video, ending="webm", codec="VP80"), parallax=True,
    ),
    Format(
        "gif", "parallax.gif, a round over the views", "256 colours", _write_gif, parallax=True
    ),
)  # fmt: skip

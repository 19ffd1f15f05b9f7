"""For displays: quilts of views between the views, and parallax as video and animation. sRGB.

Of a film, videos show the centre view in time, and a quilt is a frame of a video. They run at the
film's rate; a missing frame shows the one before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import pairwise, repeat
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.formats.format import Array, Export, Film, Format, write_picture
from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.novel_view import between, centre_disparity, view_disparities
from emmc_rig.model.srgb import codes_of, srgb_of

Codes = NDArray[np.uint8]
QUILT_COLUMNS, QUILT_ROWS = 8, 6
FRAMES, FRAMES_PER_S = 48, 24
REACH = 0.9
"""How far out of the circle of views the walk goes, of the way to the outermost."""


def _all_disparities(export: Export) -> Array:
    centre = centre_disparity(export.light_field, export.disparity)
    rows, columns = export.light_field.shape[:2]
    return view_disparities(centre, (rows, columns))


def _quilt(export: Export) -> Codes:
    """Return views from left to right along the middle row, the leftmost at the bottom left.

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
    return quilt


def _quilt_name(shape: tuple[int, ...], ending: str) -> str:
    """Return the name by which displays know a quilt of light fields (v, u, y, x, c)."""
    return f"quilt_qs{QUILT_COLUMNS}x{QUILT_ROWS}a{shape[3] / shape[2]:.3g}.{ending}"


def _write_quilt(folder: Path, export: Export) -> None:
    write_picture(folder / _quilt_name(export.light_field.shape, "png"), _quilt(export))


def _write_quilt_film(folder: Path, film: Film) -> None:
    """Write a video of quilts; VP8 is what Looking Glass names for 8 x 6 of them."""
    path = folder / _quilt_name(film.shape, "webm")
    _encode(path, "VP80", film.rate, in_time(film, _quilt))


def walk(export: Export) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures (y, x, rgb), in sRGB, of one round over the views."""
    rows, columns = export.light_field.shape[:2]
    disparities = _all_disparities(export)
    for angle in np.linspace(0, 2 * np.pi, FRAMES, endpoint=False):
        v = (rows - 1) / 2 * (1 + REACH * np.sin(angle))
        u = (columns - 1) / 2 * (1 + REACH * np.cos(angle))
        yield codes_of(srgb_of(between(export.light_field, disparities, float(v), float(u))))


def _centre(export: Export) -> Codes:
    return codes_of(srgb_of(centre_view(export.light_field)))


def in_time(film: Film, picture_of: Callable[[Export], Codes]) -> Iterator[Codes]:
    """Yield the picture (y, x, rgb) of every place in time; a missing frame repeats the last one.

    Places before the first frame have the picture of the first frame.
    """
    begins = [0, *list(film.frames)[1:], len(film.times_s)]
    for (_, export), (begin, end) in zip(film.each(), pairwise(begins), strict=True):
        yield from repeat(picture_of(export), end - begin)


def _encode(path: Path, codec: str, rate: float, pictures: Iterable[Codes]) -> None:
    """Write pictures (y, x, rgb) as a video. rate: pictures a second."""
    video = None
    for picture in pictures:
        height, width = (n // 2 * 2 for n in picture.shape[:2])  # codecs want even sides
        video = video or cv2.VideoWriter(
            str(path), cv2.VideoWriter.fourcc(*codec), rate, (width, height)
        )
        if not video.isOpened():
            raise AppError(
                f"{path.name}: this OpenCV has no encoder {codec}; choose another format"
            )
        video.write(np.ascontiguousarray(picture[:height, :width, ::-1]))
    if video is not None:
        video.release()


def _write_video(folder: Path, export: Export, ending: str, codec: str) -> None:
    _encode(folder / f"parallax.{ending}", codec, FRAMES_PER_S, walk(export))


def _write_film(folder: Path, film: Film, ending: str, codec: str) -> None:
    _encode(folder / f"film.{ending}", codec, film.rate, in_time(film, _centre))


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
        write_film=_write_quilt_film,
    ),
    Format(
        "mp4", "parallax.mp4 (MPEG-4 Part 2), a round over the views", "8-bit video",
        partial(_write_video, ending="mp4", codec="mp4v"), parallax=True,
        write_film=partial(_write_film, ending="mp4", codec="mp4v"),
    ),
    Format(
        "webm", "parallax.webm (VP8), the same for web pages", "8-bit video",
        partial(_write_video, ending="webm", codec="VP80"), parallax=True,
        write_film=partial(_write_film, ending="webm", codec="VP80"),
    ),
    Format(
        "gif", "parallax.gif, a round over the views", "256 colours", _write_gif, parallax=True
    ),
)  # fmt: skip

"""Make the README's animation: `python docs/pictures/draw_parallax.py`, about a minute.

One coded frame of a built-in scene, and beside it the light field recovered from that frame, seen
by an eye that moves on a circle in the lens.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import emmc_rig as emmc
from emmc_rig.model.novel_view import between, view_disparities

SCENE, CAMERA, SIZE = "toy-table", "rgbw-bayer-1shot", (192, 256)
ZOOM, GAP_PX, CAPTION_PX = 1.875, 16, 34
POSITIONS, RADIUS_VIEWS, PAUSE_MS = 32, 1.6, 70
CAPTIONS = "the one frame that the camera recorded", "the light field recovered from it"
QUALITY = 72
"""Of the WebP: at most 1.5 MB, which a README loads at once."""


def shown(linear: NDArray[np.floating]) -> Image.Image:
    """Return linear values (y, x) or (y, x, rgb) of [0, 1] as an enlarged picture."""
    codes = np.rint(255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    wide, high = (round(ZOOM * side) for side in codes.shape[1::-1])
    how = Image.Resampling.NEAREST if linear.ndim == 2 else Image.Resampling.LANCZOS
    return Image.fromarray(codes).convert("RGB").resize((wide, high), how)


def animation(
    readings: NDArray[np.floating], light_field: NDArray[np.floating], centre: NDArray[np.floating]
) -> list[Image.Image]:
    """Return the pictures: readings (y, x) at the left, a moving view at the right.

    light_field: (v, u, y, x, rgb); centre: disparity (y, x) of its centre view, pixels a view.
    """
    disparities = view_disparities(centre, light_field.shape[:2])
    frame = shown(readings / np.percentile(readings, 99))
    wide, high = frame.size
    middle, font = (light_field.shape[0] - 1) / 2, ImageFont.load_default(18)
    pictures = []
    for angle in 2 * np.pi * np.arange(POSITIONS) / POSITIONS:
        v, u = middle + RADIUS_VIEWS * np.sin(angle), middle + RADIUS_VIEWS * np.cos(angle)
        paper = Image.new("RGB", (2 * wide + GAP_PX, high + CAPTION_PX), "white")
        paper.paste(frame, (0, 0))
        paper.paste(shown(between(light_field, disparities, v, u)), (wide + GAP_PX, 0))
        for left, words in zip((0, wide + GAP_PX), CAPTIONS, strict=True):
            place = left + wide / 2, high + CAPTION_PX / 2
            ImageDraw.Draw(paper).text(place, words, "#22303c", font, anchor="mm")
        pictures.append(paper)
    return pictures


def main() -> None:
    """Expose the frame, recover the light field, write parallax.webp."""
    camera, scene = emmc.camera(CAMERA), emmc.scene(SCENE, size=SIZE)
    psi = camera.psi(scene.size)
    frames = camera.expose(scene, seed=0, psi=psi)
    result = emmc.reconstruct(psi, frames)
    assert result.disparity is not None
    first, *others = animation(frames.readings[0], result.light_field, result.disparity)
    path = Path(__file__).parent / "parallax.webp"
    first.save(
        path, save_all=True, append_images=others, duration=PAUSE_MS, loop=0,
        quality=QUALITY, method=6,
    )  # fmt: skip
    print(path, f"{path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()

"""Draw the pictures of docs/concepts.md: `python docs/pictures/draw_concepts.py`, some seconds.

Two are drawn by hand; in the others the pictures and weights are those of a small real camera.
"""

from __future__ import annotations

import base64
import io
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import emmc_rig as emmc

sys.path.insert(0, str(Path(__file__).parent))

from draw_cameras import INK, RAY, SPECTRUM, Parts, box, framed, lens, line

WIDE = 460
"""Of the drawings: on a phone their words stay readable."""
LENS_X, SENSOR_X, AXIS_Y, CELL = 190, 390, 120, 30
NEAR, FAR = "#d98200", "#1f6fb5"
LENS_MM, CELL_MM, SAMPLE_UM = 50.0, 4.0, 24.0
SHADOW_MM = 0.3
"""Distance of a mask whose shadow moves by one sample between neighbouring views."""

Array = NDArray[np.floating]


def words(x: float, y: float, text: str, anchor: str = "middle", colour: str = INK) -> str:
    """Return words at a place."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">{text}</text>'


def grey(value: float) -> str:
    """Return the colour of a weight or brightness of [0, 1], in 32 steps."""
    code = round(255 * round(31 * min(max(float(value), 0), 1)) / 31)
    return f"#{code:02x}{code:02x}{code:02x}"


def raster(x: float, y: float, wide: float, high: float, values: Array) -> Parts:
    """Yield an array (y, x) or (y, x, rgb) of [0, 1] as a framed picture, its pixels kept."""
    codes = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    held = io.BytesIO()
    Image.fromarray(codes).save(held, "PNG", optimize=True)
    data = base64.b64encode(held.getvalue()).decode()
    yield (
        f'<image x="{x}" y="{y}" width="{wide}" height="{high}" preserveAspectRatio="none" '
        f'style="image-rendering:pixelated" href="data:image/png;base64,{data}"/>'
    )
    yield box(x, y, wide, high, "none")


def parts_of_lens(x: float, open_at: int | None = None) -> Parts:
    """Yield the lens with its five parts; open_at: the only part that a plate leaves open."""
    yield lens(x, AXIS_Y, 13, 84)
    for part in range(5):
        fill = INK if open_at not in (None, part) else "#fff"
        yield box(x - 4, AXIS_Y + (part - 2.5) * CELL, 8, CELL, fill)


def sensor(x: float = SENSOR_X) -> Parts:
    """Yield the sensor's pixels."""
    for pixel in range(12):
        yield box(x, AXIS_Y - 84 + 14 * pixel, 10, 14, "#fff")


def two_planes() -> Parts:
    """A ray is named by where it passes the lens and where it meets the sensor."""
    point, meets, part = (40, 100), 134, 3
    through = AXIS_Y + (part - 2) * CELL
    for other in (0, 1, 2, 4):
        yield line(*point, LENS_X, AXIS_Y + (other - 2) * CELL, "#cfd6dc")
        yield line(LENS_X, AXIS_Y + (other - 2) * CELL, SENSOR_X, meets, "#cfd6dc")
    yield line(*point, LENS_X, through, NEAR, 2.5)
    yield line(LENS_X, through, SENSOR_X, meets, NEAR, 2.5)
    yield from parts_of_lens(LENS_X)
    yield from sensor()
    yield f'<circle cx="{point[0]}" cy="{point[1]}" r="6" fill="{NEAR}"/>'
    yield words(point[0], 80, "scene")
    for part in range(5):
        yield words(LENS_X - 22, AXIS_Y + (part - 2) * CELL + 5, str(part))
    yield words(LENS_X, 228, "lens: part u")
    yield words(SENSOR_X + 5, 228, "sensor: place x")
    yield words(300, 30, "ray (u = 3, x)", colour=NEAR)


def disparity() -> Parts:
    """A near and a far point, seen through the uppermost and the lowermost part of the lens."""
    for colour, bar_x, point, seen in (
        (FAR, 34, (30, AXIS_Y - 10), (120, 106)), (NEAR, 24, (90, AXIS_Y + 20), (62, 142)),
    ):  # fmt: skip
        for part, at in zip((0, 4), seen, strict=True):
            through = AXIS_Y + (part - 2) * CELL
            yield line(*point, LENS_X, through, colour, 1.6)
            yield line(LENS_X, through, SENSOR_X, at, colour, 1.6)
        yield f'<circle cx="{point[0]}" cy="{point[1]}" r="6" fill="{colour}"/>'
        yield line(SENSOR_X + bar_x, seen[0], SENSOR_X + bar_x, seen[1], colour, 4)
    yield from parts_of_lens(LENS_X)
    yield from sensor()
    yield words(30, 96, "far", colour=FAR)
    yield words(90, 166, "near", colour=NEAR)
    yield words(LENS_X, 228, "lens")
    yield words(SENSOR_X, 228, "sensor")
    yield words(SENSOR_X + 5, 24, "moves by", colour=INK)


@cache
def _scene() -> tuple[Array, Array]:
    scene = emmc.scene("deep-occlusions", size=(120, 160), views=(1, 21))
    return np.asarray(scene) ** (1 / 2.2), np.asarray(scene.disparity_px)


def epipolar() -> Parts:
    """One row of the picture, from every view: points are lines, their slope is the disparity."""
    views, row = _scene()[0][0], 92
    yield from raster(70, 12, 320, 240, views[len(views) // 2])
    at = 12 + 2 * row + 1
    yield line(62, at, 398, at, SPECTRUM[0], 2)
    yield words(56, at + 5, "this row", "end", SPECTRUM[0])
    yield from raster(70, 284, 320, 5 * len(views), views[:, row])
    yield words(230, 275, "the same row from 21 views, one below the other")
    yield words(62, 296, "view 0", "end")
    yield words(62, 284 + 5 * len(views), "view 20", "end")


def mask_places() -> Parts:
    """A mask on the sensor, before it, in the lens: the cells that the rays to one pixel meet."""
    cells = (1, 0, 0, 1, 1, 0, 1, 0, 1, 1, 0, 0, 1, 1, 0)
    for number, (place, name) in enumerate(((1.0, "0"), (0.62, "d"), (0.0, "D"))):
        left, right = 40 + 145 * number, 135 + 145 * number
        at = left + (right - left) * place
        yield lens(left, 90, 8, 64)
        for k in range(5):
            yield line(left, 90 + (k - 2) * 24, right, 90, RAY, 1.2)
        count, high = (5, 24) if name == "D" else (15, 8.8)
        for k, cell in enumerate(cells[:count]):
            yield box(at - 4, 90 + (k - count / 2) * high, 6, high, "#fff" if cell else INK)
        yield box(right + 3, 22, 7, 136, "#d9dee3")
        yield box(right + 3, 86, 7, 8, RAY)
        yield words((left + right) / 2, 184, f"mask at {name}")
    yield words(WIDE / 2, 206, "lens at the left, sensor at the right, one pixel in orange")


def coded(distance_mm: float, size: tuple[int, int] = (16, 16), cells_um: float = SAMPLE_UM):
    """Return Psi of a grey camera of a row of five views, its random mask at a distance."""
    return emmc.camera(
        {
            "title": "a small camera",
            "views": (1, 5),
            "lens": {"distance_mm": LENS_MM, "aperture_cell_mm": CELL_MM},
            "sensor": {"cfa": ["R"], "sample_pitch_um": SAMPLE_UM},
            "masks": {
                "code": {
                    "distance_mm": distance_mm,
                    "cell_um": cells_um,
                    "pattern": {"kind": "random_binary", "open_probability": 0.5, "seed": 3},
                }
            },
        }
    ).psi(size)


def weights_of(psi) -> Array:
    """Return what the pixels see of each view (u, y, x), the largest weight 1."""
    seen = np.asarray(psi.weights)[0, 0, :, :, 0]
    return seen / seen.max()


def mask_views() -> Parts:
    """What 16x16 pixels see of views 0 to 4, with the mask at 0, d and D."""
    side = 72
    for row, (name, distance_mm, cells_um) in enumerate(
        (("0", 0.0, SAMPLE_UM), ("d", SHADOW_MM, SAMPLE_UM), ("D", LENS_MM, 1e3 * CELL_MM))
    ):
        y = 30 + row * (side + 8)
        yield words(38, y + side / 2 + 5, f"mask at {name}")
        for view, seen in enumerate(weights_of(coded(distance_mm, cells_um=cells_um))):
            yield from raster(80 + view * (side + 2), y, side, side, seen)
    for view in range(5):
        yield words(80 + view * (side + 2) + side / 2, 20, f"view {view}")


def psi() -> Parts:
    """A frame of 4x6 pixels is Psi times a light field of 5 views of 4x6 samples: real figures."""
    size = (4, 6)
    small = coded(SHADOW_MM, size)
    scene = np.asarray(emmc.scene("near-planar", size=(16, 24), views=(1, 5)))
    light = scene.mean(axis=-1)[:, :, ::4, ::4]
    light = np.ascontiguousarray(light / light.max())
    seen = np.asarray(small.weights)[0, 0, :, :, 0].reshape(5, -1)
    readings = (seen * light.reshape(5, -1)).sum(axis=0)
    pixels, cell, left, top = seen.shape[1], 8.0, 50, 40
    wide = 2.4
    colours = [*SPECTRUM]
    for pixel in range(pixels):
        yield box(left - 32, top + cell * pixel, 12, cell, grey(readings[pixel]), "none")
    yield box(left - 32, top, 12, cell * pixels, "none")
    yield words(left - 12, top + cell * pixels / 2 + 5, "=")
    for view in range(5):
        x = left + view * wide * pixels
        yield box(x, top, wide * pixels, cell * pixels, "#f4f6f8", "none")
        for pixel in range(pixels):
            weight = seen[view, pixel] / seen.max()
            if weight > 0.02:
                yield (
                    f'<rect x="{x + wide * pixel:.1f}" y="{top + cell * pixel:.1f}" '
                    f'width="{wide}" height="{cell}" fill="{colours[view]}" '
                    f'fill-opacity="{weight:.2f}"/>'
                )
        yield words(x + wide * pixels / 2, top - 10, f"view {view}", colour=colours[view])
        yield line(x, top, x, top + cell * pixels, "#b8c2ca", 1)
    right = left + 5 * wide * pixels
    yield box(left, top, 5 * wide * pixels, cell * pixels, "none")
    yield words(right + 14, top + cell * pixels / 2 + 5, "x")
    high = cell * pixels / (5 * pixels)
    for view in range(5):
        for pixel in range(pixels):
            y = top + high * (view * pixels + pixel)
            yield box(right + 30, y, 12, high, grey(light.reshape(5, -1)[view, pixel]), "none")
        y = top + high * (view + 0.5) * pixels
        yield words(right + 54, y + 5, str(view), colour=colours[view])
    yield box(right + 30, top, 12, cell * pixels, "none")
    under = top + cell * pixels + 22
    yield words(left - 26, under, "frame")
    yield words(left + 2.5 * wide * pixels, under, "Psi: a row for each pixel")
    yield words(right + 36, under, "light field")


def whiteboard() -> Parts:
    """A plate opens one view: the frame of a white board is what the pixels see of that view."""
    seen = weights_of(coded(SHADOW_MM))
    for row, view in enumerate((1, 3)):
        y = 130 * row + 70
        yield box(16, y - 44, 8, 88, "#fff")
        for k in range(5):
            yield box(110, y + (k - 2.5) * 18, 7, 18, "#fff" if k == view else INK)
        yield lens(130, y, 9, 52)
        opened = y + (view - 2) * 18
        for to in (-36, 0, 36):
            yield line(24, opened + to / 3, 114, opened, RAY)
            yield line(114, opened, 262, y + to, RAY)
        for k in range(8):
            yield box(252, y - 44 + 11 * k, 5, 11, "#fff" if (k * k + k) % 3 else INK)
        yield box(264, y - 44, 7, 88, "#d9dee3")
        yield line(282, y, 318, y)
        yield from raster(330, y - 52, 104, 104, seen[view])
        yield words(130, y + 66, f"hole at view {view}")
        yield words(382, y + 68, f"weights of view {view}")
    yield words(26, 14, "board")
    yield words(124, 14, "plate, lens")
    yield words(258, 14, "mask, sensor")


PICTURES: dict[str, tuple[Callable[[], Parts], int]] = {
    "two-planes": (two_planes, 240),
    "disparity": (disparity, 240),
    "epipolar": (epipolar, 402),
    "mask-places": (mask_places, 216),
    "mask-views": (mask_views, 284),
    "psi": (psi, 272),
    "whiteboard": (whiteboard, 282),
}
"""Drawing function and height of each picture."""


def drawn(name: str) -> str:
    """Return a picture as SVG."""
    draw, high = PICTURES[name]
    return framed(draw(), WIDE, high)


if __name__ == "__main__":
    for picture in PICTURES:
        (Path(__file__).parent / f"concepts-{picture}.svg").write_text(drawn(picture))

"""Draw the pictures of docs/day-one.md: `python docs/pictures/draw_bench.py`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from draw_cameras import CELL, INK, MIDDLE, RAY, Parts, box, column, heights, lens, line, words
from draw_cameras import framed as framed_svg


def label(x: float, y: float, text: str) -> str:
    """Return words that begin at a place."""
    return f'<text x="{x}" y="{y}">{text}</text>'


def mask_before_sensor() -> Parts:
    """A cut through the sensor's corner: chip, cover glass, spacer, mask with its cells inside."""
    yield box(60, 150, 360, 26, "#d9dee3")
    yield box(90, 142, 300, 8, "#7f8c99")
    yield box(78, 104, 324, 16, "#bfe3f2")
    for x in (60, 402):
        yield box(x, 104, 18, 46, "#c9b79a")
    for x in (78, 366):
        yield box(x, 84, 36, 20, "#b5651d")
    yield box(78, 58, 324, 26, "#e4f3fa")
    for k in range(0, 54):
        if (k * 7) % 11 < 5:
            yield box(78 + 6 * k, 80, 6, 4, INK, "none")
    for x in (180, 220, 260):
        yield line(x, 20, 240 + (x - 220) * 0.2, 142, RAY, 1.2)
    for y, text in ((42, "light"), (72, "mask, its cells below"), (98, "spacer"),
                    (116, "cover glass"), (148, "sensor")):  # fmt: skip
        yield label(424, y, text)
    yield label(596, 118, "d")
    yield line(584, 84, 584, 142, INK, 1)
    yield line(578, 84, 590, 84)
    yield line(578, 142, 590, 142)


def plate_before_lens() -> Parts:
    """From the side: board, plate at the lens, lens, sensor; from the front: the grid of holes."""
    yield box(30, 30, 10, 140, "#fff")
    yield lens(250, MIDDLE, 14, 66)
    for y in heights():
        closed = INK if y != heights()[1] else "#fff"
        yield box(222, y - CELL / 2, 6, CELL, closed)
    yield line(40, 60, 250, heights()[1], RAY)
    yield line(250, heights()[1], 396, MIDDLE, RAY)
    yield from column(396, ["#fff"] * 9, 14, 12)
    yield words(52, "white board")
    yield words(225, "plate")
    yield words(270, "lens", 190)
    yield words(396, "sensor")
    for row, y in enumerate(heights(5, 28)):
        for col in range(5):
            number = 5 * row + col + 1
            fill = RAY if number == 7 else "#fff"
            yield box(470 + 28 * col, y - 14, 28, 28, fill)
            yield f'<text x="{484 + 28 * col}" y="{y + 5}" text-anchor="middle">{number}</text>'
    yield words(540, "holes, from the sensor")


PICTURES = {"mask": mask_before_sensor, "plate": plate_before_lens}


def drawn(name: str) -> str:
    """Return a picture as SVG."""
    return framed_svg(PICTURES[name]())


if __name__ == "__main__":
    for picture in PICTURES:
        (Path(__file__).parent / f"bench-{picture}.svg").write_text(drawn(picture))

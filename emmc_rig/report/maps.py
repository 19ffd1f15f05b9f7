"""Maps of values as one SVG file, panels side by side with colour bars, without loading matplotlib.

Matplotlib takes half a second to load and half a second a figure, which a calibration's page need
not wait for.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.report.page import data_address

Array = NDArray[np.floating]
RED_TO_BLUE = (
    (103, 0, 31), (178, 24, 43), (214, 96, 77), (244, 165, 130), (253, 219, 199), (247, 247, 247),
    (209, 229, 240), (146, 197, 222), (67, 147, 195), (33, 102, 172), (5, 48, 97),
)  # fmt: skip
"""ColorBrewer's RdBu of 11 classes (colorbrewer2.org)."""
INK, FAINT = "#17202c", "#5b6776"
MAP_PX, ABOVE_PX, LEFT_PX, BELOW_PX, RIGHT_PX = 300, 30, 58, 44, 126
"""Longest side of a map, and the room around it for title, labels and bar."""
BAR_PX, BAR_TICKS = 12, 5
MOST_TICKS = 6
"""Of an axis in pixels."""


def colour_table(name: str) -> NDArray[np.uint8]:
    """Return 256 colours, (256, 3), from least to most: gray, magma or blue-red (0 is white)."""
    codes = np.arange(256)
    if name == "gray":
        return np.repeat(codes.astype(np.uint8)[:, None], 3, axis=1)
    if name == "magma":
        drawn = cv2.applyColorMap(codes.astype(np.uint8)[:, None], cv2.COLORMAP_MAGMA)
        return np.ascontiguousarray(drawn[:, 0, ::-1]).astype(np.uint8)
    assert name == "blue-red"
    known = np.array(RED_TO_BLUE[::-1], np.float64)
    at = np.linspace(0, 255, len(known))
    columns = [np.interp(codes, at, known[:, channel]) for channel in range(3)]
    return np.rint(np.stack(columns, axis=1)).astype(np.uint8)


class Map(NamedTuple):
    """A map and its labels. Ticks: by their places in pixels of the values, from the first."""

    title: str
    values: Array
    """(y, x); NaN is left white."""
    scale: tuple[float, float]
    """Values of the first and the last colour."""
    bar: str
    """Label of the colour bar, with the unit; lines between newlines."""
    colours: str
    """See `colour_table`."""
    across: str
    down: str
    """Labels of the axes."""
    ticks_x: Mapping[float, str]
    ticks_y: Mapping[float, str]


def pixel_ticks(count: int, shown: int) -> dict[float, str]:
    """Return round numbers of `count` pixels that are drawn as `shown`, by their places."""
    rough = max(count / MOST_TICKS, 1.0)
    power = 10 ** math.floor(math.log10(rough))
    step = int(next(power * times for times in (1, 2, 5, 10) if power * times >= rough))
    return {(n + 0.5) * shown / count: str(n) for n in range(0, count, step)}


def maps_svg(maps: Sequence[Map]) -> bytes:
    """Return maps side by side as an SVG file, the same bytes for the same maps."""
    drawn, left, height = [], 0.0, 0.0
    for each in maps:
        text, size = _panel(each)
        drawn.append(f'<g transform="translate({left:g} 0)">{text}</g>')
        left, height = left + size[0], max(height, size[1])
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{left:g}" height="{height:g}" '
        f'viewBox="0 0 {left:g} {height:g}" font-family="sans-serif" font-size="12" '
        f'fill="{FAINT}">'
    )
    return "".join([head, *drawn, "</svg>"]).encode()


def _panel(drawn: Map) -> tuple[str, tuple[float, float]]:
    """Return a map with its axes and bar, from the corner on, and its width and height."""
    rows, columns = drawn.values.shape
    px = MAP_PX / max(rows, columns)
    width, height = columns * px, rows * px
    right, bottom = LEFT_PX + width, ABOVE_PX + height
    table = colour_table(drawn.colours)
    parts = [
        _text(LEFT_PX, ABOVE_PX - 10, drawn.title, f'font-weight="bold" fill="{INK}"'),
        _image(_coloured(drawn, table), LEFT_PX, ABOVE_PX, width, height),
        _text((LEFT_PX + right) / 2, bottom + 36, drawn.across, 'text-anchor="middle"'),
        _turned(14, (ABOVE_PX + bottom) / 2, drawn.down),
    ]
    for place, word in drawn.ticks_x.items():
        parts.append(_text(LEFT_PX + place * px, bottom + 16, word, 'text-anchor="middle"'))
    for place, word in drawn.ticks_y.items():
        parts.append(_text(LEFT_PX - 6, ABOVE_PX + place * px + 4, word, 'text-anchor="end"'))
    parts.append(_image(table[::-1, None], right + 10, ABOVE_PX, BAR_PX, height))
    for share in np.linspace(0, 1, BAR_TICKS):
        value = drawn.scale[0] + share * (drawn.scale[1] - drawn.scale[0])
        y = bottom - share * height + 4
        parts.append(_text(right + BAR_PX + 14, y, f"{value:.3g}"))
    for line, words in enumerate(drawn.bar.split("\n")):
        parts.append(_turned(right + 92 + 14 * line, (ABOVE_PX + bottom) / 2, words))
    return "".join(parts), (right + RIGHT_PX, bottom + BELOW_PX)


def _coloured(drawn: Map, table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the map's colours, (y, x, RGB)."""
    low, high = drawn.scale
    share = (drawn.values - low) / max(high - low, 1e-30)
    known = np.isfinite(share)
    codes = (np.clip(np.where(known, share, 0), 0, 1) * 255 + 0.5).astype(np.uint8)
    return np.where(known[..., None], table[codes], np.uint8(255))


def _image(colours: NDArray[np.uint8], x: float, y: float, width: float, height: float) -> str:
    """Return an image of colours (y, x, RGB), pixel for pixel."""
    png = cv2.imencode(".png", np.ascontiguousarray(colours[..., ::-1]))[1].tobytes()
    return (
        f'<image x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" '
        'preserveAspectRatio="none" style="image-rendering:pixelated" '
        f'href="{data_address(png, ".png")}"/>'
    )


def _text(x: float, y: float, words: str, how: str = "") -> str:
    return f'<text x="{x:g}" y="{y:g}" {how}>{html.escape(words)}</text>'


def _turned(x: float, y: float, words: str) -> str:
    """Return words that read upwards, their middle at y."""
    how = f'text-anchor="middle" transform="rotate(-90 {x:g} {y:g})"'
    return _text(x, y, words, how)

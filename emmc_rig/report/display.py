"""Linear pictures as screen codes, and codes as pictures in a page: sprites, heat."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.notebook import picture_address

Array = NDArray[np.floating]

JPEG_QUALITIES = (88, 78, 68, 58, 48, 38)
"""Tried from the first until a picture is small enough; the last is taken in any case."""
WEBP_QUALITIES = (85, 75, 65, 55, 45, 35)
"""Likewise."""
TILE_MULTIPLE_PX = 16  # a JPEG block never straddles two views
SPRITE_PIXELS = 24_000_000  # canvases above this fail on small machines; larger views are reduced
PART_PIXELS = 4_500_000
"""Of a light field that is part of a report, which stays below 8 MB."""
HEAT = (
    (13, 16, 38),
    (62, 46, 128),
    (160, 56, 132),
    (234, 104, 80),
    (250, 206, 104),
    (255, 252, 232),
)


@dataclass(frozen=True)
class DisplayCurve:
    """How linear values become screen values: (gain x value) ^ (1 / gamma), 8 bits."""

    gain: float
    gamma: float

    @classmethod
    def fitted_to(cls, picture: Array) -> DisplayCurve:
        """Highlights at white, and the median of a dark scene lifted towards middle grey."""
        sample = finite(picture.reshape(-1)[::7])
        white = max(float(np.percentile(sample, 99.7)), 1e-6)
        median = min(max(float(np.median(sample)) / white, 1e-3), 0.99)
        return cls(1 / white, min(max(math.log(median) / math.log(0.36), 1.0), 2.2))

    def encode(self, linear: Array) -> NDArray[np.uint8]:
        """Screen values of linear ones, any shape."""
        levels = np.clip(finite(linear) * np.float32(self.gain), 0, 1)
        np.power(levels, np.float32(1 / self.gamma), out=levels)
        return (levels * 255 + 0.5).astype(np.uint8)


def finite(values: Array) -> NDArray[np.float32]:
    """Return float32 values, 0 where they are not finite, 1 for +infinity."""
    values = np.asarray(values, np.float32)
    if np.isfinite(values.sum(dtype=np.float64)):  # cheaper than asking every value
        return values
    return np.nan_to_num(values, nan=0.0, posinf=1.0, neginf=0.0)


def png_of(image: NDArray[np.uint8]) -> str:
    """A lossless picture as a data URL."""
    return picture_address(image, ".png", cv2.IMWRITE_PNG_COMPRESSION, 6)


def webp_of(image: NDArray[np.uint8], quality: int) -> str:
    """A small lossy picture as a data URL."""
    return picture_address(image, ".webp", cv2.IMWRITE_WEBP_QUALITY, quality)


def webp_quality(image: NDArray[np.uint8], most_bytes: int) -> int:
    """The finest quality at which a picture stays below most_bytes; the last in any case."""
    for quality in WEBP_QUALITIES[:-1]:
        if len(webp_of(image, quality)) <= most_bytes * 4 / 3:
            return quality
    return WEBP_QUALITIES[-1]


def tiled(views: NDArray[np.uint8], tile: int = TILE_MULTIPLE_PX) -> NDArray[np.uint8]:
    """All views of (v, u, y, x, c) in one picture, each padded to whole tiles."""
    rows, columns, height, width, colours = views.shape
    padding = [(0, 0), (0, 0), (0, -height % tile), (0, -width % tile), (0, 0)]
    padded = np.pad(views, padding, mode="edge").transpose(0, 2, 1, 3, 4)
    return padded.reshape(rows * padded.shape[1], columns * padded.shape[3], colours)


def sprite(views: NDArray[np.uint8], most_bytes: int, tile: int = TILE_MULTIPLE_PX) -> str:
    """All views of (v, u, y, x, c) in one JPEG, each padded to whole tiles.

    most_bytes: the finest quality that stays below is taken.

    Colour is kept at full resolution: half-resolution chroma bleeds from view to view.
    """
    picture = tiled(views, tile)
    if picture.shape[-1] == 3:
        picture = np.ascontiguousarray(picture[..., ::-1])  # OpenCV's channel order
    address = ""
    for quality in JPEG_QUALITIES:
        address = picture_address(
            picture,
            ".jpg",
            cv2.IMWRITE_JPEG_QUALITY,
            quality,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
        )
        if len(address) <= most_bytes * 4 / 3:
            break
    return address


def reduced(views: Array, most_pixels: int = SPRITE_PIXELS) -> Array:
    """Views small enough for one sprite; the same array when they already are."""
    rows, columns, height, width, colours = views.shape
    shrink = math.sqrt(most_pixels / (rows * columns * height * width))
    if shrink >= 1:
        return views
    size = (max(1, int(width * shrink)), max(1, int(height * shrink)))
    small = [
        cv2.resize(finite(view), size, interpolation=cv2.INTER_AREA)
        for view in views.reshape(-1, height, width, colours)
    ]
    shape = (rows, columns, size[1], size[0], colours)
    return np.asarray(small, np.float32).reshape(shape)


def three_colours(views: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return pictures (..., c) with three colours; grey is repeated."""
    return np.repeat(views, 3, axis=-1) if views.shape[-1] == 1 else views


def ends(maps: Iterable[Array | None]) -> tuple[float, float]:
    """Return what 1 and 99 % of the finite values lie below; 0 and 1 where there is none."""
    good = [values[np.isfinite(values)] for values in maps if values is not None]
    if not any(values.size for values in good):
        return 0.0, 1.0
    low, high = (float(end) for end in np.percentile(np.concatenate(good), (1, 99)))
    return low, max(high, low + 1e-6)


def round_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 5, 7 times a power of ten: a readable end of a scale."""
    if not math.isfinite(value) or value <= 0:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(value))
    end = next(step * decade for step in (1, 1.5, 2, 3, 5, 7, 10) if step * decade >= value)
    return float(f"{end:.2g}")  # 0.15, not 0.15000000000000002


def heat(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey levels through the heat colours, in OpenCV's channel order."""
    at = np.linspace(0, 255, len(HEAT))
    table = [np.interp(np.arange(256), at, channel) for channel in zip(*HEAT, strict=True)]
    return np.stack(table[::-1], axis=-1).round().astype(np.uint8)[levels]

"""Views of a frame: its levels by colour, a histogram, and a preview."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.drivers.raw import RawFrame
from emmc_rig.model.srgb import codes_of, srgb_of
from emmc_rig.session.brightness import BRIGHT_PERCENTILE

BAYER = ("rggb", "bggr", "grbg", "gbrg")
LETTERS = {"r": "red", "g": "green", "b": "blue"}
BINS = 64
LONGEST_PREVIEW_PX = 1600

Array = NDArray[np.floating]


def colour_planes(frame: RawFrame) -> dict[str, list[NDArray[np.uint16]]]:
    """Return the mosaic's pixels by colour, `(y, x)` for every place in the tile, at one black.

    A tile that is not Bayer counts as grey.
    """
    mosaic = frame.with_one_black().mosaic
    if frame.cfa not in BAYER:
        return {"grey": [mosaic]}
    planes: dict[str, list[NDArray[np.uint16]]] = {name: [] for name in LETTERS.values()}
    for index, letter in enumerate(frame.cfa):
        planes[LETTERS[letter]].append(mosaic[index // 2 :: 2, index % 2 :: 2])
    return planes


def brightest(frame: RawFrame) -> dict[str, float]:
    """Return the level of every colour's 99.9th percentile, 1 at white."""
    return {
        name: max(float(np.percentile(part, BRIGHT_PERCENTILE)) - frame.black_dn for part in parts)
        / frame.span_dn
        for name, parts in colour_planes(frame).items()
    }


def histogram(frame: RawFrame, bins: int = BINS) -> dict[str, NDArray[np.int64]]:
    """Return how many pixels of each colour lie in `bins` steps from black to white."""
    black = frame.black_dn
    limits = (black, max(black + 1, frame.white_level_dn + 1))
    return {
        name: np.sum([np.histogram(part, bins, limits)[0] for part in parts], axis=0)
        for name, parts in colour_planes(frame).items()
    }


Balance = tuple[float, float, float]
AS_READ: Balance = (1.0, 1.0, 1.0)


def white_balance(whiteboard: RawFrame) -> Balance:
    """Return what blue, green and red are multiplied by to make a whiteboard grey; green by 1.

    A colour that reads nothing stays as it is. 1, 1, 1 for a mosaic that is not Bayer.
    """
    planes = colour_planes(whiteboard)
    if "grey" in planes:
        return AS_READ
    light = {
        name: float(np.mean([part.mean() for part in planes[name]])) - whiteboard.black_dn
        for name in planes
    }
    blue, red = (
        float(light["green"] / light[name]) if light[name] > 0 else 1.0 for name in ("blue", "red")
    )
    return blue, 1.0, red


def preview(frame: RawFrame, balance: Balance = AS_READ) -> NDArray[np.uint8]:
    """Return a picture of the frame, (y, x) or (y, x, BGR), brightness as exposed, sRGB gamma.

    A Bayer tile becomes one pixel, its greens averaged. balance: see `white_balance`.
    """
    planes = colour_planes(frame)
    if "grey" in planes:
        linear = planes["grey"][0].astype(np.float32)
    else:
        rows = min(part.shape[0] for parts in planes.values() for part in parts)
        columns = min(part.shape[1] for parts in planes.values() for part in parts)
        linear = np.stack(
            [
                np.mean([part[:rows, :columns] for part in planes[name]], axis=0, dtype=np.float32)
                for name in ("blue", "green", "red")
            ],
            axis=-1,
        )
    linear = (linear - frame.black_dn) / frame.span_dn
    linear = np.clip(linear * np.asarray(balance if linear.ndim == 3 else 1, np.float32), 0, 1)
    scale = LONGEST_PREVIEW_PX / max(linear.shape[:2])
    if scale < 1:
        linear = cv2.resize(linear, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return srgb_codes(np.asarray(linear, np.float32))


def srgb_codes(linear: Array) -> NDArray[np.uint8]:
    """Return linear light in [0, 1] (any shape) as 8 bits for a display (IEC 61966-2-1).

    By a table of 16-bit light, and so within a code of the exact one.
    """
    return _display_codes()[codes_of(linear, 16)]


@cache
def _display_codes() -> NDArray[np.uint8]:
    return codes_of(srgb_of(np.linspace(0, 1, 1 << 16, dtype=np.float32)))

"""A frame as a browser shows it: a part of it, as the mosaic or in colour, encoded.

A large frame is first averaged over whole colour tiles: each pixel shown is the mean of its tiles,
which needs no demosaicing.
"""

from __future__ import annotations

from functools import cache
from typing import Literal

import cv2
import numpy as np
from numba import prange
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.model.compiling import njit
from emmc_rig.model.settings import Settings
from emmc_rig.report.frame_view import BAYER, srgb_codes

LONGEST_PX = 1600
SMALLEST_PART = 1 / 256
BRIGHTEST = 0.999
SATURATED_BGR = (60, 60, 255)
CLIPPED_BGR = (255, 90, 60)
SATURATED, CLIPPED = np.array(SATURATED_BGR, np.uint8), np.array(CLIPPED_BGR, np.uint8)
BRIGHTNESS_PX = 200
"""Longest side of the picture by which a larger one is brightened."""
QUALITY = 88
CODES = 1 << 14
"""Steps of linear light in the table of sRGB codes: the darkest code is four of them wide."""
FROM_BAYER = {cfa: getattr(cv2, f"COLOR_Bayer{cfa.upper()}2BGR") for cfa in BAYER}


class View(Settings):
    """What part of a frame, and how.

    x, y: the part's centre, and part: its width, as shares of the frame's. px: the longest side of
    the picture made. marked: saturated pixels in red, those clipped at 0 in blue.
    bright: the brightest thousandth of the part becomes white.
    """

    kind: Literal["mosaic", "colour"] = "colour"
    x: float = Field(default=0.5, ge=0, le=1)
    y: float = Field(default=0.5, ge=0, le=1)
    part: float = Field(default=1.0, ge=SMALLEST_PART, le=1)
    px: int = Field(default=LONGEST_PX, ge=16, le=LONGEST_PX)
    marked: bool = True
    bright: bool = False


def window(view: View, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of a frame of that shape; both start at whole tiles."""
    cuts = []
    for centre, length in ((view.y, shape[0]), (view.x, shape[1])):
        wanted = min(length, max(2, round(view.part * length / 2) * 2))
        start = min(max(0, round(centre * length - wanted / 2)), length - wanted) // 2 * 2
        cuts.append(slice(start, start + wanted))
    return cuts[0], cuts[1]


def picture(frame: RawFrame, view: View) -> NDArray[np.uint8]:
    """Return the picture (y, x, BGR): brightness as exposed, sRGB gamma, no white balance."""
    frame = frame.with_one_black()
    rows, columns = window(view, frame.mosaic.shape)
    mosaic = frame.mosaic[rows, columns]
    black, span = frame.black_dn, frame.span_dn
    step = -(-max(mosaic.shape) // (2 * view.px))
    if step > 1 or max(mosaic.shape) >= 2 * view.px:
        mixing = _mixing(frame.cfa if view.kind == "colour" else "")
        if view.bright:
            few = view.model_copy(update={"px": BRIGHTNESS_PX, "bright": False})
            codes = picture(frame, few).max(axis=2)
            # The least linear light of the brightest code there is, so that it becomes white.
            brightest = np.searchsorted(_srgb_table(), np.quantile(codes, BRIGHTEST)) / CODES
            span *= max(1 / span, float(brightest))
        white = frame.white_level_dn if view.marked else 1 << 16
        gain = (CODES - 1) / (step * step * span)
        offset = -black * (CODES - 1) / span
        return _averaged(mosaic, step, white, mixing, gain, offset, _srgb_table(), view.marked)
    code = FROM_BAYER.get(frame.cfa) if view.kind == "colour" else None
    if code is not None and min(mosaic.shape) >= 4:
        seen = cv2.cvtColor(np.ascontiguousarray(mosaic), code)
    else:
        seen = np.repeat(mosaic[..., None], 3, axis=2)
    linear = np.clip((seen.astype(np.float32) - np.float32(black)) / np.float32(span), 0, 1)
    if view.bright:
        linear = np.clip(linear / max(1 / span, float(np.quantile(linear, BRIGHTEST))), 0, 1)
    scale = view.px / max(mosaic.shape)
    shown = _srgb_table()[(_resized(linear, scale) * np.float32(CODES - 1)).astype(np.uint16)]
    if view.marked:
        saturated, clipped = mosaic >= frame.white_level_dn, mosaic == 0
        for where, colour in ((saturated, SATURATED_BGR), (clipped, CLIPPED_BGR)):
            # Any pixel of a spot, not their mean: a single saturated pixel in a frame is seen.
            shown[_resized(where.astype(np.float32), scale) > 0] = colour
    return shown


@cache
def _srgb_table() -> NDArray[np.uint8]:
    return srgb_codes(np.linspace(0, 1, CODES, dtype=np.float32))


def _mixing(cfa: str) -> NDArray[np.float32]:
    """Return what turns the four means of a tile into BGR, (4, 3); grey for an unknown tile."""
    if cfa not in BAYER:
        return np.full((4, 3), 0.25, np.float32)
    mixing = np.array([[letter == own for own in "bgr"] for letter in cfa], np.float32)
    return mixing / mixing.sum(axis=0)


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _averaged(mosaic, step, white, mixing, gain, offset, table, marked):
    """Return the picture (y, x, BGR) of a mosaic averaged over step x step tiles.

    mixing: see `_mixing`. gain, offset: from the sum of a tile's pixels of one place, mixed, to an
    entry of table. marked: SATURATED_BGR where any of the pixels reaches white, CLIPPED_BGR where
    any is 0: one saturated pixel in a large frame is seen.
    """
    rows, columns = mosaic.shape[0] // (2 * step), mosaic.shape[1] // (2 * step)
    shown = np.empty((rows, columns, 3), np.uint8)
    last = len(table) - 1
    for row in prange(rows):
        sums = np.zeros((columns, 4), np.uint32)
        most, least = np.zeros(columns, np.uint16), np.full(columns, 1, np.uint16)
        for part in range(2 * step):
            line = mosaic[2 * step * row + part]
            first = 2 * (part % 2)
            for column in range(columns):
                at = 2 * step * column
                for pair in range(step):
                    left, right = line[at + 2 * pair], line[at + 2 * pair + 1]
                    sums[column, first] += left
                    sums[column, first + 1] += right
                    most[column] = max(most[column], left, right)
                    least[column] = min(least[column], left, right)
        for column in range(columns):
            for c in range(3):
                seen = 0.0
                for place in range(4):
                    seen += mixing[place, c] * sums[column, place]
                code = int(seen * gain + offset)
                shown[row, column, c] = table[min(max(code, 0), last)]
            if marked and least[column] == 0:
                shown[row, column] = CLIPPED
            elif marked and most[column] >= white:
                shown[row, column] = SATURATED
    return shown


def encoded(shown: NDArray[np.uint8]) -> bytes:
    """Return a picture as JPEG bytes."""
    ok, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not ok:
        raise AppError("the picture cannot be encoded")
    return data.tobytes()


def _resized(linear: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    if scale < 1:
        smaller = cv2.resize(linear, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return np.asarray(smaller, np.float32)
    whole = max(1, int(scale))
    return linear.repeat(whole, axis=0).repeat(whole, axis=1) if whole > 1 else linear

"""A frame as a browser shows it: a part of it, as the mosaic or in colour, encoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.pages.frame_view import BAYER, srgb_codes

Kind = Literal["mosaic", "colour"]
KINDS = get_args(Kind)
LONGEST_PX = 1600
SMALLEST_PART = 1 / 256
BRIGHTEST = 0.999
SATURATED_BGR = (60, 60, 255)
CLIPPED_BGR = (255, 90, 60)
FROM_BAYER = {cfa: getattr(cv2, f"COLOR_Bayer{cfa.upper()}2BGR") for cfa in BAYER}


@dataclass(frozen=True)
class View:
    """What part of a frame, and how.

    x, y: the part's centre, and part: its width, as shares of the frame's. longest_px: of the
    picture made. marked: saturated pixels in red, those clipped at 0 in blue.
    bright: the brightest thousandth of the part becomes white.
    """

    kind: Kind = "colour"
    x: float = 0.5
    y: float = 0.5
    part: float = 1.0
    longest_px: int = LONGEST_PX
    marked: bool = True
    bright: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise AppError(f"no view {self.kind!r}: choose one of {', '.join(KINDS)}")
        if not all(0 <= value <= 1 for value in (self.x, self.y)):
            raise AppError("the centre of a view lies outside the frame: give x, y from 0 to 1")
        if not SMALLEST_PART <= self.part <= 1:
            raise AppError(f"a view of {self.part:g} of the frame: give {SMALLEST_PART:g} to 1")
        if not 16 <= self.longest_px <= LONGEST_PX:
            raise AppError(f"a picture of {self.longest_px} pixels: ask for 16 to {LONGEST_PX}")


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
    rows, columns = window(view, frame.mosaic.shape)
    mosaic = frame.mosaic[rows, columns]
    black = float(frame.black_level_dn.mean())
    span = max(1.0, frame.white_level_dn - black)
    code = FROM_BAYER.get(frame.cfa) if view.kind == "colour" else None
    if code is not None and min(mosaic.shape) >= 4:
        seen = cv2.cvtColor(np.ascontiguousarray(mosaic), code)
    else:
        seen = np.repeat(mosaic[..., None], 3, axis=2)
    linear = np.clip((seen.astype(np.float32) - black) / span, 0, 1)
    if view.bright:
        linear = np.clip(linear / max(1 / span, float(np.quantile(linear, BRIGHTEST))), 0, 1)
    scale = view.longest_px / max(mosaic.shape)
    shown = srgb_codes(_resized(linear, scale))
    if view.marked:
        # The most of each spot, not the mean: one saturated pixel in a large frame is seen.
        for where, colour in (
            (mosaic >= frame.white_level_dn, SATURATED_BGR),
            (mosaic == 0, CLIPPED_BGR),
        ):
            shown[_any(where, shown.shape[:2])] = colour
    return shown


def encoded(shown: NDArray[np.uint8]) -> bytes:
    """Return a picture as JPEG bytes."""
    ok, data = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 90])
    if not ok:
        raise AppError("the picture cannot be encoded")
    return data.tobytes()


def _resized(linear: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    if scale < 1:
        smaller = cv2.resize(linear, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        return np.asarray(smaller, np.float32)
    whole = max(1, int(scale))
    return linear.repeat(whole, axis=0).repeat(whole, axis=1) if whole > 1 else linear


def _any(where: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask at a picture's size: true where any of the pixels there is."""
    if where.shape == shape:
        return where
    if shape[0] > where.shape[0]:
        factors = shape[0] // where.shape[0], shape[1] // where.shape[1]
        return where.repeat(factors[0], axis=0).repeat(factors[1], axis=1)
    area = cv2.resize(where.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)
    return area > 0

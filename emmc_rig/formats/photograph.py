"""A photograph as linear light: pictures of 8 or 16 bits, and RAW files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.drivers.errors import RawFrameError
from emmc_rig.drivers.raw import RAW_SUFFIXES, decode_raw
from emmc_rig.errors import AppError
from emmc_rig.model.decoding.pictures import orientation_in, upright
from emmc_rig.model.decoding.regular import file_bytes
from emmc_rig.model.decoding.stored import light_of, read_codes
from emmc_rig.model.srgb import linear_of

DEMOSAICING = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
}


def read_photograph(path: Path, linear: bool | None = None) -> NDArray[np.float32]:
    """Return a photograph's light, (y, x, colour) with one colour or three, 1 where saturated.

    linear: whether a picture's codes are proportional to light, else they are sRGB; None: those of
    8 bits are sRGB. RAW files are linear; their black level is taken off. Raises AppError.
    """
    if path.suffix.lower() in RAW_SUFFIXES:
        content = file_bytes(path, AppError)
        return upright(_raw_light(content, path), orientation_in(content))
    codes, full_scale = read_codes(path, AppError)
    values = light_of(codes, full_scale)
    values = values[..., :1] if codes.ndim == 2 else values
    if not (values.min() >= 0 and values.max() <= 1):
        raise AppError(f"{path}: values outside 0 (black) to 1 (white), or no numbers: scale them")
    if linear is None:
        linear = full_scale != 255
    return np.asarray(values if linear else linear_of(values), np.float32)


def _raw_light(content: bytes, path: Path) -> NDArray[np.float32]:
    try:
        frame = decode_raw(content)
    except RawFrameError as fault:
        raise AppError(f"{path}: {fault}") from fault
    if frame.cfa not in ("mono", *DEMOSAICING):
        raise AppError(f"{path}: a sensor with the colour tile {frame.cfa}; develop it as a TIFF")
    black = frame.black_by_place()
    light = np.clip((frame.mosaic - black) / (frame.white_level_dn - black), 0, 1)
    if frame.cfa == "mono":
        return np.atleast_3d(light.astype(np.float32))
    codes = np.rint(light * 65535).astype(np.uint16)
    return np.asarray(cv2.cvtColor(codes, DEMOSAICING[frame.cfa]), np.float32) / np.float32(65535)

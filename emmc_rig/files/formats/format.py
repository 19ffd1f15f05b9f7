"""What a format of light fields is: one object that writes, reads and says what it keeps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Export:
    """What is written: a light field (v, u, y, x, c), linear, in [0, 1], and its maps if any.

    disparity: (y, x) of the centre view, pixels per view step. sigma: standard deviation
    (v, u, y, x). model, misfit: (y, x), see `emmc_rig.pages.viewer`. truth: as light_field.
    """

    title: str
    caption: str
    light_field: Array
    truth: Array | None = None
    disparity: Array | None = None
    sigma: Array | None = None
    model: NDArray | None = None
    misfit: Array | None = None


@dataclass(frozen=True)
class Format:
    """One format that others read.

    name: as typed after --format. title: what it is. keeps: what survives. write: an export into
    an existing folder. holds: whether a path is of this format, and read: that path as a light
    field; None where it cannot be a scene.
    """

    name: str
    title: str
    keeps: str
    write: Callable[[Path, Export], None]
    holds: Callable[[Path], bool] | None = None
    read: Callable[[Path], Array] | None = None


def srgb_of(linear: Array) -> NDArray[np.float32]:
    """Return sRGB values of linear ones: 1 is white, what is beyond is clipped. IEC 61966-2-1."""
    light = np.clip(linear, 0, 1).astype(np.float32)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def linear_of(srgb: Array) -> NDArray[np.float32]:
    """Return linear values of sRGB ones in [0, 1]; undoes `srgb_of`."""
    value = np.asarray(srgb, np.float32)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def codes_of(values: Array, bits: int = 8) -> NDArray:
    """Return values in [0, 1] as codes of 8 or 16 bits."""
    full = 2**bits - 1
    return np.rint(np.clip(values, 0, 1) * full).astype(np.uint8 if bits == 8 else np.uint16)


def write_picture(path: Path, rgb: NDArray) -> None:
    """Write a picture (y, x, 3) or (y, x) in the format of its ending; raises AppError."""
    ordered = np.ascontiguousarray(rgb[..., ::-1]) if rgb.ndim == 3 else rgb
    done, data = cv2.imencode(path.suffix, ordered)
    if not done:
        raise AppError(f"{path}: OpenCV cannot write {path.suffix}")
    path.write_bytes(data.tobytes())

"""sRGB values and picture codes of linear light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


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

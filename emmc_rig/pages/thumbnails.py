"""Small pictures of light fields for the points of a chart, stored as WebP."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.files import whole_file
from emmc_rig.pages.pictures import pictures_of

LARGEST_PX = 256


def save_thumbnail(path: Path, light_field: NDArray, lines: tuple[int, int]) -> None:
    """Write the centre view over an epipolar image; lines: see `epipolar_lines`. Raises OSError."""
    done, data = cv2.imencode(".webp", composed(light_field, lines), [cv2.IMWRITE_WEBP_QUALITY, 90])
    assert done
    with whole_file(path) as partial:
        partial.write_bytes(data.tobytes())


def composed(light_field: NDArray, lines: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the centre view over the epipolar image of its most telling row, as 8-bit BGR.

    Light is shown with the display's gamma; pixels are repeated, never blurred.
    """
    pictures = pictures_of(light_field, lines)
    height, width = pictures.centre.shape[:2]
    left = max(0, (width - LARGEST_PX) // 2)
    top = min(max(0, lines[0] - LARGEST_PX // 2), max(0, height - LARGEST_PX))
    across = slice(left, left + LARGEST_PX)
    view = pictures.centre[top : top + LARGEST_PX, across]
    scale = max(1, round(320 / view.shape[1]))
    view = view.repeat(scale, axis=0).repeat(scale, axis=1)
    epi = pictures.across[:, across].repeat(8, axis=0).repeat(scale, axis=1)
    gap = np.ones((6, view.shape[1], 3), dtype=view.dtype)
    stacked = np.clip(np.concatenate([view, gap, epi]), 0, 1) ** (1 / 2.2)
    return np.ascontiguousarray(np.rint(stacked[..., ::-1] * 255).astype(np.uint8))

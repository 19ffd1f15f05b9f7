"""A mask on a light table, photographed by a camera that stands a little aside: 16 linear bits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

PX_PER_CELL, FRAME_PX, BLUR_PX = 8, 60, 1.0
CLEAR_DN, BLACK_DN, NOISE_DN = 40_000, 500, 200


def photographed(cells: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return a photograph, (y, x), of a mask's transmittances (row, column) in a dark frame."""
    drawn = np.pad(np.kron(cells, np.ones((PX_PER_CELL, PX_PER_CELL))), FRAME_PX)
    bottom, right = drawn.shape
    corners = np.array([(0, 0), (right, 0), (right, bottom), (0, bottom)], np.float32)
    moved = np.array([(9, 12), (-18, 5), (-7, -14), (5, -4)], np.float32)
    aside = cv2.getPerspectiveTransform(corners, corners + moved)
    sharp = cv2.warpPerspective(drawn, aside, (right, bottom))
    light = CLEAR_DN * cv2.GaussianBlur(sharp, (0, 0), BLUR_PX)
    noisy = light + BLACK_DN + rng.normal(0, NOISE_DN, light.shape)
    return np.clip(noisy, 0, 65_535).astype(np.uint16)

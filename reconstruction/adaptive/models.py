"""Which model each place got: the smallest that its readings speak for."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.adaptive.joint import Scene
from reconstruction.adaptive.search import Volume

MODELS = ("flat", "plane", "slanted", "two layers", "free")
"""Even colour; texture at one disparity; at a changing one; partly hidden; no surface."""
SLANTED_PX = 0.01
"""Change of the disparity per pixel beyond which a surface counts as slanted."""
NEAR_PX = 2
"""Samples around a hidden ray that see two layers."""


def texture_map(volume: Volume, size: tuple[int, int], binning: int) -> NDArray[np.uint8]:
    """Return the kind of texture, as TexturePrior counts them, of the patch next to each sample."""
    nearest = [
        np.abs(((np.arange(length) + 0.5) / binning - 0.5)[:, None] - at[None]).argmin(axis=1)
        for at, length in zip(volume.centres, size, strict=True)
    ]
    return volume.kind[np.ix_(*nearest)].astype(np.uint8)


def model_map(texture: NDArray[np.uint8], scene: Scene) -> NDArray[np.uint8]:
    """Return the index in MODELS of every sample of the centre view, (y, x), of surfaces.

    texture: see `texture_map`.
    """
    textured = texture > 0
    down, right = np.gradient(scene.centre)
    slope = cv2.GaussianBlur(np.hypot(down, right).astype(np.float32), (0, 0), 3.0)
    around = np.ones((2 * NEAR_PX + 1,) * 2, np.uint8)
    layered = cv2.dilate(scene.surfaces.hidden.max(axis=(0, 1)), around) > 0
    chosen = np.where(textured, np.where(slope > SLANTED_PX, 2, 1), 0)
    chosen[layered] = 3
    return chosen.astype(np.uint8)

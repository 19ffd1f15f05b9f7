"""The light field of one textured plane."""

import cv2
import numpy as np

from emmc_rig.reconstruction.adaptive.rays import Surfaces


def textured(size, seed=0, detail=1.5):
    """A picture (c, y, x) of smooth blobs in related colours, flat at the left, in [0, 1]."""
    rng = np.random.default_rng(seed)
    grey = cv2.GaussianBlur(rng.normal(size=size), (0, 0), detail)
    tint = cv2.GaussianBlur(rng.normal(size=(*size, 3)), (0, 0), 2 * detail)
    blobs = 0.18 * (grey / grey.std())[..., None] + 0.05 * tint / tint.std()
    picture = 0.5 + (np.arange(size[1]) > 18)[:, None] * blobs
    return np.moveaxis(np.clip(picture, 0, 1), -1, 0).astype(np.float32)


def plane_scene(psi, disparity, seed=0):
    """The light field of one plane, and its texture padded by a margin."""
    views = psi.light_field_shape[:2]
    margin = int(np.ceil(abs(disparity) * (max(views) // 2))) + 4
    rays = np.full((*views, *psi.size), disparity, dtype=np.float32)
    surfaces = Surfaces(psi, rays, np.zeros(rays.shape, np.uint8), margin)
    picture = textured(surfaces.texture_shape[1:], seed)
    return np.clip(surfaces.light_field(picture), 0, 1), surfaces

"""What to expect of a camera before it is built: error, bound of disparity, light; from Psi alone.

The error is that of textures on two surfaces half a sample of disparity apart, averaged over the
disparities to be seen (see `periodic`). It orders the default method's PSNR: rank
correlation 0.93 over 13 cameras with the mean of four scenes of group A, 96x96
(benchmarks/design_check.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emmc_rig.model.camera import Camera, pixel_light
from emmc_rig.model.geometry import fresnel_number
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.study.design.periodic import SIDE, Block, SceneTexture
from emmc_rig.study.design.ziv_zakai import ziv_zakai

APART_PX = 0.5
"""Between the two surfaces, samples of disparity."""
PLACES = 3
"""Disparities of the nearer surface, evenly over what is to be seen."""
GRID = 9
"""Disparities between which the Ziv-Zakai bound decides."""
BRIGHTNESS = 0.35
"""Mean of the real scenes tuned on."""
SIZE = (2 * SIDE, 2 * SIDE)
CORNERS = ((0, 0), (SIDE, SIDE))
"""Of the blocks that stand for the picture: a random mask differs from place to place."""
TEXTURE = SceneTexture()


@dataclass(frozen=True)
class Expected:
    """What theory says of a camera.

    psnr_db: expected, of two surfaces. light: what passes of the open camera's. fresnel: the least
    of its masks', infinite without one before the lens.
    """

    psnr_db: float
    light: float
    fresnel: float


@dataclass(frozen=True)
class Bounds:
    """known_db: PSNR of one surface of known disparity. disparity_px: root of Ziv-Zakai's bound."""

    known_db: float
    disparity_px: float


def expected(camera: Camera, psi: ImagingMatrix, disparities_px: tuple[float, float]) -> Expected:
    """Return what to expect of a camera with this Psi, of SIZE; see `printed.printed_psi`.

    Raises ReconstructionError for pixels of several samples.
    """
    low, high = disparities_px
    apart = min(APART_PX, high - low)
    near = np.linspace(low, high - apart, PLACES)
    errors = [block.error(d, d + apart, TEXTURE) for block in _blocks(camera, psi) for d in near]
    return Expected(_psnr_db(errors), psi.light_efficiency(), least_fresnel(camera))


def bounds(camera: Camera, psi: ImagingMatrix, disparities_px: tuple[float, float]) -> Bounds:
    """Return what bounds estimates through a camera with this Psi; raises as `expected` does."""
    blocks = _blocks(camera, psi)
    grid = np.linspace(*disparities_px, GRID)
    errors = [block.error(d, d, TEXTURE) for block in blocks for d in grid[:: GRID // 2]]
    found = [ziv_zakai(grid, block.distances(grid.tolist(), TEXTURE)) for block in blocks]
    return Bounds(_psnr_db(errors), math.sqrt(np.mean(found)))


def _blocks(camera: Camera, psi: ImagingMatrix) -> list[Block]:
    light = pixel_light(camera, psi.size)
    grey = np.full(psi.light_field_shape, BRIGHTNESS, dtype=np.float32)
    exposures_s = camera.exposures_s()[:, None, None]
    variance = camera.sensor.noise.variance(psi.forward(grey), exposures_s, light)
    return [Block.of(psi, variance, corner) for corner in CORNERS]


def _psnr_db(errors: list[float]) -> float:
    return -10 * math.log10(float(np.mean(errors)))


def least_fresnel(camera: Camera) -> float:
    """Return the least Fresnel number of a camera's masks before the lens."""
    return min(
        (
            fresnel_number(mask.cell_um, mask.distance_mm)
            for mask in camera.masks.values()
            if mask.distance_mm < camera.lens.distance_mm
        ),
        default=math.inf,
    )

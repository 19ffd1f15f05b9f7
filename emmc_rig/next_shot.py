"""How many shots a scene needs, and which: mask positions chosen by expected error, simulated.

After every shot the scene is reconstructed; the error expected of each further mask position
(`reconstruction.adaptive.planning`) chooses the next, and the deviation that the reconstruction
states says when to stop. A fixed sequence is taken beside it, on the same scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, build_imaging_matrix, pixel_light
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.scene import open_scene
from reconstruction.adaptive.planning import expected_errors
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.result import Reconstruction

POSITIONS = 8
"""Mask positions to choose from, as multiples of the camera's step for further shots."""


@dataclass(frozen=True)
class ShotRow:
    """What is known after a shot. positions: of the masks so far, in steps. stated_db: the PSNR
    that the deviation stands for; psnr_db: against the truth; fixed_db: that of positions in order.
    """

    shots: int
    positions: tuple[int, ...]
    stated_db: float
    psnr_db: float
    fixed_db: float

    def as_dict(self) -> dict[str, object]:
        """Return the row."""
        return asdict(self)


def stated_psnr_db(result: Reconstruction) -> float:
    """Return the PSNR that a result's own deviation stands for.

    Raises AppError when the method states none.
    """
    if "sigma" not in result.maps:
        raise AppError(f"'{result.method}' states no deviation: use the method adaptive")
    return float(-10 * np.log10(np.mean(np.square(result.maps["sigma"], dtype=np.float64))))


def camera_at(camera: Camera, positions: Sequence[int]) -> Camera:
    """Return a camera that takes its first shot with the masks at several positions, in steps."""
    steps = camera.more_shots_step_um
    if not steps:
        raise AppError(
            f"'{camera.title}' has no 'more_shots_step_um': no other mask position known"
        )
    first = camera.shots[0]
    shots = []
    for position in positions:
        offsets = dict(first.offset_um)
        for name, (dx, dy) in steps.items():
            x, y = first.offset_um.get(name, (0.0, 0.0))
            offsets[name] = (x + position * dx, y + position * dy)
        shots.append(first.model_copy(update={"offset_um": offsets}))
    return camera.model_copy(update={"shots": tuple(shots)})


def _taken(
    camera: Camera, psi: ImagingMatrix, light_field: NDArray[np.float32], seed: int
) -> tuple[NDArray[np.float32], float, NDArray[np.bool_]]:
    """Return readings, their typical deviation and which are usable, of a capture by a camera."""
    noise, light = camera.sensor.noise, pixel_light(camera, psi.size)
    exposures_s = camera.exposures_s()[:, None, None]
    frames_dn = noise.expose_dn(
        psi.forward(light_field), exposures_s, light, np.random.default_rng(seed)
    )
    usable = ~noise.saturated(frames_dn) & (light > 0)
    readings = noise.normalise(frames_dn, exposures_s, light)
    variance = noise.variance(readings, exposures_s, light)
    return readings, float(np.sqrt(variance[usable].mean())), usable


def shot_plan(
    scene: str, camera: Camera, size: tuple[int, int], target_db: float, most: int, seed: int
) -> Iterator[ShotRow]:
    """Yield a row after each shot, until the stated PSNR reaches the target or `most` shots."""
    truth = open_scene(scene, size=size, views=camera.views, seed=seed).light_field

    def captured(positions: Sequence[int]) -> tuple[Reconstruction, float, float]:
        described = camera_at(camera, positions)
        psi = build_imaging_matrix(described, size)
        readings, sigma, usable = _taken(described, psi, truth, seed)
        result = reconstruct("adaptive", psi, readings, sigma, None, MethodSettings(), usable)
        return result, psnr_db(result.light_field, truth), sigma

    positions = [0]
    while True:
        result, achieved, sigma = captured(positions)
        fixed = achieved
        if positions != list(range(len(positions))):
            fixed = captured(range(len(positions)))[1]
        stated = stated_psnr_db(result)
        yield ShotRow(len(positions), tuple(positions), stated, achieved, fixed)
        if stated >= target_db or len(positions) >= most:
            return
        free = [p for p in range(1, POSITIONS + 1) if p not in positions]
        psis = [build_imaging_matrix(camera_at(camera, [*positions, p]), size) for p in free]
        middle = result.light_field[camera.views[0] // 2, camera.views[1] // 2]
        errors = expected_errors(
            psis, result.maps["disparity"], result.maps["texture"], middle.mean(axis=-1), sigma**2
        )
        positions.append(free[int(errors.argmin())])

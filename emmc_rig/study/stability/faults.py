"""The faults by name, from FAULTS of each module of a kind, and the trial of one."""

from __future__ import annotations

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.model.errors import CameraError, nearest_of
from emmc_rig.study.stability import (
    design_faults,
    mask_faults,
    scene_faults,
    sensor_faults,
    shot_faults,
)
from emmc_rig.study.sweep import NotApplicableError
from emmc_rig.study.trial import Fault, Setup, Trial, trial_of

KINDS = (sensor_faults, mask_faults, shot_faults, scene_faults, design_faults)
FAULTS = {fault.name: fault for module in KINDS for fault in module.FAULTS}


def find_fault(name: str) -> Fault:
    """Return a fault by name; raises AppError naming the nearest."""
    if name in FAULTS:
        return FAULTS[name]
    raise AppError(f"--fault {name}: {nearest_of(name, FAULTS)}")


def trial(
    fault: Fault,
    strength: float,
    scene: str,
    camera: Camera,
    size: tuple[int, int] | None = None,
    seed: int = 0,
    zoom: int = 1,
) -> Trial:
    """Return what a method gets from a capture with a fault of some strength, and the truth.

    scene, size, zoom: see `Setup`. The readings are made by the true Psi with the sensor's noise;
    Psi, noise level and usable pixels are those given to the method. Raises NotApplicableError
    where the fault does not apply to the scene or the camera, and what the layers below do.
    """
    setup = Setup(scene, camera_for(fault, camera), size, seed, zoom)
    if fault.is_clean(strength):
        return trial_of(setup)
    return fault.make(setup, strength)


def camera_for(fault: Fault, camera: Camera) -> Camera:
    """Return the camera, with as many shots as a fault takes.

    Raises NotApplicableError where the camera has no rule for more.
    """
    if len(camera.shots) >= fault.shots:
        return camera
    try:
        return camera.with_shots(fault.shots)
    except CameraError as wrong:
        raise NotApplicableError(str(wrong)) from wrong

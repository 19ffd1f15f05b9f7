"""The faults by name: unit, strengths from harmless to hopeless, and what one trial of it is."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.model.errors import CameraError
from emmc_rig.study.stability import (
    design_faults,
    mask_faults,
    scene_faults,
    sensor_faults,
    shot_faults,
)
from emmc_rig.study.stability.trial import Setup, Trial, taken
from emmc_rig.study.sweep import NotApplicableError

SEVERAL = 3
"""Shots that a camera is given where a fault needs several."""


SENSOR, MASK, SHOTS = "Light and sensor", "Mask and lens", "Between shots"
SCENE, DESIGN = "Scene", "Design"


@dataclass(frozen=True)
class Fault:
    """One way to fail.

    strengths: from harmless to hopeless, in `unit`; a sweep is judged on both sides of its best,
    as a design has two ends. quick: those that `--fast` measures. repairable: whether better
    calibration, detection or repair could undo it, rather than physics or the design setting the
    limit. screened: whether screening the frames is meant to help. shots: fewest that it takes.
    whole: whether there is nothing between two strengths. clean: whether strength 0 is no fault.
    """

    name: str
    title: str
    unit: str
    strengths: tuple[float, ...]
    quick: tuple[float, ...]
    kind: str
    make: Callable[[Setup, float], Trial]
    repairable: bool = False
    screened: bool = False
    shots: int = 1
    whole: bool = False
    clean: bool = True

    def is_clean(self, strength: float) -> bool:
        """Whether nothing is wrong at a strength: the trial is then that of any other fault."""
        return self.clean and strength == 0

    @property
    def explained(self) -> str:
        """What happens, in one sentence."""
        return (self.make.__doc__ or "").strip().partition("\n")[0]


FAULTS = {
    fault.name: fault
    for fault in (
        Fault(
            "exposure", "Exposure", "electrons at white",
            (50_000, 15_500, 5_000, 1_500, 500, 150, 50, 15, 5), (15_500, 500, 50, 5),
            SENSOR, sensor_faults.exposure,
        ),
        Fault(
            "read-noise", "Read noise", "electrons",
            (0, 30, 100, 300, 1_000, 3_000), (0, 100, 1_000, 3_000),
            SENSOR, sensor_faults.read_noise,
        ),
        Fault(
            "saturation", "Saturation", "% of readings",
            (0, 1, 5, 10, 20, 40, 60, 80), (0, 10, 40, 80),
            SENSOR, sensor_faults.saturation,
        ),
        Fault(
            "bad-pixels", "Bad pixels, not told", "% of pixels",
            (0, 0.1, 0.3, 1, 3, 10, 30), (0, 0.3, 3, 20),
            SENSOR, sensor_faults.bad_pixels, repairable=True, screened=True,
        ),
        Fault(
            "masked-pixels", "Bad pixels, masked", "% of pixels",
            (0, 1, 3, 10, 30, 60, 90), (0, 10, 40, 80),
            SENSOR, sensor_faults.masked_pixels,
        ),
        Fault(
            "mask-shift", "Mask shift", "px",
            (0, 0.05, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.25, 1, 4),
            MASK, mask_faults.shift, repairable=True,
        ),
        Fault(
            "mask-rotation", "Mask rotation", "degrees",
            (0, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.5, 2, 8),
            MASK, mask_faults.rotation, repairable=True,
        ),
        Fault(
            "mask-distance-error", "Error of the mask's distance", "%",
            (0, 5, 10, 25, 50, 100, 200), (0, 10, 50, 200),
            MASK, mask_faults.distance, repairable=True,
        ),
        Fault(
            "mask-scale", "Error of the mask's scale", "%",
            (0, 0.1, 0.25, 0.5, 1, 2, 5, 10), (0, 0.5, 2, 10),
            MASK, mask_faults.scale, repairable=True,
        ),
        Fault(
            "edge-blur", "Blur of the mask's edges", "px",
            (0, 0.1, 0.2, 0.35, 0.5, 0.75, 1, 2), (0, 0.2, 0.5, 2),
            MASK, mask_faults.edge_blur, repairable=True,
        ),
        Fault(
            "vignetting", "Vignetting", "% lost by the outermost ray",
            (0, 5, 10, 20, 40, 60, 80, 95), (0, 10, 40, 90),
            MASK, mask_faults.vignetting, repairable=True,
        ),
        Fault(
            "flicker", "Lamp flicker between shots", "%",
            (0, 1, 2, 5, 10, 20, 40, 80), (0, 2, 10, 40),
            SHOTS, shot_faults.flicker, repairable=True, screened=True, shots=SEVERAL,
        ),
        Fault(
            "scene-motion", "Scene motion", "px a shot",
            (0, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.5, 2, 8),
            SHOTS, shot_faults.scene_motion, repairable=True, shots=SEVERAL,
        ),
        Fault(
            "camera-motion", "Camera motion", "px a shot",
            (0, 0.1, 0.25, 0.5, 1, 2, 4, 8), (0, 0.25, 1, 4),
            SHOTS, shot_faults.camera_motion, repairable=True, shots=SEVERAL,
        ),
        Fault(
            "missing-shot", "Missing shots", "shots",
            (0, 1, 2), (0, 1, 2),
            SHOTS, shot_faults.missing_shot, repairable=True, screened=True, shots=SEVERAL,
            whole=True,
        ),
        Fault(
            "repeated-shot", "Repeated shots", "shots",
            (0, 1, 2), (0, 1, 2),
            SHOTS, shot_faults.repeated_shot, repairable=True, screened=True, shots=SEVERAL,
            whole=True,
        ),
        Fault(
            "disparity-range", "Disparity range", "px per view",
            (0.5, 1, 2, 4, 8, 16, 32), (0.5, 2, 8, 32),
            SCENE, scene_faults.disparity_range,
        ),
        Fault(
            "occlusion", "Occlusion density", "% hidden",
            (0, 5, 10, 20, 40, 60, 80), (0, 10, 30, 60),
            SCENE, scene_faults.occlusion,
        ),
        Fault(
            "specularity", "Specularity", "% mirrored",
            (0, 5, 10, 20, 40, 60, 80), (0, 10, 40, 80),
            SCENE, scene_faults.specularity,
        ),
        Fault(
            "contrast", "Texture contrast", "%",
            (100, 50, 25, 10, 5, 2.5, 1), (100, 25, 5, 1),
            SCENE, scene_faults.contrast,
        ),
        Fault(
            "mask-cell", "Mask cell", "px",
            (0.1, 0.25, 0.5, 1, 1.5, 2, 3, 4, 8, 16, 32, 64), (0.1, 0.5, 1.5, 6, 32),
            DESIGN, design_faults.mask_cell,
        ),
        Fault(
            "mask-distance", "Mask distance", "px of shadow per view",
            (0, 0.125, 0.25, 0.5, 1, 2, 4, 8, 16), (0, 0.25, 1, 4, 16),
            DESIGN, design_faults.mask_distance, clean=False,
        ),
        Fault(
            "shots", "Shots", "shots",
            (6, 4, 3, 2, 1), (4, 2, 1),
            DESIGN, design_faults.shots, whole=True,
        ),
        Fault(
            "views", "Views", "views a side",
            (1, 3, 5, 7), (3, 5, 7),
            DESIGN, design_faults.views, whole=True,
        ),
        Fault(
            "r", "Pixel size, r", "measurements per sample",
            (1, 1 / 4, 1 / 16, 1 / 64), (1, 1 / 4, 1 / 16),
            DESIGN, design_faults.pixel_size, whole=True,
        ),
    )
}  # fmt: skip


def find_fault(name: str) -> Fault:
    """Return a fault by name; raises AppError naming the nearest."""
    if name in FAULTS:
        return FAULTS[name]
    near = difflib.get_close_matches(name, FAULTS, n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise AppError(f"--fault {name}: {hint}known are {', '.join(FAULTS)}")


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
    Psi, noise level and usable pixels are those that the method is told. Raises NotApplicableError
    where the fault cannot befall the scene or the camera, and what the layers below do.
    """
    setup = Setup(scene, camera_for(fault, camera), size, seed, zoom)
    if fault.is_clean(strength):
        return taken(setup)
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

"""What `emmc-rig calibrate` is asked for: camera, size, route, target."""

from __future__ import annotations

from dataclasses import dataclass, field

from calibration.fit import FitSettings
from emmc_rig.calibrate.bench import BenchTruth
from emmc_rig.model.camera import Camera

ROUTES = {
    "auto": ("parametric", "mixed", "free", "combined"),
    "parametric": ("parametric",),
    "mixed": ("parametric", "mixed"),
    "free": ("free",),
}
TARGET = 0.005


@dataclass(frozen=True)
class CalibrateSettings:
    """What to calibrate: camera, size, route (a key of ROUTES); what to plan for.

    target: relative error of Psi. most_frames: of the plan, None: as many as it takes.
    """

    camera_name: str
    camera: Camera
    size: tuple[int, int]
    route: str = "auto"
    target: float = TARGET
    seed: int = 0
    truth: BenchTruth = field(default_factory=BenchTruth)
    fit: FitSettings = field(default_factory=FitSettings)
    map_stage: bool = False
    most_frames: int | None = None

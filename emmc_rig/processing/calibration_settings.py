"""What `emmc-rig calibrate` is asked for: camera, size, route, target."""

from __future__ import annotations

from dataclasses import dataclass, field

from calibration.fit import FitSettings
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.processing.bench import BenchTruth

ROUTES = {
    "auto": ("parametric", "mixed", "free", "combined"),
    "parametric": ("parametric",),
    "mixed": ("parametric", "mixed"),
    "free": ("free",),
}
TARGET = 0.005
WATCHES = {
    "lamp": "open whiteboards between the others, and the reference again at the end",
    "response": "references at several exposures",
    "colours": "references under red, green and blue lamps",
    "turned": "the white board turned by 90 degrees",
}
"""Whiteboards that show errors of other parts than the mask: each may be left out of a plan."""


@dataclass(frozen=True)
class CalibrateSettings:
    """What to calibrate: camera, size, route (a key of ROUTES); what to plan for.

    target: relative error of Psi. most_frames: of the plan, None: as many as it takes. leave_out:
    names of WATCHES that the rig cannot take. few: plan for the fitted mask alone, without the
    pinhole before every view. psnr: measure effects by what they cost a reconstruction, too.
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
    leave_out: frozenset[str] = frozenset()
    few: bool = False
    psnr: bool = False

    def __post_init__(self) -> None:
        for name in sorted(self.leave_out):
            if name not in WATCHES:
                raise AppError(f"--leave-out {name}: use some of {', '.join(WATCHES)}")

"""What `emmc-rig calibrate` is asked for: camera, size, route, target."""

from __future__ import annotations

from dataclasses import dataclass

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from simulators.effects import ORDINARY, Flaws, flawed

ROUTES = {
    "auto": ("parametric", "mixed", "free", "combined"),
    "parametric": ("parametric",),
    "mixed": ("parametric", "mixed"),
    "free": ("free",),
}
TARGET = 0.005
ORDINARY_BENCH = flawed(Flaws(), [ORDINARY])
RAYS_PER_VIEW = 512
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
    pinhole before every view. flaws, rays: what is wrong with a simulated bench, and how many rays
    it traces per view and pixel.
    """

    camera_name: str
    camera: Camera
    size: tuple[int, int]
    route: str = "auto"
    target: float = TARGET
    seed: int = 0
    flaws: Flaws = ORDINARY_BENCH
    rays: int = RAYS_PER_VIEW
    most_frames: int | None = None
    leave_out: frozenset[str] = frozenset()
    few: bool = False

    def __post_init__(self) -> None:
        for name in sorted(self.leave_out):
            if name not in WATCHES:
                raise AppError(f"--leave-out {name}: use some of {', '.join(WATCHES)}")

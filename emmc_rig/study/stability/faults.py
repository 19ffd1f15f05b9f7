"""The faults by name, from FAULTS of each module of a kind, and the trial of one."""

from __future__ import annotations

from dataclasses import dataclass, replace

from emmc_rig.errors import AppError
from emmc_rig.model.errors import nearest_of
from emmc_rig.study.stability import (
    design_faults,
    mask_faults,
    scene_faults,
    sensor_faults,
    shot_faults,
)
from emmc_rig.study.trial import Capture, Fault, Trial, trial_of, with_shots

KINDS = (sensor_faults, mask_faults, shot_faults, scene_faults, design_faults)
FAULTS = {fault.name: fault for module in KINDS for fault in module.FAULTS}


def find_fault(name: str) -> Fault:
    """Return a fault by name; raises AppError naming the nearest."""
    if name in FAULTS:
        return FAULTS[name]
    raise AppError(f"--fault {name}: {nearest_of(name, FAULTS)}")


@dataclass(frozen=True)
class Point:
    """A method on a capture with a fault of some strength; fault None: nothing is wrong.

    screened: whether the frames are screened first. method "": what all methods get.
    """

    capture: Capture
    fault: str | None
    strength: float
    method: str = ""
    screened: bool = True

    @property
    def scene_name(self) -> str:
        """The scene as tables call it."""
        return self.capture.scene_name

    @property
    def condition(self) -> str:
        """What is wrong, in words."""
        if self.fault is None:
            return "nothing wrong"
        fault = FAULTS[self.fault]
        return f"{fault.title} {self.strength:g} {fault.unit}"

    @property
    def label(self) -> str:
        """In words."""
        words = (self.scene_name, self.capture.camera_name, self.condition, self.method)
        return ", ".join(filter(None, words)) + ("" if self.screened else ", not screened")

    @property
    def same_trial(self) -> Point:
        """What all points of one trial have in common; a strength that is no fault is none."""
        if self.fault and FAULTS[self.fault].is_clean(self.strength):
            return Point(enough_shots(self.capture, FAULTS[self.fault]), None, 0.0)
        return replace(self, method="", screened=True)

    def trial(self) -> Trial:
        """Return what a method gets, and the truth.

        The readings are made by the true Psi with the sensor's noise; Psi, noise level and usable
        pixels are those given to the method. Raises NotApplicableError where the fault does not
        apply to the scene or the camera, and what the layers below do.
        """
        if self.fault is None:
            return trial_of(self.capture)
        fault = FAULTS[self.fault]
        capture = enough_shots(self.capture, fault)
        clean = fault.is_clean(self.strength)
        return trial_of(capture) if clean else fault.make(capture, self.strength)


def enough_shots(capture: Capture, fault: Fault) -> Capture:
    """Return the capture, of as many shots as a fault takes.

    Raises NotApplicableError where the camera has no rule for more.
    """
    camera = capture.described
    if len(camera.shots) >= fault.shots:
        return capture
    return replace(capture, camera=with_shots(camera, fault.shots), shots=None, views=None)

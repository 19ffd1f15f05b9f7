"""The faults by name, from FAULTS of each module of a kind, and the trial of one."""

from __future__ import annotations

from dataclasses import dataclass, replace

from emmc_rig.errors import AppError
from emmc_rig.model.errors import nearest_of
from emmc_rig.study.stability import mask_faults, scene_faults, sensor_faults
from emmc_rig.study.stability.fault import Fault
from emmc_rig.study.trial import Capture, Trial, trial_of, with_shots

FAULTS = {
    fault.name: fault
    for module in (sensor_faults, mask_faults, scene_faults)
    for fault in module.FAULTS
}


def find_fault(name: str) -> Fault:
    """Return a fault by name; raises AppError naming the nearest."""
    if name in FAULTS:
        return FAULTS[name]
    raise AppError(f"fault {name}: {nearest_of(name, FAULTS)}")


@dataclass(frozen=True)
class Point:
    """A method on a capture with a fault of some strength; fault None: nothing is wrong.

    method "": what all methods get.
    """

    capture: Capture
    fault: str | None
    strength: float
    method: str = ""

    @property
    def scene_name(self) -> str:
        """The scene as tables call it."""
        return self.capture.scene_name

    @property
    def label(self) -> str:
        """In words."""
        condition = "nothing wrong"
        if self.fault is not None:
            fault = FAULTS[self.fault]
            condition = f"{fault.title} {self.strength:g} {fault.unit}"
        words = (self.scene_name, self.capture.camera_name, condition, self.method)
        return ", ".join(filter(None, words))

    @property
    def same_trial(self) -> Point:
        """The point without its method, equal for all points of a trial; strength 0 is no fault."""
        if self.fault and self.strength == 0:
            return Point(enough_shots(self.capture, FAULTS[self.fault]), None, 0.0)
        return replace(self, method="")

    def trial(self) -> Trial:
        """Return what a method gets, and the truth.

        The readings are made by the true Psi with the sensor's noise; Psi, noise level and usable
        pixels are those given to the method. Raises NotApplicableError where the fault does not
        apply to the scene or the camera, and what the layers below do.
        """
        point = self.same_trial
        if point.fault is None:
            return trial_of(point.capture)
        fault = FAULTS[point.fault]
        return fault.make(enough_shots(point.capture, fault), point.strength)


def enough_shots(capture: Capture, fault: Fault) -> Capture:
    """Return the capture, of as many shots as a fault takes.

    Raises NotApplicableError where the camera has no rule for more.
    """
    camera = capture.described
    if len(camera.shots) >= fault.shots:
        return capture
    return replace(capture, camera=with_shots(camera, fault.shots), shots=None, views=None)

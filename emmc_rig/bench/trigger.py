"""Exposure on the stage's arrival, by a line from its controller to the camera: what is wired."""

from __future__ import annotations

from typing import cast

from pydantic import Field

from drivers.camera import Camera as CameraDevice
from drivers.camera import TriggeredCamera
from drivers.errors import DriverError
from drivers.stage import SignallingStage, Stage
from emmc_rig.errors import AppError
from emmc_rig.model.settings import Settings

LINE_LATENCY_S = 20e-6
"""Of the output, the cable and the camera's input, as opto-isolated ones are specified."""
EDGE_WAIT_S = 1.0
"""The edge comes before the stage says that it has arrived: this only bridges the camera's side."""


class Trigger(Settings):
    """The wire, and how long the camera waits.

    outputs: by axis, which output of its controller rises when it arrives: a number (Zaber),
    coolant, mist or spindle (Grbl). line: the camera's input, as its TriggerSource names it.
    delay_s: waited by the camera after the edge, for the vibration; the stage's `settle_s` is not
    waited for then.
    """

    outputs: dict[str, int | str] = Field(min_length=1)
    line: str = "Line0"
    delay_s: float = Field(default=0.05, ge=0, le=60)


class SimulatedTrigger(Trigger):
    """The wire of the simulated rig, whose camera is a USB3 Vision camera then."""

    latency_s: float = Field(default=LINE_LATENCY_S, ge=0, le=1)


def check_trigger(trigger: Trigger, stage: Stage, camera: CameraDevice) -> None:
    """Raise AppError with one line unless these devices can be wired so; nothing moves."""
    for axis, output in trigger.outputs.items():
        if axis not in stage.axes:
            known = ", ".join(stage.axes) or "none"
            raise AppError(f"trigger.outputs.{axis}: the stage has no such axis, only {known}")
        try:
            signalling(stage).check_output(axis, output)
        except DriverError as error:
            raise AppError(f"trigger.outputs.{axis}: {error}") from error
    try:
        with triggered(camera).armed(trigger.line, trigger.delay_s):
            pass
    except DriverError as error:
        raise AppError(f"trigger.line {trigger.line}, delay_s {trigger.delay_s:g}: {error}") from (
            error
        )


def signalling(stage: Stage) -> SignallingStage:
    """Return the stage as one that raises outputs; AppError for one that cannot."""
    if not hasattr(stage, "move_and_signal_um"):
        raise AppError("trigger: this stage raises no output on arrival; Zaber and Grbl do")
    return cast(SignallingStage, stage)


def triggered(camera: CameraDevice) -> TriggeredCamera:
    """Return the camera as one that waits for a line; AppError for one that cannot."""
    # Not isinstance: that would ask for every property, and some cameras expose a frame for theirs.
    if not hasattr(camera, "armed"):
        raise AppError("trigger: this camera waits for no line; USB3 Vision cameras (u3v:) do")
    return cast(TriggeredCamera, camera)

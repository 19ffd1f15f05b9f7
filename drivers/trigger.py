"""Hardware trigger and exposure output of a camera, by the names of the GenICam standard.

Many adapters of Micro-Manager pass these names on as properties. Source: EMVA Standard Features
Naming Convention 2.7, chapters Acquisition Control (Trigger...) and Digital I/O Control (Line...).
"""

from collections.abc import Mapping
from typing import Protocol

from emmc_rig.drivers.errors import CameraSettingError

EDGES = {"rising": "RisingEdge", "falling": "FallingEdge"}
FROM_SOFTWARE = ("Software", "Off")
"""Trigger sources that are no line."""


class Choices(Protocol):
    """Settings of a camera that have a few values by name."""

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the values that a setting may have now; () if the camera lacks the setting."""
        ...

    def choose(self, name: str, value: str) -> None:
        """Set it; raises a `DriverError`."""
        ...


def begin_by_line(camera: Choices, source: str, edge: str) -> None:
    """Let an edge on a line begin every frame; raises `CameraSettingError` if it cannot.

    edge: of `EDGES`. A camera with one kind of trigger has no TriggerSelector; a camera without
    TriggerActivation begins by the rising edge.
    """
    lines = [line for line in camera.choices("TriggerSource") if line not in FROM_SOFTWARE]
    if "On" not in camera.choices("TriggerMode") or not lines:
        raise CameraSettingError("hardware trigger", "does not exist")
    if source not in lines:
        raise CameraSettingError("TriggerSource", f"has no line {source}, only {', '.join(lines)}")
    wanted = {
        "TriggerSelector": "FrameStart",
        "TriggerSource": source,
        "TriggerActivation": EDGES[edge],
        "TriggerMode": "On",
    }
    may_lack = {"TriggerSelector"} | ({"TriggerActivation"} if edge == "rising" else set())
    _choose(camera, wanted, may_lack)


def show_exposure(camera: Choices, line: str) -> None:
    """Let a line be high while a frame is exposed; raises `CameraSettingError` if it cannot.

    A line that can only be an output has no LineMode.
    """
    if not camera.choices("LineSource"):
        raise CameraSettingError("exposure output", "does not exist")
    wanted = {"LineSelector": line, "LineMode": "Output", "LineSource": "ExposureActive"}
    _choose(camera, wanted, {"LineMode"})


def _choose(camera: Choices, wanted: Mapping[str, str], may_lack: set[str]) -> None:
    """Set in order: the choices of a setting may depend on the settings before it."""
    for name, value in wanted.items():
        offered = camera.choices(name)
        if not offered and name in may_lack:
            continue
        if value not in offered:
            raise CameraSettingError(name, f"has no {value}, only {', '.join(offered) or 'none'}")
        camera.choose(name, value)

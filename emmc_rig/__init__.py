"""Compressed light-field acquisition with coded masks: camera model, rig, calibration, solvers.

>>> import emmc_rig as emmc
>>> camera = emmc.camera("rgbw-bayer-1shot")
>>> scene = emmc.scene("deep-occlusions", size=(24, 32))
>>> psi = camera.psi(scene.size)
>>> frames = camera.expose(scene, seed=0, psi=psi)  # psi @ scene: the same without noise
>>> result = emmc.reconstruct(psi, frames, "tv")  # by default the method "adaptive"
>>> result.light_field.shape, result.verdict.level != "do not use"
((5, 5, 24, 32, 3), True)

Functions: `camera`, `scene`, `frames`, `reconstruct`, `reconstruct_film`, `rig`, `capture`,
`calibrate`, `open_frames`, `open_result`.
Their results: `Camera`, `Scene`, `Psi`, `Frames`, `Result`, `Session`. `ERRORS` holds the base
classes of errors with a remedy; each message is a line that states it. A hook, which a plan calls
between frames, raises `StopCapture` to end the capture.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from emmc_rig import moved_packages as moved_packages
from emmc_rig.version import __version__

if TYPE_CHECKING:
    from emmc_rig.bench.rig_config import rig
    from emmc_rig.captures.run import capture
    from emmc_rig.errors import ERRORS, StopCapture
    from emmc_rig.formats.cameras import find_camera as camera
    from emmc_rig.formats.scenes import Scene
    from emmc_rig.formats.scenes import open_scene as scene
    from emmc_rig.model.camera import Camera
    from emmc_rig.model.frames import Frames
    from emmc_rig.model.sensing import Psi as Psi
    from emmc_rig.process.calibrating import calibrate
    from emmc_rig.process.filming import reconstruct_film
    from emmc_rig.process.raw_frames import frames
    from emmc_rig.process.reconstructing import open_frames, reconstruct
    from emmc_rig.process.result import Result, open_result
    from emmc_rig.session.session import Session

_HOME = {
    "calibrate": "emmc_rig.process.calibrating:calibrate",
    "camera": "emmc_rig.formats.cameras:find_camera",
    "capture": "emmc_rig.captures.run:capture",
    "frames": "emmc_rig.process.raw_frames:frames",
    "rig": "emmc_rig.bench.rig_config:rig",
    "scene": "emmc_rig.formats.scenes:open_scene",
    "open_frames": "emmc_rig.process.reconstructing:open_frames",
    "open_result": "emmc_rig.process.result:open_result",
    "reconstruct": "emmc_rig.process.reconstructing:reconstruct",
    "reconstruct_film": "emmc_rig.process.filming:reconstruct_film",
    "Camera": "emmc_rig.model.camera:Camera",
    "ERRORS": "emmc_rig.errors:ERRORS",
    "Frames": "emmc_rig.model.frames:Frames",
    "Psi": "emmc_rig.model.sensing:Psi",
    "Result": "emmc_rig.process.result:Result",
    "Scene": "emmc_rig.formats.scenes:Scene",
    "Session": "emmc_rig.session.session:Session",
    "StopCapture": "emmc_rig.errors:StopCapture",
}
"""Where each public name is defined; it is imported when it is first used."""

__all__ = [
    "ERRORS",
    "Camera",
    "Frames",
    "Psi",
    "Result",
    "Scene",
    "Session",
    "StopCapture",
    "__version__",
    "calibrate",
    "camera",
    "capture",
    "frames",
    "open_frames",
    "open_result",
    "reconstruct",
    "reconstruct_film",
    "rig",
    "scene",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

"""Our camera and stage as devices of a Micro-Manager core, so that its users drive ours.

    core = UniMMCore()
    load_rig(core, camera, stage, {"XY": ("mask_x", "mask_y")})
    core.mda.run(useq.MDASequence(stage_positions=[(5000, 5000), (5072, 5048)]))

Errors of the devices pass through the core as they are. Needs the extra `micromanager`. Source:
pymmcore-plus 0.18, `pymmcore_plus.experimental.unicore`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import DTypeLike
from pymmcore_plus.experimental.unicore import (
    CameraDevice,
    StageDevice,
    UniMMCore,
    XYStageDevice,
)

from drivers.camera import Camera
from drivers.raw import RawFrame
from drivers.stage import Stage


class RigCamera(CameraDevice):
    """A camera that gives its mosaics, uint16 `(y, x)`; gain is a property.

    Every frame's metadata say what the array does not: colours, levels, and the digest of the
    camera's own bytes.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        super().__init__()
        shortest_s, longest_s = camera.exposure_limits_s
        self.set_property_limits("Exposure", (1e3 * shortest_s, 1e3 * longest_s))
        self.set_property_limits("Gain", camera.gain_limits)

    def get_exposure(self) -> float:
        """Return the exposure in ms."""
        return 1e3 * self.camera.exposure_s

    def set_exposure(self, exposure: float) -> None:
        """Choose the exposure in ms; raises as `Camera.set_exposure_s`."""
        self.camera.set_exposure_s(exposure / 1e3)

    def get_gain(self) -> float:
        """Return the gain, linear."""
        return self.camera.gain

    def set_gain(self, value: float) -> None:
        """Choose the gain; raises as `Camera.set_gain`."""
        self.camera.set_gain(value)

    def get_camera_name(self) -> str:
        """Return the model."""
        return self.camera.identity.model

    def get_camera_id(self) -> str:
        """Return the serial number."""
        return self.camera.identity.serial

    def shape(self) -> tuple[int, int]:
        """Return rows and columns; a camera that does not know them exposes a frame."""
        return self.camera.shape

    def dtype(self) -> DTypeLike:
        """Return the type of a pixel."""
        return np.uint16

    def start_sequence(
        self, n: int | None, get_buffer: Callable[[Sequence[int], DTypeLike], np.ndarray]
    ) -> Iterator[Mapping[str, Any]]:
        """Fill a buffer with each frame and yield its metadata."""
        stream = getattr(self.camera, "stream", None)
        if n == 1 or stream is None:
            frames = (self.camera.snap() for _ in iter(int, 1))
        else:
            frames = stream()
        with closing(frames):
            for frame in islice(frames, n):
                get_buffer(frame.mosaic.shape, np.uint16)[:] = frame.mosaic
                yield _metadata(frame)


class RigStage(StageDevice):
    """One axis of a stage, as a focus drive."""

    def __init__(self, stage: Stage, axis: str) -> None:
        self.stage, self.axis = stage, axis
        super().__init__()

    def set_position_um(self, val: float) -> None:
        """Move, and return when the axis has settled; raises as `Stage.move_to_um`."""
        self.stage.move_to_um({self.axis: val})

    def get_position_um(self) -> float:
        """Return where the axis reads to be."""
        return self.stage.position_um(self.axis)

    def home(self) -> None:
        """Find the axis's reference."""
        self.stage.home([self.axis])

    def stop(self) -> None:
        """Stop the axis."""
        self.stage.stop([self.axis])

    def set_origin(self) -> None:
        """Refuse: positions are the device's own, so that limits stay where they are."""
        raise NotImplementedError(_NO_ORIGIN)


class RigXYStage(XYStageDevice):
    """Two axes of a stage."""

    def __init__(self, stage: Stage, x: str, y: str) -> None:
        self.stage, self.x, self.y = stage, x, y
        super().__init__()

    def set_position_um(self, x: float, y: float) -> None:
        """Move both axes together, and return when they have settled."""
        self.stage.move_to_um({self.x: x, self.y: y})

    def get_position_um(self) -> tuple[float, float]:
        """Return where the axes read to be."""
        return self.stage.position_um(self.x), self.stage.position_um(self.y)

    def home(self) -> None:
        """Find the references of both axes."""
        self.stage.home([self.x, self.y])

    def stop(self) -> None:
        """Stop both axes."""
        self.stage.stop([self.x, self.y])

    def set_origin_x(self) -> None:
        """Refuse, as `RigStage.set_origin` does."""
        raise NotImplementedError(_NO_ORIGIN)

    def set_origin_y(self) -> None:
        """Refuse, as `RigStage.set_origin` does."""
        raise NotImplementedError(_NO_ORIGIN)


def load_rig(
    core: UniMMCore, camera: Camera, stage: Stage, axes: Mapping[str, tuple[str, ...]]
) -> None:
    """Load a camera as "Camera" and stages into a core, and give them their roles there.

    axes: by label, one of our axes for a focus drive or two for an XY stage. Whoever opened
    camera and stage closes them, after the core has unloaded its devices.
    """
    core.loadPyDevice("Camera", RigCamera(camera))
    for label, names in axes.items():
        if len(names) == 2:
            core.loadPyDevice(label, RigXYStage(stage, *names))
        else:
            core.loadPyDevice(label, RigStage(stage, *names))
    core.initializeAllDevices()
    core.setCameraDevice("Camera")
    for label, names in axes.items():
        (core.setXYStageDevice if len(names) == 2 else core.setFocusDevice)(label)
    if not core.getShutterDevice():
        core.setAutoShutter(False)


_NO_ORIGIN = "positions are the device's own: home it, and count from there"


def _metadata(frame: RawFrame) -> dict[str, Any]:
    return {
        "cfa": frame.cfa,
        "black_level_dn": frame.black_level_dn.tolist(),
        "white_level_dn": frame.white_level_dn,
        "exposure_s": frame.exposure_s,
        "gain": frame.gain,
        "sha256": frame.sha256,
    }

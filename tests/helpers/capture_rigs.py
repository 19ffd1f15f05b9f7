"""A rig without time or light: what crash tests run by the hundred.

The bytes of a frame follow from its name: two runs of a plan are equal.
"""

import hashlib
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import yaml
from watching import Acting

from emmc_rig.bench.hands import Attendant
from emmc_rig.bench.hardware import Rig
from emmc_rig.captures.plan import Plan, planned_camera
from emmc_rig.captures.run import CaptureRequest, new_session, planned_frames
from emmc_rig.drivers.camera import CameraIdentity, RawFileCamera
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.still import StillStage

SIZE = (24, 32)
BLACK, WHITE = 100, 4000
AXES = ("mask_x", "mask_y", "aperture_x", "aperture_y")
ZERO_UM: dict[str, float] = dict.fromkeys(AXES, 20_000.0)
PLAN_YAML = """
camera: rgbw-bayer-3shots
shots:
  - exposure_s: [0.01, 0.04]
  - {mask_um: [48, 24], exposure_s: auto}
whiteboards: {views: [[2, 2]], repeats: 1, references: 2, exposure_s: 0.02}
darks: {repeats: 2}
metering: {bracket: false}
settle_s: 0.1
"""


class NamedFrames:
    """A camera's wire that gives each announced frame bytes of its own."""

    def __init__(self, size=SIZE):
        self.size, self.name, self.count = size, "", 0

    def announce(self, name):
        self.name = name

    def capture(self, exposure_s):
        self.count += 1
        return frame_bytes(self.name, exposure_s, self.size)


def frame_bytes(name, exposure_s, size=SIZE):
    digest = hashlib.sha256(name.encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    top = BLACK + 20 if name.startswith("dark") else WHITE - 400
    return encode_dng(rng.integers(BLACK, top, size, np.uint16), "rggb", BLACK, WHITE, exposure_s)


class PreparedCamera:
    """A camera that takes its frames from `give(exposure_s)`."""

    exposure_limits_s = (1e-6, 3600.0)
    gain_limits = (1.0, 1.0)
    exposure_s, gain = 0.01, 1.0
    identity = CameraIdentity("EMMC", "prepared frames", "1")

    def __init__(self, give, cfa="rggb", shape=SIZE):
        self.give, self.cfa, self.shape = give, cfa, shape

    def set_exposure_s(self, exposure_s):
        self.exposure_s = exposure_s

    def set_gain(self, gain):
        assert gain == 1

    def snap(self):
        return replace(self.give(self.exposure_s), exposure_s=self.exposure_s, gain=self.gain)

    def close(self):
        pass


class QuietAttendant(Attendant):
    """Carries out requests at once, and keeps their list."""

    def __init__(self):
        self.asked = []

    def set_lamp(self, colour):
        self.asked.append(("lamp", colour))

    def place(self, target, turn_deg=0.0):
        self.asked.append(("place", target))

    def fit_masks(self, shot, fitted=True):
        self.asked.append(("masks", shot, fitted))

    def move(self, offsets_um):
        self.asked.append(("move", dict(offsets_um)))

    def again(self, axes):
        self.asked.append(("again",))

    @property
    def lamp(self):
        return [call[1] for call in self.asked if call[0] == "lamp"][-1]


def stops_after(frame_id, control):
    """Return a watcher that stops a capture once a frame is taken."""
    return Acting(frame_taken=lambda event: event.facts["id"] == frame_id and control.stop())


def still_rig(size=SIZE) -> Any:
    """Return a rig on which nothing takes time."""
    wire = NamedFrames(size)
    clock = ManualClock()

    def opened():
        return RawFileCamera(wire, size, "rggb", identity=CameraIdentity("EMMC", "paper", "7"))

    return Rig(
        StillStage(AXES, clock),
        opened(),
        QuietAttendant(),
        ZERO_UM,
        40_000.0,
        clock,
        opened,
        wire.announce,
    )


@cache
def plan_and_camera(text=PLAN_YAML):
    plan = Plan.model_validate(yaml.safe_load(text))
    return plan, planned_camera(plan)


def request_for(folder, text=PLAN_YAML):
    """Return what a plan asks for, without a plan file."""
    plan, camera = plan_and_camera(text)
    return CaptureRequest(folder / "plan.yaml", plan, text, camera, folder / "s", {"kind": "x"})


def begun(folder, disk, rig, text=PLAN_YAML):
    """Return a new session on a disk, and its plan."""
    request = request_for(folder, text=text)
    return new_session(request, planned_frames(request, rig), disk), request.plan


def frames_in(session):
    """Return each frame that a session needs, by the frame's name, without its time."""
    return {frame.id: frame_in(session.read(frame.id)) for frame in session.needed}


def frame_in(data):
    """Return what a frame's file says of the light, without when: mosaic, levels, exposure."""
    frame = decode_raw(data)
    levels = frame.black_level_dn.tobytes(), frame.white_level_dn
    return frame.mosaic.tobytes(), frame.mosaic.shape, levels, frame.exposure_s, frame.gain

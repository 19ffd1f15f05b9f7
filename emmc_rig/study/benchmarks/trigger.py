"""Time for each frame with and without a line from stage to camera, on simulated devices.

Part of `emmc-rig devices bench`. The simulated clock counts what the devices take and how often
the program asks them; bytes on a cable take none, so a real gain is larger by an exchange or two.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from drivers.stage import StageSettings
from drivers.u3v import U3vCamera, open_u3v
from drivers.zaber import ZaberStage
from emmc_rig.capture.expand import expand
from emmc_rig.capture.order import ordered
from emmc_rig.capture.plan import Plan, PlannedShot, planned_camera
from emmc_rig.capture.sequencer import Sequencer
from emmc_rig.rig.hardware import simulated_rig
from emmc_rig.rig.trigger import LINE_LATENCY_S, SimulatedTrigger
from emmc_rig.session.session import Frozen, Session
from simulators.clock import ManualClock
from simulators.disk import SimulatedDisk
from simulators.u3v import U3vCameraSimulator
from simulators.usb import SimulatedUsb
from simulators.zaber import AxisSpec, ZaberChain

EXPOSURE_S = 0.01
STEP_UM = 120.0
MOVE_S = 10.0
"""Longest wait for the edge."""
FRAMES = 25
SHAPE = (24, 32)
SCENE = (5, 5, *SHAPE, 3)
STEPPED = Plan(
    camera="rgbw-bayer-1shot",
    shots=tuple(
        PlannedShot(mask_um=(STEP_UM * number, 0.0), exposure_s=(EXPOSURE_S,))
        for number in range(FRAMES)
    ),
    whiteboards=None,
    darks=None,
)


@dataclass(frozen=True)
class TriggerTiming:
    """Mean time for each frame, in ms: the program polls, or the stage triggers the camera.

    vibration_ms: waited after every arrival, by the program or by the camera's trigger delay.
    """

    frames: int
    exposure_ms: float
    vibration_ms: float
    asked_ms: float
    triggered_ms: float

    def as_dict(self) -> dict[str, float]:
        """Return the row, with the gain for each frame."""
        return {**asdict(self), "gain_ms": self.asked_ms - self.triggered_ms}


class TriggeredRig:
    """A Zaber axis whose first output leads to line 0 of a USB3 Vision camera."""

    def __init__(self, settings: StageSettings, latency_s: float = LINE_LATENCY_S) -> None:
        self.clock = ManualClock()
        self.seen_um: list[float] = []
        self.chain = ZaberChain(self.clock, {(1, 1): AxisSpec()})
        self._camera = U3vCameraSimulator(self._see, self.clock, SHAPE)
        self.chain.on_output = lambda device, output, level, at_s: (
            self._camera.raise_line(at_s + latency_s) if (output, level) == (1, 1) else None
        )
        self.stage = ZaberStage(
            self.chain.transport(), {"x": (1, 1)}, AxisSpec().microstep_um, self.clock, settings
        )

    def open_camera(self) -> U3vCamera:
        """Return the camera, opened; it must be closed."""
        camera = open_u3v(backend=SimulatedUsb(self.clock, self._camera), clock=self.clock)
        camera.set_exposure_s(EXPOSURE_S)
        return camera

    def _see(self, exposure_s: float) -> np.ndarray:
        self.seen_um.append(self.chain.position_um(1, 1))
        return np.full(SHAPE, 100, np.uint16)


def trigger_timing(frames: int = FRAMES, settle_s: float = 0.05) -> TriggerTiming:
    """Take frames at equal steps, once asked for and once triggered by the stage's arrival."""
    rig = TriggeredRig(StageSettings(settle_s=settle_s))
    rig.stage.home()
    places_um = [1_000.0 + STEP_UM * number for number in range(frames + 1)]
    with closing(rig.open_camera()) as camera:
        rig.stage.move_to_um({"x": places_um[0]})
        start_s = rig.clock.now_s()
        for place_um in places_um[1:]:
            rig.stage.move_to_um({"x": place_um})
            camera.snap()
        asked_s = rig.clock.now_s() - start_s
    rig = TriggeredRig(StageSettings(settle_s=0.0))
    rig.stage.home()
    with closing(rig.open_camera()) as camera:
        rig.stage.move_to_um({"x": places_um[0]})
        start_s = rig.clock.now_s()
        for place_um in places_um[1:]:
            with camera.armed(delay_s=settle_s) as receive:
                rig.stage.move_and_signal_um("x", place_um)
                receive(MOVE_S)
        triggered_s = rig.clock.now_s() - start_s
    ms = 1e3 / frames
    return TriggerTiming(frames, EXPOSURE_S * 1e3, settle_s * 1e3, asked_s * ms, triggered_s * ms)


def capture_timing(settle_s: float = 0.05) -> TriggerTiming:
    """Capture shots at equal steps on the simulated rig, asked for and triggered on arrival."""
    # The same camera both times: without an output on the axis that moves nothing is triggered.
    asked_s, triggered_s = (
        _frame_s(SimulatedTrigger(outputs={axis: 1}, delay_s=settle_s))
        for axis in ("aperture_x", "mask_x")
    )
    return TriggerTiming(FRAMES, EXPOSURE_S * 1e3, settle_s * 1e3, asked_s * 1e3, triggered_s * 1e3)


def _frame_s(trigger: SimulatedTrigger) -> float:
    """Return how long the devices take from the end of one frame of a session to the next."""
    camera, clock = planned_camera(STEPPED), ManualClock()
    scene = np.full(SCENE, 0.5, np.float32)
    rig, _ = simulated_rig(camera, scene, SHAPE, 0, clock, rays_per_view=16, trigger=trigger)
    frames = ordered(expand(STEPPED, camera, rig.window_um), STEPPED.order)
    frozen = Frozen("", camera.model_dump(mode="json"), {}, frames)
    session = Session.create(Path("/bench/session"), frozen, {"title": "steps"}, SimulatedDisk())
    Sequencer(session, STEPPED, rig, timer=clock.now_s).run()
    ends_s = [entry["spans_s"]["check"][1] for entry in session.stored.values()]
    return (ends_s[-1] - ends_s[0]) / (len(ends_s) - 1)

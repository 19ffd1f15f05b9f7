"""Time for each frame with and without a line from stage to camera, on simulated devices.

Part of `emmc-rig devices bench`. The simulated clock counts what the devices take and how often
the program asks them; bytes on a cable take none, so a real gain is larger by an exchange or two.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, dataclass

import numpy as np

from drivers.stage import StageSettings
from drivers.u3v import U3vCamera, open_u3v
from drivers.zaber import ZaberStage
from simulators.clock import ManualClock
from simulators.u3v import U3vCameraSimulator
from simulators.usb import SimulatedUsb
from simulators.zaber import AxisSpec, ZaberChain

LINE_LATENCY_S = 20e-6
"""Of the output, the cable and the camera's input, as opto-isolated ones are specified."""
EXPOSURE_S = 0.01
STEP_UM = 120.0
MOVE_S = 10.0
"""Longest wait for the edge."""
FRAMES = 25
SHAPE = (24, 32)


@dataclass(frozen=True)
class TriggerTiming:
    """Mean time for each frame, in ms: the program waits and asks, or the stage tells the camera.

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

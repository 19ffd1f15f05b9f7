"""Exposure on the stage's arrival, by a line: after the move, at the place, sooner than asked."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml
from capture_rigs import begun, plan_and_camera
from simulated_disk import SimulatedDisk

from drivers.errors import (
    CameraSettingError,
    CaptureError,
    CommandRefusedError,
    LimitExceededError,
    StalledError,
)
from drivers.stage import StageSettings
from drivers.u3v import U3vCamera, open_u3v
from drivers.zaber import ZaberStage
from emmc_rig.acquisition.sequencer import Sequencer
from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.bench.rig_config import ImagedRig, opened_rig, rig_description
from emmc_rig.bench.trigger import LINE_LATENCY_S, SimulatedTrigger, check_trigger
from emmc_rig.errors import AppError
from emmc_rig.files.scenes import fine_scene
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import RetryEntry, of_kind
from simulators.clock import ManualClock
from simulators.u3v import U3vCameraSimulator
from simulators.usb import SimulatedUsb
from simulators.zaber import AxisSpec, ZaberChain

BACKLASH_UM = 3.0


SHAPE, EXPOSURE_S, MOVE_S = (24, 32), 0.01, 10.0


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


@pytest.fixture
def rig():
    made = TriggeredRig(StageSettings(settle_s=0.0))
    made.stage.home()
    return made


@pytest.mark.parametrize("places_um", [(1_000.0, 1_400.0), (2_000.0, 900.0)], ids=["up", "down"])
@pytest.mark.parametrize("delay_s", [0.0, 0.05])
def test_the_exposure_begins_on_arrival_whichever_way_the_axis_came(rig, places_um, delay_s):
    edges_s = []
    tell = rig.chain.on_output
    rig.chain.on_output = lambda *change: (edges_s.append(change[1:]), tell(*change))
    with closing(rig.open_camera()) as camera:
        for place_um in places_um:
            with camera.armed(delay_s=delay_s) as receive:
                assert rig.stage.move_and_signal_um("x", place_um) == pytest.approx(place_um, abs=1)
                frame = receive(MOVE_S)
            assert frame.exposure_s == pytest.approx(EXPOSURE_S)
            at_s = [at_s for _, level, at_s in edges_s if level][-1]
            assert rig.clock.now_s() >= at_s + delay_s + EXPOSURE_S
    assert [level for _, level, _ in edges_s] == [1, 0, 1]
    for seen_um, place_um in zip(rig.seen_um, places_um, strict=True):
        assert seen_um == pytest.approx(place_um, abs=0.1)  # from below: no backlash


def test_the_line_does_not_rise_on_the_way_to_the_approach(rig):
    rig.stage.move_to_um({"x": 5_000.0})
    places_um = []
    rig.chain.on_output = lambda device, output, level, at_s: (
        places_um.append(rig.chain.position_um(1, 1)) if level else None
    )
    rig.stage.move_and_signal_um("x", 4_000.0)
    assert places_um == [pytest.approx(4_000.0, abs=BACKLASH_UM)]


def test_a_move_that_fails_raises_no_line_and_exposes_nothing(rig):
    with closing(rig.open_camera()) as camera:
        with pytest.raises(LimitExceededError), camera.armed():
            rig.stage.move_and_signal_um("x", 1e9)
        rig.chain.faults.inject("stall", when=lambda command: b" move " in command)
        with pytest.raises(StalledError), camera.armed():
            rig.stage.move_and_signal_um("x", 9_000.0)
        assert rig.seen_um == []
        with pytest.raises(CaptureError), camera.armed() as receive:
            receive(1.0)
        assert camera.snap().mosaic.shape  # untriggered again


def test_a_camera_without_that_line_is_refused(rig):
    with closing(rig.open_camera()) as camera:
        with pytest.raises(CameraSettingError, match="offers Software, Line0, not Line7"):
            camera.armed("Line7").__enter__()
        assert camera.snap().mosaic.shape


def test_an_output_that_the_device_lacks_is_refused_before_it_moves(rig):
    before_um = rig.chain.position_um(1, 1)
    with pytest.raises(CommandRefusedError, match="BADDATA"):
        rig.stage.move_and_signal_um("x", 3_000.0, output=9)
    assert rig.chain.position_um(1, 1) == before_um


STEPS = """
camera: rgbw-bayer-1shot
shots:
  - {mask_um: [0, 0], exposure_s: 0.01}
  - {mask_um: [120, 0], exposure_s: 0.01}
  - {mask_um: [60, 0], exposure_s: 0.01}
  - {mask_um: [60, 96], exposure_s: 0.01}
whiteboards: {views: [[2, 2], [2, 3]], repeats: 2, references: 2}
darks: {repeats: 2}
settle_s: 0.01
"""
EVERY_AXIS = dict.fromkeys(("mask_x", "mask_y", "aperture_x", "aperture_y"), 1)
SIZE = (24, 32)


def stepped_session(outputs, cut=False):
    """Capture STEPS on the simulated rig; returns its session and how the run ended."""
    camera = plan_and_camera(STEPS)[1]
    scene = fine_scene("near-planar", 1, 1, size=SIZE).samples
    trigger = None if outputs is None else SimulatedTrigger(outputs=outputs, delay_s=0.02)
    rig, _ = simulated_rig(camera, scene, SIZE, 0, ManualClock(), 16, trigger)
    if trigger is not None:
        check_trigger(trigger, rig.stage, rig.camera)
    if cut:
        rig.chain.on_output = lambda *change: None
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, STEPS)
    return session, Sequencer(session, plan, rig).run()


@pytest.fixture(scope="module")
def asked():
    return stepped_session(None)[0]


def mosaics(session):
    return {
        frame.id: decode_frame(session.read(frame.id), session.stored[frame.id]).mosaic
        for frame in session.frames
    }


def test_a_session_triggered_on_arrival_holds_the_very_frames_of_one_that_is_asked_for(asked):
    session, outcome = stepped_session(EVERY_AXIS)
    assert outcome.complete
    assert outcome.retries == 0
    triggered = {name for name, entry in session.stored.items() if entry.triggered}
    # Of several axes at once, frames at one place, and metering nothing is triggered.
    assert {"shot-1-e0-r0", "shot-2-e0-r0"} <= triggered
    assert any(name.startswith("board-") for name in triggered)
    assert not any(name.startswith("meter-") for name in triggered)
    ours, theirs = mosaics(session), mosaics(asked)
    for name, entry in session.stored.items():
        if entry.exposure_s == asked.stored[name].exposure_s:
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
        else:  # the other camera's nearest to what was metered
            assert entry.exposure_s == pytest.approx(asked.stored[name].exposure_s, rel=0.02)


def test_without_its_wire_a_frame_is_lost_and_then_asked_for():
    session, outcome = stepped_session(EVERY_AXIS, cut=True)
    assert outcome.complete
    assert outcome.retries > 0
    assert not any(entry.triggered for entry in session.stored.values())
    faults = [entry.fault for entry in of_kind(session.journal.entries, RetryEntry)]
    assert all("check the trigger" in fault for fault in faults)


@pytest.mark.parametrize(
    ("trigger", "said"),
    [
        ({"outputs": {"mask_z": 1}}, "trigger.outputs.mask_z: the stage has no such axis"),
        ({"outputs": {"mask_x": 9}}, "trigger.outputs.mask_x: .*BADDATA"),
        ({"outputs": {"mask_x": 1}, "line": "Line7"}, "trigger.line Line7.*offers Software, Line0"),
        ({"outputs": {"mask_x": 1}, "lin": "Line0"}, "lin.*did you mean 'line'"),
        ({"outputs": {}}, "outputs"),
        ({"outputs": {"mask_x": 1}, "delay_s": -1}, "delay_s"),
        (None, "trigger"),
    ],
)
def test_a_trigger_that_cannot_be_is_refused_in_one_line_when_the_rig_is_opened(
    tmp_path, trigger, said
):
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump({"kind": "simulated", "trigger": trigger}))
    camera = plan_and_camera(STEPS)[1]

    def open_it():
        imaged = ImagedRig(scene="near-planar", size=SIZE)
        with opened_rig(rig_description(str(file), imaged), camera, print):
            pass

    with pytest.raises(AppError, match=said) as refused:
        open_it()
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "camera", "said"),
    [
        ("simulated:apt", "simulated", "this stage raises no output"),
        ("simulated:grbl", "simulated", "no such pin"),
        ("simulated", "simulated", "this camera waits for no line"),
    ],
)
def test_devices_that_cannot_be_wired_are_refused_when_a_real_rig_is_opened(
    tmp_path, stage, camera, said
):
    axis = "x" if ":" in stage else "mask_x"
    file = tmp_path / "rig.yaml"
    wire = {"outputs": {axis: 1}}
    file.write_text(yaml.safe_dump({"stage": stage, "camera": camera, "trigger": wire}))
    design = plan_and_camera(STEPS)[1]
    described = rig_description(str(file), ImagedRig(scene="dark"))
    with pytest.raises(AppError, match=said), opened_rig(described, design, print):
        pass


def test_a_rig_without_a_trigger_is_frozen_as_it_was_before_there_were_any():
    assert "trigger" not in rig_description("simulated", ImagedRig(scene="dark"))

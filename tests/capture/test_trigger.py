"""Frames that a pulse begins: of the simulated lamp, on a line of the USB3 Vision camera."""

import math
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import begun, plan_and_camera
from programs import done, refused
from simulated_disk import SimulatedDisk

from emmc_rig.bench.hardware import Fitted, simulated_rig
from emmc_rig.captures import film
from emmc_rig.captures.devices import with_trigger
from emmc_rig.captures.faults import GaveUpError
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.errors import CameraSettingError
from emmc_rig.drivers.trigger import begin_by_line, show_exposure
from emmc_rig.drivers.u3v import U3vCamera
from emmc_rig.errors import AppError
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.session.journal import DroppedEntry, RetryEntry, of_kind
from emmc_rig.session.session import Session
from emmc_rig.simulators.lamp import PULSE_S, STROBE_S
from emmc_rig.simulators.u3v import U3vCameraSimulator

SIZE = (24, 32)
SHOTS = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.02, repeats: 3}]
whiteboards: null
darks: {repeats: 2}
trigger: {source: Line1, limit_s: 1}
exposure_output: Line2
retries: {per_frame: 2}
"""
FILM = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.02}]
film: {frames: 12, rate: 10}
whiteboards: null
darks: null
trigger: {source: Line1, limit_s: 1}
"""


def run_of(text, before=lambda rig: None):
    """Return a rig, its session, and what runs the plan."""
    samples = fine_scene("near-planar", 1, 1, size=SIZE).samples
    rig, _ = simulated_rig(
        plan_and_camera(text)[1], samples, SIZE, 0, fitted=Fitted(camera="u3v", lights=True)
    )
    disk = SimulatedDisk()
    session, plan = begun(Path("/disk"), disk, rig, text)
    rig = with_trigger(rig, plan)
    before(rig)
    return rig, Session(session.folder, disk), lambda s: Sequencer(s, plan, rig).run()


def lamp_of(rig):
    assert rig.lamp is not None
    return rig.lamp


def features_of(camera):
    assert isinstance(camera, U3vCamera)
    return camera.features


@pytest.mark.parametrize(("edge", "later_s"), [("rising", 0.0), ("falling", PULSE_S)])
def test_every_frame_begins_with_an_edge_on_its_line(edge, later_s):
    text = SHOTS.replace("Line1,", f"Line1, edge: {edge},")
    rig, session, run = run_of(text)
    features = features_of(rig.camera)
    assert (features.value("LineMode"), features.value("LineSource")) == (
        "Output", "ExposureActive",
    )  # fmt: skip
    assert run(session).complete
    began_s = [entry.camera_time_s for entry in session.stored.values()]
    assert len(began_s) == 5
    off_s = np.remainder(np.array(began_s) - later_s + 1e-9, STROBE_S)
    np.testing.assert_allclose(off_s, 0, atol=1e-6)
    assert all(entry.triggered for entry in session.stored.values())


def test_a_camera_that_is_opened_again_keeps_its_trigger():
    rig, session, run = run_of(SHOTS)
    rig.still.faults.inject("unplug", skip=60)
    assert run(session).complete
    assert of_kind(session.journal.entries, RetryEntry)
    assert rig.reopen_camera is not None
    features = features_of(rig.reopen_camera())
    assert features.value("TriggerMode") == "On"
    assert features.value("TriggerSource") == "Line1"


def test_a_lost_pulse_is_waited_out_and_lost_pulses_name_their_frame():
    rig, session, run = run_of(SHOTS)
    lamp_of(rig).faults.inject("lost_pulse", times=2)
    assert run(session).complete
    assert not of_kind(session.journal.entries, RetryEntry)
    rig, session, run = run_of(SHOTS)
    assert isinstance(rig.still, U3vCameraSimulator)
    rig.still.lines["Line1"] = lambda after_s, rising: math.inf
    line = r"frame dark-0-r0: gave up .*no pulse came on Line1 within 1 s: check what gives"
    with pytest.raises(GaveUpError, match=line):
        run(session)


def test_lost_pulses_of_a_film_are_dropped_frames_by_name_and_reason():
    rig, session, run = run_of(FILM)
    lamp_of(rig).faults.inject("lost_pulse", times=2, when=lambda at_s: passed(at_s) == 4)
    rig.still.faults.inject("dropped_frame", when=lambda block: block == 6)
    first: list[float] = []

    def passed(at_s):
        first.append(at_s)
        return round((at_s - first[0]) / STROBE_S)

    assert run(session).complete
    entries = of_kind(session.journal.entries, DroppedEntry)
    dropped = {name: entry.reason for entry in entries for name in entry.ids}
    assert dropped == {"film-000004": film.NO_PULSE, "film-000007": film.SKIPPED}
    assert len(session.stored) == 10


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (
            "source: Line1",
            "source: Line7",
            "trigger: .* TriggerSource has no line Line7, only Line0, Line1: change",
        ),
        (
            "output: Line2",
            "output: Line1",
            "exposure_output: .* LineSelector has no Line1, only Line2: change",
        ),
    ],
)
def test_lines_that_the_camera_lacks_are_refused_by_name(key, value, message):
    with pytest.raises(AppError, match=message):
        run_of(SHOTS.replace(key, value))


class Properties:
    """A camera with some settings, as an adapter of Micro-Manager may have them."""

    def __init__(self, **offered):
        self.offered, self.chosen = offered, []

    def choices(self, name):
        return self.offered.get(name, ())

    def choose(self, name, value):
        self.chosen.append((name, value))


def test_settings_are_made_in_the_order_of_the_standard_and_missing_ones_are_named():
    plain = {"TriggerMode": ("Off", "On"), "TriggerSource": ("Software", "Line0")}
    camera = Properties(**plain)
    begin_by_line(camera, "Line0", "rising")
    assert camera.chosen == [("TriggerSource", "Line0"), ("TriggerMode", "On")]
    with pytest.raises(CameraSettingError, match="TriggerActivation has no FallingEdge, only none"):
        begin_by_line(camera, "Line0", "falling")
    for offered in ({}, {"TriggerMode": ("Off", "On"), "TriggerSource": ("Software",)}):
        with pytest.raises(CameraSettingError, match="hardware trigger does not exist"):
            begin_by_line(Properties(**offered), "Line0", "rising")
    with pytest.raises(CameraSettingError, match="exposure output does not exist"):
        show_exposure(camera, "Line1")
    lines = Properties(LineSelector=("Line1",), LineSource=("Off", "ExposureActive"))
    show_exposure(lines, "Line1")
    assert lines.chosen == [("LineSelector", "Line1"), ("LineSource", "ExposureActive")]


def test_a_triggered_plan_runs_from_the_command_line(run, tmp_path):
    (tmp_path / "rig.yaml").write_text("kind: simulated\nusb_camera: u3v\nlights: simulated\n")
    (tmp_path / "plan.yaml").write_text(SHOTS)
    rig = ("--rig", "rig.yaml", "--size", "24x32", "--scene", "near-planar")
    assert "complete: 5 frames" in done(run("capture", "plan.yaml", *rig))
    (tmp_path / "ptp.yaml").write_text("kind: simulated\n")
    line = refused(run("capture", "plan.yaml", "--rig", "ptp.yaml", "--out", "other", *rig[2:]))
    assert "trigger: the camera's trigger is not supported by its driver" in line
    assert not (tmp_path / "other").exists()

"""From a session to readings: brackets, gains, and plans without whiteboards."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml
from capture_rigs import begun
from simulated_disk import SimulatedDisk

from emmc_rig.bench.hands import AskingAttendant
from emmc_rig.bench.hardware import (
    NO_FLAWS,
    open_camera,
    simulated_rig,
)
from emmc_rig.bench.rig_config import (
    SIMULATED,
    ImagedRig,
    RealRig,
    rig_description,
)
from emmc_rig.captures.plan import Plan, planned_camera
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.errors import DriverError
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.session.brightness import exposure_reasons, shot_exposures
from emmc_rig.session.frame_file import NO_FIGURES, decode_frame, frame_entry, frame_file
from emmc_rig.session.readings import session_frames
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.effects import Flaws
from emmc_rig.simulators.flaws import SensorFlaws
from emmc_rig.simulators.u3v import U3vCameraSimulator
from emmc_rig.simulators.usb import SimulatedUsb

SIZE = (24, 32)
BRIGHT = 0.08


def captured(text, flaws=NO_FLAWS):
    """Run a plan on the simulated rig; returns its session and the camera as planned."""
    camera = planned_camera(Plan.model_validate(yaml.safe_load(text)))
    samples = fine_scene("near-planar", 1, 1, size=SIZE, views=camera.views).samples
    rig, _ = simulated_rig(camera, samples, SIZE, seed=0, flaws=flaws)
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, text)
    assert Sequencer(session, plan, rig).run().complete
    return session, camera


@pytest.fixture(scope="module")
def without_boards():
    return captured(f"""
camera: rgbw-bayer-1shot
shots:
  - {{mask_um: [0, 0], exposure_s: {BRIGHT}, repeats: 2}}
  - {{mask_um: [0, 0], exposure_s: {BRIGHT}, gain: 4, repeats: 2}}
  - {{mask_um: [0, 0], exposure_s: [0.005, {BRIGHT}]}}
whiteboards: null
darks: {{repeats: 8}}
""")


def test_a_plan_without_whiteboards_is_read_by_the_design(without_boards):
    session, camera = without_boards
    psi, frames = session_frames(session)
    design = build_imaging_matrix(camera, SIZE)
    np.testing.assert_array_equal(psi.weights, design.weights)
    light_field = fine_scene("near-planar", 1, 1, size=SIZE, views=camera.views).scene.light_field
    foretold = design.forward(light_field)
    # The masks sit elsewhere than designed; on average the light is that of the lens's opening.
    assert frames.readings.mean() == pytest.approx(foretold.mean(), rel=0.05)


def test_readings_do_not_depend_on_the_gain_and_their_deviation_is_true(without_boards):
    _, taken = session_frames(without_boards[0])
    for other in (1, 2):
        score = (taken.readings[0] - taken.readings[other]) / np.hypot(
            taken.deviation[0], taken.deviation[other]
        )
        assert abs(score.mean()) < 0.2
        # The dark frames are shared, so that the difference is a little surer than foretold.
        assert 0.85 < score.std() < 1.1


@pytest.mark.parametrize("shot", ["18.7", "[0.5, 18.7]", "auto"])
@pytest.mark.parametrize("of_shots", [0, 4])
def test_dark_current_of_long_shots_is_subtracted_or_said_to_be_unknown(tmp_path, shot, of_shots):
    """White is 3,000 electrons/s, the dark current 100: 0.033 of white."""
    camera = find_camera("rgbw-bayer-1shot")
    noise = camera.sensor.noise.model_copy(update={"electrons_per_s": 3000.0})
    sensor = camera.sensor.model_copy(update={"noise": noise})
    path = tmp_path / "dim.yaml"
    path.write_text(camera.model_copy(update={"sensor": sensor}).model_dump_json())
    text = f"""
camera: {path}
shots: [{{exposure_s: {shot}}}]
whiteboards: null
metering: {{bracket: false, level: 0.6}}
darks: {{repeats: 4, of_shots: {of_shots}}}
"""
    warm = Flaws(sensor=SensorFlaws(dark_electrons_per_s=100.0))
    (session, _), (cold, _) = captured(text, warm), captured(text)
    (_, taken), (_, truth) = session_frames(session), session_frames(cold)
    off = (taken.readings - truth.readings)[taken.usable & truth.usable]
    deviation = np.median(taken.deviation)
    reasons = [reason.what for reason in exposure_reasons(shot_exposures(session))]
    if of_shots:
        assert abs(off.mean()) < 0.001
        assert deviation < 0.01
        assert not reasons
    else:
        assert off.mean() == pytest.approx(0.033, abs=0.003)
        assert off.mean() < 1.5 * deviation
        assert any("no dark frame is exposed as long" in text for text in reasons)
        # 100 electrons/s for as much longer as the longest exposure is than the darks'.
        shots = [entry for name, entry in session.stored.items() if name.startswith("shot-")]
        longest = max(shots, key=lambda entry: entry.exposure_s)
        more_s = longest.exposure_s - session.stored["dark-0-r0"].exposure_s
        unknown_dn = noise.gain_dn_per_electron * 100 * more_s
        (exposed,) = shot_exposures(session)
        assert exposed.dark_share == pytest.approx(unknown_dn / longest.figures.bright_dn)


def test_a_person_is_asked_again_only_when_something_changes():
    camera = planned_camera(Plan.model_validate({"camera": "rgbw-bayer-2shots", "shots": [{}, {}]}))
    asked = []
    attendant = AskingAttendant(camera, asked.append)
    for _ in range(3):
        attendant.place("whiteboard")
        attendant.set_lamp("white")
        attendant.fit_masks(0, fitted=False)
    attendant.fit_masks(0)
    attendant.set_lamp("off")
    assert asked == [
        "put the whiteboard before the camera",
        "switch the white lamp on",
        "take all masks out",
        "put in the masks mask",
        "switch the lamp off",
    ]


def test_a_wish_that_failed_is_asked_again():
    camera = planned_camera(Plan.model_validate({"camera": "conventional", "shots": [{}]}))
    asked = []

    def ask(wish):
        asked.append(wish)
        if len(asked) == 1:
            raise AppError("nobody there")

    attendant = AskingAttendant(camera, ask)
    with pytest.raises(AppError):
        attendant.set_lamp("red")
    attendant.set_lamp("red")
    assert asked == ["switch the red lamp on"] * 2


def test_a_stage_file_is_looked_for_beside_the_rig_s(tmp_path):
    (tmp_path / "stage.yaml").write_text("protocol: zaber\nport: /dev/ttyUSB0\n")
    rig = {"stage": "stage.yaml", "camera": "ptp:", "zero_um": {"mask_x": 1.0}}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    described = rig_description(str(tmp_path / "rig.yaml"), ImagedRig(scene="dark"))
    assert described["stage"] == str(tmp_path / "stage.yaml")
    assert RealRig.model_validate({k: v for k, v in described.items() if k != "kind"}).by_hand


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("stage: simulated\ncamera: simulated\nzero: {}\n", "did you mean 'zero_um'"),
        ("kind: simulated\naxes: [mask_z]\n", "axes.0: input should be 'mask_x', 'mask_y', "),
    ],
)
def test_a_misspelt_key_or_axis_of_a_rig_names_the_right_ones(tmp_path, text, said):
    (tmp_path / "rig.yaml").write_text(text)
    with pytest.raises(AppError, match=said):
        rig_description(str(tmp_path / "rig.yaml"), ImagedRig(scene="dark"))
    assert rig_description(SIMULATED, ImagedRig(scene="dark"))["scene"] == "dark"


def test_a_streamed_frame_comes_back_from_its_file_as_it_was_taken():
    """USB3 Vision: the file holds leader, payload and trailer, the journal what they do not say."""
    rng = np.random.default_rng(0)
    scene = rng.integers(64, 4000, (48, 64)).astype(np.uint16)
    clock = ManualClock()
    bus = SimulatedUsb(clock, U3vCameraSimulator(lambda exposure_s: scene, clock, scene.shape))
    with closing(open_camera("u3v:", clock, bus)) as camera:
        camera.set_exposure_s(0.02)
        frame = camera.snap()
    file = frame_file(frame)
    assert (file.suffix, file.data) == (".bin", frame.original)
    assert frame.exposure_s is not None
    assert frame.gain is not None
    entry = frame_entry(frame, frame.exposure_s, frame.gain, figures=NO_FIGURES)
    back = decode_frame(file.data, entry.model_copy(update={"file": "00000-x.bin"}))
    np.testing.assert_array_equal(back.mosaic, frame.mosaic)
    np.testing.assert_array_equal(back.black_level_dn, frame.black_level_dn)
    assert (back.cfa, back.white_level_dn) == (frame.cfa, frame.white_level_dn)
    assert (back.exposure_s, back.gain) == (frame.exposure_s, frame.gain)


def test_a_plug_in_s_bytes_stored_by_version_0_2_are_said_to_be_undecodable():
    mosaic = np.zeros((2, 2), np.uint16)
    frame = RawFrame(mosaic, np.zeros((2, 2)), 255, "rggb", None, b"", "")
    entry = frame_entry(frame, 0.01, 1.0, figures=NO_FIGURES)
    with pytest.raises(DriverError, match=r"00003-shot-0\.bin is in a format that only"):
        decode_frame(bytes(2000), entry.model_copy(update={"file": "00003-shot-0.bin"}))

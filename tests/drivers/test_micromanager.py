"""Micro-Manager's devices in our rig.

Needs the extra `micromanager`, whose mm-test-adapters bring a core's demo devices and its
SequenceTester, a camera whose pixels spell out where every device was during the exposure.
"""

import re
import subprocess
import sys
from contextlib import closing
from datetime import datetime, timedelta
from itertools import islice

import numpy as np
import pytest

pytest.importorskip("pymmcore_plus", reason="the extra `micromanager` is not installed")
pytest.importorskip("mm_test_adapters", reason="the extra `micromanager` is not installed")

from pymmcore_plus.seq_tester import decode_image

from emmc_rig.bench.conformance.cameras import *  # noqa: F403
from emmc_rig.bench.hardware import open_camera, open_stage
from emmc_rig.drivers.errors import (
    CameraClosedError,
    CameraSettingError,
    LimitExceededError,
    MicroManagerError,
    NotHomedError,
    PortGoneError,
    SpeedFixedError,
)
from emmc_rig.drivers.micromanager import (
    CameraSetup,
    MicroManagerCamera,
    MicroManagerStage,
    StageSetup,
    load_core,
)
from emmc_rig.drivers.raw import captured_at, decode_raw
from emmc_rig.errors import AppError

DEMO = "MMConfig_demo.cfg"
TRAVEL_UM = (-1000.0, 1000.0)
SEQUENCE_TESTER = """\
Device,THub,SequenceTester,THub
Device,Camera,SequenceTester,TCamera
Device,Z,SequenceTester,TZStage
Parent,Camera,THub
Parent,Z,THub
Property,Camera,ImageMode,MachineReadable
Property,Camera,ImageWidth,128
Property,Camera,ImageHeight,128
Property,Core,Initialize,1
Property,Core,Camera,Camera
"""


def demo_camera(**setup):
    return MicroManagerCamera(load_core(DEMO), CameraSetup(**setup))


def demo_stage(axes=None, **setup):
    axes = axes or {"mask_x": "XY.x", "mask_y": "XY.y"}
    setup.setdefault("travel_um", dict.fromkeys(axes, TRAVEL_UM))
    return MicroManagerStage(load_core(DEMO), StageSetup(axes, **setup))


def places_in(frame):
    """Where the SequenceTester's devices were while its camera exposed the frame."""
    reported = decode_image(frame.mosaic.astype(np.uint8))
    return {(item.device, item.property): item.value for item in reported.current_state}


@pytest.fixture
def camera():
    with closing(demo_camera(bit_depth=12, roi=(0, 0, 64, 48))) as opened:
        yield opened


def test_a_camera_without_genicams_properties_has_no_trigger_and_others_keep_theirs():
    with closing(demo_camera()) as camera:
        for act in (
            lambda: camera.set_trigger("Line1", "rising", 1.0),
            lambda: camera.set_exposure_output("Line2"),
        ):
            with pytest.raises(CameraSettingError, match="does not exist"):
                act()
        assert camera.choices("NoSuchProperty") == ()
        assert "16bit" in camera.choices("PixelType")
        camera.choose("PixelType", "16bit")
        camera._loaded.reopen()
        assert camera.details()["PixelType"] == "16bit"


@pytest.mark.slow
def test_the_suite_finds_that_the_demo_stage_only_says_that_it_was_homed(tmp_path):
    file = tmp_path / "stage.yaml"
    file.write_text(
        f"{{protocol: mm, port: {DEMO}, axes: {{x: XY.x, y: XY.y}}, speed_property: Velocity,"
        " speed_unit_um_s: 1000, travel_um: {x: [-9000, 9000], y: [-9000, 9000]}}"
    )
    program = "from emmc_rig.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "devices", "conform", str(file), "--as", "stage", "--yes"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    failed = re.findall(r"::(test_\w+) FAILED", done.stdout)
    assert failed == ["test_homing_finds_the_same_place_again"], done.stdout
    assert done.stdout.count(" PASSED") == 10


def test_a_frame_is_what_the_core_gives_kept_as_a_file_that_decodes_to_it():
    with closing(demo_camera(bit_depth=12, black_level_dn=7)) as camera:
        camera.set_exposure_s(0.004)
        frame = camera.snap()
    assert frame.mosaic.shape == camera.shape == (512, 512)
    assert (frame.white_level_dn, frame.cfa, frame.exposure_s) == (4095, "mono", 0.004)
    assert frame.mosaic.std() > 10
    again = decode_raw(frame.original)
    np.testing.assert_array_equal(again.mosaic, frame.mosaic)
    assert (again.white_level_dn, again.black_level_dn[0, 0], again.cfa) == (4095, 7, "mono")
    assert again.metadata["model"] == "DemoCamera-MultiMode"


def test_binning_depth_and_properties_are_set_by_name():
    with closing(demo_camera(binning=2, bit_depth=8, properties={"Gain": 3})) as camera:
        assert camera.snap().mosaic.shape == camera.shape == (256, 256)
        assert camera.white_level_dn == 255
        assert camera.details()["Gain"] == "3"


def test_a_stage_says_which_adapter_moves_an_axis():
    with demo_stage() as stage:
        identity = stage.identity("mask_x")
        assert (identity.maker, identity.model) == ("DemoCamera", "DXYStage")


def test_a_camera_tells_its_temperatures_by_the_names_of_its_properties():
    with closing(demo_camera(properties={"CCDTemperature": -20})) as camera:
        assert camera.temperatures_c()["CCDTemperature"] == -20
        assert set(camera.temperatures_c()) <= set(camera.details())


@pytest.mark.parametrize(
    ("corner", "cfa"), [((0, 0), "rggb"), ((1, 0), "grbg"), ((0, 1), "gbrg"), ((5, 3), "bggr")]
)
def test_the_colours_of_a_region_follow_from_its_corner(corner, cfa):
    with closing(demo_camera(cfa="rggb", roi=(*corner, 40, 30))) as camera:
        frame = camera.snap()
        assert (camera.shape, frame.cfa) == ((30, 40), cfa)


@pytest.mark.parametrize(
    ("setup", "message"),
    [
        ({"binning": 3}, "it takes 1, 2, 4, 8"),
        ({"properties": {"Gian": 1}}, "does not exist; it has"),
        ({"properties": {"PixelType": "32bitRGB"}}, "set PixelType"),
        ({"cfa": "rggb", "binning": 2}, "different colours"),
        ({"roi": (0, 0, 16, 16)}, "smaller than 22 pixels"),
    ],
)
def test_what_the_camera_cannot_be_set_to_is_one_line(setup, message):
    with pytest.raises(CameraSettingError, match=message):
        demo_camera(**setup)


def test_a_camera_or_axis_that_the_configuration_lacks_is_named():
    with pytest.raises(MicroManagerError, match="no camera 'Cam2': name one of DHub, Camera"):
        demo_camera(label="Cam2")
    with pytest.raises(MicroManagerError, match=r"no axis 'XY.z' for mask_x: name one of XY.x"):
        demo_stage({"mask_x": "XY.z"})
    with pytest.raises(MicroManagerError, match="does not state the travel of mask_x"):
        demo_stage(travel_um={})


def test_a_stream_stops_when_it_is_closed_and_one_frame_can_be_taken_again():
    with closing(demo_camera(roi=(0, 0, 64, 64))) as camera:
        camera.set_exposure_s(0.001)
        stream = camera.stream()
        numbers = [int(frame.metadata["ImageNumber"]) for frame in islice(stream, 4)]
        assert numbers == [0, 1, 2, 3]
        with pytest.raises(CameraSettingError, match="runs already"):
            camera.snap()
        stream.close()
        camera.snap()
    with pytest.raises(CameraClosedError):
        camera.snap()


def elapsed_s(frame):
    return float(frame.metadata["ElapsedTime-ms"]) / 1e3


def test_the_time_of_a_streamed_frame_is_the_adapters_and_a_snapped_one_has_that_of_the_day():
    began = datetime.now().astimezone()
    with closing(demo_camera(roi=(0, 0, 64, 64))) as camera:
        camera.set_exposure_s(0.01)
        with closing(camera.stream()) as stream:
            frames = list(islice(stream, 5))
        frames.append(camera.snap())
    assert [frame.camera_time_s for frame in frames[:5]] == [elapsed_s(f) for f in frames[:5]]
    assert frames[5].camera_time_s is None
    for frame in frames:
        captured = captured_at(decode_raw(frame.original).metadata)
        assert captured is not None
        # A DNG holds milliseconds.
        assert began - timedelta(milliseconds=1) <= captured <= datetime.now().astimezone()


def test_an_image_without_a_usable_time_has_none():
    with closing(demo_camera(roi=(0, 0, 64, 64))) as camera:
        for stated in ("", "soon", "nan"):
            metadata = {"ElapsedTime-ms": stated, "TimeReceivedByCore": stated}
            assert camera._frame(np.zeros((64, 64)), metadata).camera_time_s is None


def test_camera_and_stage_of_one_file_share_a_core_until_both_are_closed():
    camera, stage = demo_camera(), demo_stage()
    camera.close()
    camera.close()
    stage.home()
    stage.close()
    stage.close()
    with pytest.raises(PortGoneError):
        stage.move_to_um({"mask_x": 0.0})


def test_an_axis_whose_home_nobody_knows_does_not_move():
    with closing(demo_stage()) as stage:
        with pytest.raises(NotHomedError):
            stage.move_to_um({"mask_x": 10.0})
        with pytest.raises(MicroManagerError, match="home mask_x and mask_y together"):
            stage.home(["mask_x"])
        stage.home()
        assert stage.move_to_um({"mask_x": 10.0})["mask_x"] == pytest.approx(10.0, abs=0.05)


def test_one_coordinate_moves_and_the_other_stays():
    with closing(demo_stage()) as stage:
        stage.home()
        stage.move_to_um({"mask_x": 40.0, "mask_y": -30.0})
        stage.move_to_um({"mask_x": 60.0})
        assert stage.position_um("mask_y") == pytest.approx(-30.0, abs=0.05)
        with pytest.raises(LimitExceededError):
            stage.move_to_um({"mask_y": 1001.0})


def test_the_speed_is_the_devices_where_its_property_is_named():
    named = {"speed_property": "Velocity", "speed_unit_um_s": 1000.0}
    with closing(demo_stage(**named)) as stage:
        stage.set_speed_um_s("mask_x", 2000.0)
        assert stage.speed_um_s("mask_x") == 2000.0
        stage.reconnect()
        assert stage.speed_um_s("mask_x") == 2000.0
    with closing(demo_stage()) as stage, pytest.raises(SpeedFixedError, match="speed_property"):
        stage.set_speed_um_s("mask_x", 2000.0)


def test_a_reload_restores_the_cameras_settings():
    camera, stage = demo_camera(binning=4), demo_stage()
    with closing(camera), closing(stage):
        camera.set_exposure_s(0.003)
        stage.reconnect()
        assert camera.snap().mosaic.shape == (128, 128)
        assert camera.exposure_s == 0.003


@pytest.fixture
def sequence_tester(tmp_path):
    config = tmp_path / "tester.cfg"
    config.write_text(SEQUENCE_TESTER)
    setup = StageSetup({"z": "Z"}, {"z": (0.0, 100.0)}, homes=False)
    camera = MicroManagerCamera(load_core(str(config)))
    with closing(camera), closing(MicroManagerStage(load_core(str(config)), setup)) as stage:
        camera.set_exposure_s(0.001)
        yield camera, stage


def test_the_stage_is_where_it_was_sent_when_the_camera_exposes(sequence_tester):
    camera, stage = sequence_tester
    for place_um in (20.0, 60.0, 30.0):
        stage.move_to_um({"z": place_um})
        assert places_in(camera.snap())["TZStage", "ZPositionUm"] == place_um


def test_an_encoder_that_knows_its_place_is_confirmed_after_a_reconnect(sequence_tester):
    _, stage = sequence_tester
    stage.move_to_um({"z": 40.0})
    stage.reconnect()
    with pytest.raises(NotHomedError, match="connection was lost"):
        stage.position_um("z")
    stage.home()
    assert stage.is_homed("z")
    stage.move_to_um({"z": 41.0})


def test_files_and_short_names_open_both_by_name(tmp_path):
    (tmp_path / "camera.yaml").write_text(f"{{driver: mm, address: {DEMO}, binning: 4}}")
    (tmp_path / "stage.yaml").write_text(
        f"{{protocol: mm, port: {DEMO}, axes: {{mask_x: XY.x, mask_y: XY.y}},"
        " travel_um: {mask_x: [0, 900], mask_y: [0, 900]}}"
    )
    with closing(open_camera(f"mm:{DEMO}")) as camera:
        assert camera.shape == (512, 512)
    with closing(open_camera(str(tmp_path / "camera.yaml"))) as camera:
        assert camera.shape == (128, 128)
    with open_stage(str(tmp_path / "stage.yaml")) as stage:
        assert stage.limits_um("mask_y") == (10.0, 900.0)
    (tmp_path / "wrong.yaml").write_text(f"{{kind: mm, address: {DEMO}, binnig: 4}}")
    with pytest.raises(AppError, match="did you mean 'binning'"):
        open_camera(str(tmp_path / "wrong.yaml"))
    with pytest.raises(MicroManagerError, match="cannot be loaded"):
        open_camera("mm:no-such.cfg")

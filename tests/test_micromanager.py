"""Micro-Manager both ways: its devices in our rig, and our rig's devices in its core.

Needs the extra `micromanager`, whose mm-test-adapters bring a core's demo devices and its
SequenceTester, a camera whose pixels spell out where every device was during the exposure.
"""

import re
import subprocess
import sys
from contextlib import ExitStack, closing
from itertools import islice
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pymmcore_plus", reason="the extra `micromanager` is not installed")
pytest.importorskip("mm_test_adapters", reason="the extra `micromanager` is not installed")

import useq
from pymmcore_plus.experimental.unicore import UniMMCore
from pymmcore_plus.seq_tester import decode_image
from stage_rigs import ZaberRig

from drivers.errors import (
    CameraClosedError,
    CameraSettingError,
    LimitExceededError,
    MicroManagerError,
    NotHomedError,
    PortGoneError,
    SpeedFixedError,
)
from drivers.micromanager import (
    CameraSetup,
    MicroManagerCamera,
    MicroManagerStage,
    StageSetup,
    load_core,
)
from drivers.raw import decode_raw
from drivers.unicore import load_rig
from emmc_rig.bench.hardware import open_camera, open_stage, simulated_rig
from emmc_rig.conformance.cameras import *  # noqa: F403
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from simulators.clock import ManualClock
from simulators.ptp import PtpCameraSimulator, PtpUsbFunction
from simulators.usb import SimulatedUsb

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
Property,Z,TriggerSequenceMaxLength,20
Property,Z,TriggerSourceDevice,TCamera
Property,Z,TriggerSourcePort,ExposureStartEdge
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
    return {(one.device, one.property): one.value for one in reported.current_state}


@pytest.fixture
def camera():
    with closing(demo_camera(bit_depth=12, roi=(0, 0, 64, 48))) as opened:
        yield opened


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


def test_a_hardware_sequence_exposes_a_frame_at_every_place(sequence_tester):
    camera, stage = sequence_tester
    places_um = [20.0, 25.0, 30.0, 47.5]
    seen = [places_in(frame) for frame in camera.triggered(stage, "z", places_um)]
    assert [one["TZStage", "ZPositionUm"] for one in seen] == places_um
    camera.snap()


def test_a_hardware_sequence_is_refused_where_the_device_says_no(sequence_tester):
    camera, stage = sequence_tester
    with pytest.raises(CameraSettingError, match="takes 20 places along z"):
        next(camera.triggered(stage, "z", list(range(20, 41))))
    with pytest.raises(ValueError, match="ascend"):
        next(camera.triggered(stage, "z", [20.0, 19.0]))
    with pytest.raises(LimitExceededError):
        next(camera.triggered(stage, "z", [90.0, 101.0]))
    with closing(demo_stage()) as other:
        assert other.sequence_length("mask_x") == 0


def test_files_and_short_names_open_both_by_name(tmp_path):
    (tmp_path / "camera.yaml").write_text(f"{{kind: mm, address: {DEMO}, binning: 4}}")
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


@pytest.fixture
def our_rig(tmp_path):
    """A core whose camera and stages are ours: simulated PTP over USB, and Zaber on its wire."""
    with ExitStack() as opened:
        rig = ZaberRig("memory", opened, tmp_path)
        stage: Any = rig.make_stage()
        seen_um = []

        def see(exposure_s):
            seen_um.append((rig.true_um("mask_x"), rig.true_um("mask_y"), exposure_s))
            return np.full((40, 48), len(seen_um), np.uint16)

        clock = ManualClock()
        bus = SimulatedUsb(clock, PtpUsbFunction(PtpCameraSimulator(see, clock, "grbg")))
        camera = open_camera("ptp:", clock, bus)
        core = UniMMCore()
        opened.callback(core.unloadAllDevices)
        opened.callback(camera.close)
        load_rig(core, camera, stage, {"XY": ("mask_x", "mask_y"), "Z": ("mask_y",)})
        yield core, seen_um


def test_a_core_drives_our_stage_and_camera(our_rig):
    core, seen_um = our_rig
    with pytest.raises(NotHomedError):
        core.setXYPosition(5000.0, 6000.0)
    core.home("XY")
    core.setXYPosition(5000.0, 6000.0)
    assert core.getXYPosition() == pytest.approx((5000.0, 6000.0), abs=0.1)
    core.setPosition("Z", 6500.0)
    assert core.getPosition("Z") == pytest.approx(6500.0, abs=0.1)
    with pytest.raises(LimitExceededError):
        core.setXYPosition(1e9, 0.0)
    with pytest.raises(NotImplementedError, match="home it"):
        core.setOriginX("XY")
    core.stop("XY")
    core.setExposure(8.0)
    core.setProperty("Camera", "Gain", 2)
    core.snapImage()
    image = core.getImage()
    assert (image.shape, image.dtype) == ((40, 48), np.uint16)
    assert seen_um[-1] == (pytest.approx(5000.0, abs=1.0), pytest.approx(6500.0, abs=1.0), 0.008)


def test_a_useq_sequence_runs_against_our_rig(our_rig):
    core, seen_um = our_rig
    core.home("XY")
    places = [(5000.0, 6000.0), (5100.0, 6000.0), (5100.0, 6200.0)]
    plan = useq.MDASequence.model_validate(
        {"stage_positions": places, "time_plan": {"interval": 0, "loops": 2}, "axis_order": "tp"}
    )
    taken = []
    core.mda.events.frameReady.connect(
        lambda image, event, metadata: taken.append((event.x_pos, event.y_pos, image[0, 0]))
    )
    core.setExposure(8.0)
    core.mda.run(plan)
    assert [(x, y) for x, y, _ in taken] == places * 2
    exposed = [seen_um[number - 1] for _, _, number in taken]
    np.testing.assert_allclose([one[:2] for one in exposed], places * 2, atol=1.0)


def test_our_camera_through_a_core_and_back_gives_the_same_mosaic(our_rig):
    core, _ = our_rig
    core.snapImage()
    direct = core.getImage()
    assert (direct == direct[0, 0]).all()
    core.startSequenceAcquisition(3, 0, True)
    while core.isSequenceRunning():
        pass
    numbers = [int(core.popNextImage()[0, 0]) for _ in range(3)]
    assert numbers == [int(direct[0, 0]) + n for n in (1, 2, 3)]


def test_the_whole_simulated_rig_runs_a_sequence_of_mask_places():
    design = Camera.model_validate(
        {
            "title": "test",
            "views": (3, 3),
            "sensor": {"cfa": "rggb"},
            "masks": {
                "m": {
                    "distance_mm": 0.24,
                    "cell_um": 24.0,
                    "pattern": {"kind": "random_rgbw", "seed": 0},
                }
            },
            "more_shots_step_um": {"m": (72, 48)},
        }
    )
    scene = np.full((6, 6, 96, 128, 3), 0.5, np.float32)
    rig, _ = simulated_rig(design, scene, (24, 32), seed=0, rays_per_view=16)
    with closing(rig.camera), closing(rig.stage):
        rig.attendant.set_lamp("white")
        rig.attendant.place("scene")
        rig.attendant.fit_masks(0)
        rig.stage.home()
        rig.stage.move_to_um({"aperture_x": rig.zero_um["aperture_x"] + rig.window_um})
        core = UniMMCore()
        load_rig(core, rig.camera, rig.stage, {"XY": ("mask_x", "mask_y")})
        centre = (rig.zero_um["mask_x"], rig.zero_um["mask_y"])
        frames = []
        core.mda.events.frameReady.connect(lambda image, event, metadata: frames.append(image))
        places = [centre, (centre[0] + 72, centre[1])]
        core.mda.run(useq.MDASequence.model_validate({"stage_positions": places}))
        core.unloadAllDevices()
    assert len(frames) == 2
    assert frames[0].shape == (24, 32)
    assert np.abs(frames[0].astype(float) - frames[1]).mean() > 5

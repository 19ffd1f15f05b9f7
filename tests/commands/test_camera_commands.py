"""The camera commands on simulated cameras: what is saved, where, and what a bad wish brings."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from emmc_rig.bench import hardware
from emmc_rig.bench.hardware import open_camera, scene_simulator
from emmc_rig.commands import device_cameras
from emmc_rig.commands.device_cameras import register, save_frame
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.errors import DriverError, RawFrameError, UsbNotFoundError
from emmc_rig.drivers.folder import FolderCamera
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.errors import AppError, WrongUsageError
from emmc_rig.report.frame_view import brightest, histogram, preview, white_balance
from emmc_rig.session.brightness import figures, level_of
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.ptp import PtpUsbFunction
from emmc_rig.simulators.usb import SimulatedUsb

BLACK, WHITE = 100, 1100


def frame_of(mosaic, cfa="rggb"):
    return decode_raw(encode_dng(np.asarray(mosaic, np.uint16), cfa, BLACK, WHITE, 0.01))


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Run a command in an empty folder, on a clock that makes its exposures take no time."""
    clock = ManualClock()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        device_cameras, "open_camera", lambda spec: open_camera(spec, clock, SimulatedUsb(clock))
    )
    app = typer.Typer()
    register(app)

    def invoke(*arguments):
        return CliRunner().invoke(app, arguments)

    return invoke


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_info_names_the_camera_and_what_it_can_do(run):
    shown = run("camera", "--camera", "simulated").output
    for text in ("EMMC simulated camera", "from 0.0002 to 30 s", "from 1 to 16", "87 %", "GB free"):
        assert text in shown


def test_snap_saves_the_cameras_bytes_a_preview_and_the_facts(run, tmp_path):
    done = run(
        *("snap", "--camera", "simulated", "--exposure", "30ms", "--gain", "2", "--out", "frames")
    )
    assert done.exit_code == 0, done.output
    assert files(tmp_path) == [f"frames/frame-0001{s}" for s in (".dng", ".json", ".png")]
    facts = json.loads((tmp_path / "frames/frame-0001.json").read_text())
    frame = decode_raw((tmp_path / "frames/frame-0001.dng").read_bytes())
    assert facts["sha256"] == frame.sha256
    assert facts["exposure_s"] == pytest.approx(0.0333)
    assert facts["gain"] == 2
    picture = cv2.imread(str(tmp_path / "frames/frame-0001.png"))
    assert picture is not None
    assert picture.shape == (120, 160, 3)


def test_frames_are_numbered_on_and_never_overwritten(run, tmp_path):
    run("snap", "--camera", "simulated", "--count", "2", "--out", "frames")
    before = (tmp_path / "frames/frame-0001.dng").read_bytes()
    run("snap", "--camera", "simulated", "--out", "frames")
    assert [name for name in files(tmp_path) if name.endswith(".dng")] == [
        f"frames/frame-000{n}.dng" for n in (1, 2, 3)
    ]
    assert (tmp_path / "frames/frame-0001.dng").read_bytes() == before


def test_what_was_saved_can_be_replayed_by_the_same_command(run, tmp_path):
    run("snap", "--camera", "simulated", "--count", "2", "--out", "frames")
    done = run("snap", "--camera", "folder:frames", "--count", "2", "--out", "again")
    assert done.exit_code == 0, done.output
    for number in (1, 2):
        name = f"frame-000{number}.dng"
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "frames" / name).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("camera", "--camera", "ptp:"), UsbNotFoundError, "no PTP camera on USB"),
        (("camera", "--camera", "ptp:9"), UsbNotFoundError, "serial 9"),
        (("camera", "--camera", "webcam"), AppError, "use ptp:"),
        (("snap", "--camera", "folder:nowhere"), DriverError, "nowhere"),
        (("snap", "--camera", "simulated", "--exposure", "0"), WrongUsageError, "0.02, 20ms"),
        (("snap", "--camera", "simulated", "--exposure", "soon"), WrongUsageError, "in seconds"),
        (("snap", "--camera", "simulated", "--exposure", "1e9"), DriverError, "0.0002 to 30"),
        (("snap", "--camera", "simulated", "--out", "file"), AppError, "cannot be made"),
    ],
)
def test_a_bad_wish_is_one_line(run, tmp_path, arguments, error, message):
    (tmp_path / "file").write_text("here first")
    done = run(*arguments)
    assert isinstance(done.exception, error)
    assert message in str(done.exception)
    assert "\n" not in str(done.exception)


def test_ctrl_c_in_a_download_leaves_no_file_and_frees_the_camera(tmp_path, monkeypatch):
    clock = ManualClock()
    function = PtpUsbFunction(scene_simulator(clock))
    bus = SimulatedUsb(clock, function)
    camera: Any = open_camera("ptp:S1", clock, bus)

    def interrupt(done, size):
        raise KeyboardInterrupt

    camera.on_progress = interrupt
    monkeypatch.setattr(device_cameras, "open_camera", lambda spec: camera)
    app = typer.Typer()
    register(app)
    done = CliRunner().invoke(app, ["snap", "--out", str(tmp_path / "frames")])
    assert done.exit_code != 0
    assert files(tmp_path) == []
    assert function.camera.session == 0
    assert open_camera("ptp:", clock, bus).snap().mosaic.shape == hardware.SCENE_SIZE


def test_a_disk_that_fails_leaves_no_half_written_file(tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(AppError, match="No space left"):
        save_frame(tmp_path, frame_of(np.full((40, 40), 500)))
    assert files(tmp_path) == []


def test_a_name_from_the_camera_never_leaves_the_folder(tmp_path):
    frame = frame_of(np.full((40, 40), 500))
    frame = type(frame)(**{**frame.__dict__, "metadata": {"name": "../../etc/passwd.nef/x"}})
    assert save_frame(tmp_path / ".", frame) == tmp_path / "frame-0001.dng"
    assert len(files(tmp_path)) == 3


def test_half_the_light_is_half_way_to_white():
    mosaic = np.full((40, 40), BLACK + 500)
    frame = frame_of(mosaic)
    assert brightest(frame) == pytest.approx({"red": 0.5, "green": 0.5, "blue": 0.5})
    assert level_of(frame, figures(frame)) == pytest.approx(0.5)
    assert figures(frame).saturated == 0


def test_the_saturated_share_counts_pixels_at_white():
    mosaic = np.full((40, 40), BLACK)
    mosaic[:10] = WHITE
    assert figures(frame_of(mosaic)).saturated == 0.25


@pytest.mark.parametrize(
    ("cfa", "colours"),
    [("grbg", {"red", "green", "blue"}), ("mono", {"grey"}), ("xtrans", {"grey"})],
)
def test_a_histogram_counts_every_pixel_once(cfa, colours):
    mosaic = np.random.default_rng(0).integers(BLACK, WHITE, (41, 43), endpoint=True)
    counts = histogram(frame_of(mosaic, cfa))
    assert set(counts) == colours
    assert sum(row.sum() for row in counts.values()) == 41 * 43


@pytest.mark.parametrize("cfa", ["rggb", "grbg", "gbrg", "bggr"])
def test_a_preview_shows_each_colour_where_it_is(cfa):
    mosaic = np.full((40, 40), BLACK)
    at = cfa.index("r")
    mosaic[at // 2 :: 2, at % 2 :: 2] = WHITE
    picture = preview(frame_of(mosaic, cfa))
    assert picture.shape == (20, 20, 3)
    assert (picture == [0, 0, 255]).all()


def test_a_whiteboard_s_balance_makes_it_grey_and_leaves_green():
    mosaic = np.tile(np.array([[400, 1000], [1000, 700]], np.uint16), (16, 16))
    board = frame_of(mosaic, "rggb")
    blue, green, red = white_balance(board)
    black = float(board.black_level_dn.mean())
    assert green == 1
    assert red == pytest.approx((1000 - black) / (400 - black))
    assert blue == pytest.approx((1000 - black) / (700 - black))
    assert np.ptp(preview(board, (blue, green, red)).astype(int), axis=-1).max() <= 1
    assert white_balance(frame_of(mosaic, "mono")) == (1, 1, 1)


def test_a_large_frame_has_a_small_preview():
    assert max(preview(frame_of(np.full((40, 4000), 600), "mono")).shape) == 1600


def test_replay_stops_at_the_end_and_passes_over_what_is_damaged(tmp_path):
    mosaics = [np.full((40, 40), 200 + n) for n in range(3)]
    for number, mosaic in zip((1, 2, 10), mosaics, strict=True):
        (tmp_path / f"shot-{number}.dng").write_bytes(frame_of(mosaic).original)
    torn = tmp_path / "shot-2.dng"
    torn.write_bytes(torn.read_bytes()[:-100])
    (tmp_path / "notes.txt").write_text("no frame")
    camera = FolderCamera(tmp_path, SYSTEM_CLOCK)
    np.testing.assert_array_equal(camera.snap().mosaic, mosaics[0])
    with pytest.raises(RawFrameError, match=r"shot-2\.dng: it is torn"):
        camera.snap()
    np.testing.assert_array_equal(camera.snap().mosaic, mosaics[2])
    with pytest.raises(DriverError, match="all its 3 frames were replayed"):
        camera.snap()


def test_a_recording_accepts_its_own_exposures_only(tmp_path):
    (tmp_path / "a.dng").write_bytes(frame_of(np.full((40, 40), 200)).original)
    camera = FolderCamera(tmp_path)
    camera.set_exposure_s(0.0103)
    with pytest.raises(DriverError, match=r"was 0\.01 s when this was recorded"):
        camera.set_exposure_s(0.02)


@pytest.mark.parametrize("what", ["empty", "missing"])
def test_a_folder_without_frames_is_refused(tmp_path, what):
    folder = tmp_path if what == "empty" else tmp_path / "nowhere"
    with pytest.raises(DriverError, match=str(Path(folder).name)):
        FolderCamera(folder)

"""A PTP camera over simulated USB: right frames, and for every fault one clear line or a cure."""

import math
from datetime import timedelta

import numpy as np
import pytest

from emmc_rig.drivers.errors import (
    CameraBusyError,
    CameraFormatError,
    CameraRefusedError,
    CameraSettingError,
    CaptureError,
    CardFullError,
    DownloadError,
    ExposureStoppedError,
    RawFrameError,
    UsbGoneError,
    UsbTimeoutError,
)
from emmc_rig.drivers.ptp import PtpCamera, PtpSession, PtpSettings, is_raw
from emmc_rig.drivers.ptp_codec import Format, ObjectInfo, Operation
from emmc_rig.drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from emmc_rig.drivers.raw import captured_at
from emmc_rig.drivers.usb import open_device
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.ptp import ANY_EXPOSURE, EPOCH, PtpCameraSimulator, PtpUsbFunction
from emmc_rig.simulators.usb import SimulatedUsb

SHAPE = (60, 80)


class Bench:
    """A camera on a simulated bus, whose every exposure shows another mosaic."""

    def __init__(self, settings=None, packet_size=512, **options):
        self.clock = ManualClock()
        self.exposed = []
        self.simulator = PtpCameraSimulator(self.see, self.clock, **options)
        self.function = PtpUsbFunction(self.simulator, packet_size)
        self.bus = SimulatedUsb(self.clock, self.function)
        self.settings = settings

    def see(self, exposure_s):
        generator = np.random.default_rng(len(self.exposed))
        self.exposed.append(generator.integers(0, 4095, SHAPE, dtype=np.uint16))
        return self.exposed[-1]

    @property
    def faults(self):
        return self.simulator.faults

    def open(self, **options):
        device = open_device(PTP_INTERFACE, backend=self.bus)
        session = PtpSession(PtpUsb(device, self.clock), self.clock, self.settings)
        return PtpCamera(session, **options)

    def snap_is_good(self, camera):
        frame = camera.snap()
        np.testing.assert_array_equal(frame.mosaic, self.exposed[-1])
        return frame


@pytest.fixture
def bench():
    return Bench()


def test_each_frame_is_the_one_just_exposed(bench):
    camera = bench.open()
    names = [bench.snap_is_good(camera).metadata["name"] for _ in range(3)]
    assert names == ["EMMC0001.DNG", "EMMC0002.DNG", "EMMC0003.DNG"]


def test_size_and_colours_follow_from_the_first_frame(bench):
    camera = bench.open()
    assert camera.shape == SHAPE
    assert camera.cfa == "rggb"
    assert len(bench.exposed) == 1


def test_a_stated_size_needs_no_frame(bench):
    camera = bench.open(shape=SHAPE, cfa="rggb")
    assert (camera.shape, camera.cfa) == (SHAPE, "rggb")
    assert not bench.exposed


@pytest.mark.parametrize(
    ("asked_s", "taken_s"), [(0.01, 0.008), (0.05, 0.0667), (30.0, 30.0), (1 / 1000, 0.001)]
)
def test_an_exposure_becomes_the_nearest_that_the_camera_has(bench, asked_s, taken_s):
    camera = bench.open()
    camera.set_exposure_s(asked_s)
    assert camera.exposure_s == pytest.approx(taken_s)
    assert bench.snap_is_good(camera).exposure_s == pytest.approx(taken_s)


def test_a_range_is_taken_in_its_steps():
    camera = Bench(span=ANY_EXPOSURE).open()
    camera.set_exposure_s(0.123_46)
    assert camera.exposure_s == pytest.approx(0.1235)


def test_the_exposure_takes_its_time(bench):
    camera = bench.open()
    camera.set_exposure_s(8.0)
    before_s = bench.clock.now_s()
    camera.snap()
    assert 8.0 <= bench.clock.now_s() - before_s < 9.0


def test_an_exposure_that_is_broken_off_is_over_at_once_and_the_next_is_a_new_one(
    bench, monkeypatch
):
    camera = bench.open()
    camera.set_exposure_s(30.0)
    before_s, pass_time = bench.clock.now_s(), bench.clock.sleep

    def sleep(duration_s):
        pass_time(duration_s)
        if bench.clock.now_s() - before_s > 3:
            assert camera.stop_exposure()

    monkeypatch.setattr(bench.clock, "sleep", sleep)
    with pytest.raises(ExposureStoppedError):
        camera.snap()
    assert 3 < bench.clock.now_s() - before_s < 4
    monkeypatch.setattr(bench.clock, "sleep", pass_time)
    camera.set_exposure_s(0.1)
    bench.snap_is_good(camera)
    assert bench.clock.now_s() - before_s < 8


def test_a_camera_that_keeps_its_own_exposure_is_taken_at_its_word(bench):
    camera = bench.open()
    before_s = camera.exposure_s
    bench.faults.inject("stuck_exposure")
    camera.set_exposure_s(1.0)
    assert camera.exposure_s == before_s
    assert bench.snap_is_good(camera).exposure_s == pytest.approx(before_s)


def test_gain_is_iso_over_the_lowest_and_acts_above_the_black_level(bench):
    bench.see = None
    bench.simulator._render = lambda exposure_s: np.full(SHAPE, 164, np.uint16)
    camera = bench.open()
    assert camera.gain_limits == (1.0, 16.0)
    camera.set_gain(3.0)
    assert camera.gain == 4.0
    frame = camera.snap()
    assert frame.gain == 4.0
    assert (frame.mosaic == 64 + 4 * 100).all()


def test_a_file_states_the_time_by_the_cameras_clock_its_serial_number_and_iso(bench):
    camera = bench.open()
    camera.set_gain(4.0)
    metadata = camera.snap().metadata
    assert (metadata["serial"], metadata["iso"]) == (camera.identity.serial, "400")
    captured = captured_at(metadata)
    assert captured is not None
    now = EPOCH + timedelta(seconds=bench.clock.now_s())
    assert timedelta(0) <= now - captured < timedelta(seconds=1)


def test_the_camera_reports_its_time_and_battery(bench):
    camera = bench.open()
    first, second = camera.snap(), camera.snap()
    assert second.camera_time_s >= first.camera_time_s > 1.7e9
    assert camera.details()["battery"] == "87 %"


@pytest.mark.parametrize("packet_size", [64, 512, 1024])
def test_pictures_arrive_whole(packet_size):
    bench = Bench(packet_size=packet_size)
    bench.snap_is_good(bench.open())


def test_progress_is_reported_to_the_end(bench):
    seen = []
    camera = bench.open()
    camera.on_progress = lambda done, size: seen.append((done, size))
    frame = camera.snap()
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1] == (len(frame.original), len(frame.original))


def test_of_a_pair_the_raw_file_is_taken():
    bench = Bench(quality="raw+jpeg")
    camera = bench.open()
    for number in (1, 2, 3):
        assert bench.snap_is_good(camera).metadata["name"] == f"EMMC000{number}.DNG"


def test_a_camera_set_to_jpeg_is_refused_with_what_to_set():
    bench = Bench(quality="jpeg")
    with pytest.raises(CaptureError, match=r"EMMC0001\.JPG: set its image quality to RAW"):
        bench.open().snap()


def test_pictures_stay_on_the_card_unless_the_raw_ones_are_to_go():
    bench = Bench(quality="raw+jpeg")
    camera = bench.open()
    camera.snap()
    assert len(bench.simulator.objects) == 3
    camera.close()
    bench.open(from_card=True).snap()
    names = [info.name for info, _ in bench.simulator.objects.values()]
    assert names == ["100EMMC", "EMMC0001.JPG", "EMMC0001.DNG", "EMMC0002.JPG"]


@pytest.mark.parametrize(
    ("name", "kind", "format_", "raw"),
    [
        ("A.DNG", "dng", Format.DNG, True),
        ("DSC_0001.NEF", "nef", Format.UNDEFINED, True),
        ("IMG_0001.CR3", "cr3", 0xB108, True),
        ("IMG_0001.JPG", "jpg", Format.JPEG, False),
        ("MVI_0001.MOV", "mov", Format.UNDEFINED, False),
        ("noname", "", 0xB101, False),
    ],
)
def test_raw_files_are_recognised_by_format_or_name(name, kind, format_, raw):
    assert is_raw(ObjectInfo(storage=1, format=format_, size=100, parent=0, name=name)) is raw


CURED = {
    "busy": 3,
    "drop_event": 2,
    "duplicate_event": 2,
    "drop_complete": 1,
    "stall_in_download": 1,
    "lost_bytes": 1,
}


@pytest.mark.parametrize(("fault", "times"), CURED.items())
def test_the_driver_makes_up_for(fault, times):
    bench = Bench()
    camera = bench.open()
    bench.faults.inject(fault, times)
    bench.snap_is_good(camera)
    assert not bench.faults.strikes(fault), "the fault never struck"
    bench.snap_is_good(camera)


@pytest.mark.parametrize(
    ("fault", "times", "error", "message"),
    [
        ("torn_raw", 1, RawFrameError, "torn"),
        ("wrong_size", 1, RawFrameError, "58x80 pixels"),
        ("busy", math.inf, CameraBusyError, r"busy for 10\.\d s .*battery"),
        ("late", 1, CaptureError, "nothing new on the card"),
        ("silent", 1, UsbTimeoutError, "silent for 5 s"),
        ("garbled_header", 1, CameraFormatError, "garbled"),
        ("card_full", 1, CardFullError, "full or missing"),
        ("lost_bytes", math.inf, DownloadError, "still on the card"),
        ("stall_in_download", math.inf, DownloadError, "stalled"),
    ],
)
def test_a_fault_is_one_clear_line_and_the_camera_is_good_again(fault, times, error, message):
    bench = Bench()
    camera = bench.open(shape=SHAPE)
    bench.faults.inject(fault, times)
    started_s = bench.clock.now_s()
    with pytest.raises(error, match=message) as caught:
        camera.snap()
    assert "\n" not in str(caught.value)
    assert bench.clock.now_s() - started_s < 60
    bench.faults.clear()
    if fault == "late":
        bench.clock.sleep(60.0)
    bench.snap_is_good(camera)


def test_a_picture_that_comes_too_late_does_not_pass_for_the_next(bench):
    camera = bench.open()
    bench.faults.inject("late")
    with pytest.raises(CaptureError):
        camera.snap()
    bench.clock.sleep(60.0)
    assert len(bench.exposed) == 0
    frame = bench.snap_is_good(camera)
    assert len(bench.exposed) == 2
    assert frame.metadata["name"] == "EMMC0002.DNG"


def test_a_camera_unplugged_in_the_middle_is_gone_and_works_when_it_is_back(bench):
    camera = bench.open()
    bench.faults.inject("unplug_in_download")
    with pytest.raises(UsbGoneError, match="plug it in"):
        camera.snap()
    with pytest.raises(UsbGoneError):
        camera.snap()
    camera.close()
    bench.bus.plug(bench.function)
    bench.snap_is_good(bench.open())


def test_a_session_that_somebody_left_open_is_ended(bench):
    bench.simulator.session = 77
    bench.snap_is_good(bench.open())


def test_an_exchange_that_an_earlier_program_left_in_the_pipes_is_cleared(bench):
    first = bench.open()
    bench.faults.inject("stall_in_download", math.inf)
    first.session.settings = PtpSettings(attempts=1)
    with pytest.raises(DownloadError):
        first.snap()
    bench.faults.clear()
    first.session._transport.close()
    bench.snap_is_good(bench.open())


@pytest.mark.parametrize("at", [0, 1])
def test_ctrl_c_in_a_download_leaves_a_usable_camera(bench, at):
    camera = bench.open()
    calls = []

    def interrupt(done, size):
        calls.append(done)
        if len(calls) > at:
            raise KeyboardInterrupt

    camera.on_progress = interrupt
    with pytest.raises(KeyboardInterrupt):
        camera.snap()
    camera.on_progress = lambda done, size: None
    bench.snap_is_good(camera)


def test_a_closed_camera_can_be_opened_by_the_next_program(bench):
    with bench.open() as camera:
        camera.snap()
    assert bench.simulator.session == 0
    bench.snap_is_good(bench.open())


def test_a_card_that_fills_up_is_an_error_and_emptying_it_helps():
    bench = Bench(capacity_bytes=15_000)
    camera = bench.open()
    camera.snap()
    camera.snap()
    with pytest.raises(CardFullError):
        camera.snap()
    bench.simulator.objects.clear()
    bench.snap_is_good(camera)


def test_a_picture_deleted_on_the_camera_is_refused_with_advice(bench):
    session = bench.open().session
    with pytest.raises(CameraRefusedError, match="invalid handle: the picture is gone"):
        session.download(
            99, ObjectInfo(storage=1, format=Format.DNG, size=100, parent=0, name="X.DNG")
        )


def test_a_camera_that_cannot_be_released_says_so():
    bench = Bench(lacks=(Operation.INITIATE_CAPTURE,))
    with pytest.raises(CameraRefusedError, match=r"initiate capture.*PC remote"):
        bench.open()


def test_a_frame_of_other_colours_or_exposure_is_refused(bench):
    with pytest.raises(RawFrameError, match="rggb instead of bggr"):
        bench.open(cfa="bggr").snap()


def test_a_setting_that_the_camera_lacks_is_said_to_be_set_by_hand(bench):
    bench.simulator._values = {}
    camera = bench.open()
    with pytest.raises(CameraSettingError, match="not reported over PTP"):
        camera.set_exposure_s(0.1)
    assert camera.gain_limits == (1.0, 1.0)

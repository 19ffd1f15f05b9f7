"""Cameras that release by their makers' own operations: Canon EOS and Sony Alpha."""

import struct
from contextlib import closing
from functools import partial

import numpy as np
import pytest
from simulated_eos import EosCameraSimulator
from simulated_sony import SonyCameraSimulator

from drivers.errors import (
    CameraFormatError,
    CameraRefusedError,
    CameraSettingError,
    CaptureError,
)
from drivers.ptp import PtpCamera, PtpSession
from drivers.ptp_canon import EosOperation, EosProperty, iso, records, shutter_s
from drivers.ptp_codec import Operation
from drivers.ptp_sony import SonyOperation
from drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from drivers.usb import open_device
from simulators.clock import ManualClock
from simulators.ptp import PtpCameraSimulator, PtpUsbFunction
from simulators.usb import SimulatedUsb

MOSAIC = np.random.default_rng(5).integers(0, 4095, (40, 48), dtype=np.uint16)
EOS = {"new": EosCameraSimulator, "old": partial(EosCameraSimulator, old=True)}


class Bench:
    """A simulated camera of a maker on a bus, what it was asked, and what it exposed for."""

    def __init__(self, make):
        self.clock = ManualClock()
        self.exposed_s = []
        self.body = make(self.see, self.clock, "rggb")
        self.asked = []
        respond = self.body.respond

        def noted(request, data):
            self.asked.append((request.code, request.parameters))
            return respond(request, data)

        self.body.respond = noted
        self.bus = SimulatedUsb(self.clock, PtpUsbFunction(self.body))

    def see(self, exposure_s):
        self.exposed_s.append(exposure_s)
        return MOSAIC

    def open(self, **settings):
        device = open_device(PTP_INTERFACE, backend=self.bus)
        return closing(PtpCamera(PtpSession(PtpUsb(device, self.clock), self.clock), **settings))

    def codes(self):
        return [code for code, _ in self.asked]


@pytest.fixture(params=EOS)
def eos(request):
    return Bench(EOS[request.param])


@pytest.mark.parametrize("sessions", [1, 2])
def test_an_eos_exposes_by_its_own_release_in_every_session(eos, sessions):
    for _ in range(sessions):
        with eos.open() as camera:
            camera.set_exposure_s(1 / 60)
            for _ in range(2):
                frame = camera.snap()
                np.testing.assert_array_equal(frame.mosaic, MOSAIC)
    assert len(eos.exposed_s) == 2 * sessions
    assert eos.exposed_s == pytest.approx([1 / 64] * 2 * sessions, rel=0.02)
    assert Operation.INITIATE_CAPTURE not in eos.codes()


def test_the_button_is_pressed_in_two_stages_and_let_go():
    bench = Bench(EosCameraSimulator)
    with bench.open() as camera:
        bench.asked.clear()
        camera.snap()
    buttons = [(code, p[0]) for code, p in bench.asked if code in (0x9128, 0x9129)]
    assert buttons == [(0x9128, 1), (0x9128, 2), (0x9129, 2), (0x9129, 1)]


def test_the_button_is_let_go_when_the_release_breaks_off():
    bench = Bench(EosCameraSimulator)
    with bench.open() as camera:
        bench.body.faults.inject("card_full")
        with pytest.raises(Exception, match="full"):
            camera.snap()
        assert bench.asked[-2:] == [(0x9129, (2,)), (0x9129, (1,))]
        np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


def test_an_old_eos_says_why_it_did_not_release():
    bench = Bench(EOS["old"])
    with bench.open() as camera:
        bench.body.focus = False
        with pytest.raises(CaptureError, match="could not focus: switch the lens to manual"):
            camera.snap()
        bench.body.focus = True
        bench.body.faults.inject("card_full")
        with pytest.raises(CaptureError, match="card is full: make room"):
            camera.snap()
        np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


def test_a_new_eos_that_finds_no_focus_is_an_error_that_says_so():
    bench = Bench(EosCameraSimulator)
    bench.body.focus = False
    with bench.open() as camera, pytest.raises(CaptureError, match="check focus"):
        camera.snap()


def test_an_event_that_never_comes_is_made_up_for_by_the_card(eos):
    eos.body._queue_event = lambda *event: None
    with eos.open() as camera:
        np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


def test_of_raw_with_jpeg_the_raw_file_is_taken_and_both_leave_the_card(eos):
    eos.body.quality = "raw+jpeg"
    with eos.open(from_card=True) as camera:
        np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)
    assert not any(data for _, data in eos.body.objects.values())


def test_the_limits_are_those_of_the_cameras_codes_and_automatic_is_none_of_them(eos):
    with eos.open() as camera:
        assert camera.exposure_limits_s == pytest.approx((1 / 4096, 32))
        assert camera.gain_limits == pytest.approx((1, 16))
        camera.set_gain(4)
        assert camera.gain == pytest.approx(4)


def test_a_setting_that_the_camera_does_not_take_is_seen_in_what_it_says(eos):
    with eos.open() as camera:
        before_s = camera.exposure_s
        eos.body.faults.inject("stuck_exposure")
        camera.set_exposure_s(2.0)
        assert camera.exposure_s == before_s


def test_a_camera_that_sends_pictures_to_the_computer_is_set_to_use_its_card():
    bench = Bench(EosCameraSimulator)
    destination = EosProperty.CAPTURE_DESTINATION
    bench.body._codes[destination] = 4
    with bench.open():
        assert bench.body._codes[destination] == 2


@pytest.mark.parametrize(
    ("code", "nominal_s"),
    [
        (0x10, 30),
        (0x38, 1),
        (0x3D, 0.6),
        (0x40, 0.5),
        (0x6B, 1 / 80),
        (0x70, 1 / 125),
        (0xA0, 1 / 8000),
    ],
)
def test_a_shutter_code_means_what_is_marked_on_the_dial(code, nominal_s):
    assert shutter_s(code) == pytest.approx(nominal_s, rel=0.07)


@pytest.mark.parametrize(
    ("code", "nominal"), [(0x40, 50), (0x48, 100), (0x4B, 125), (0x4D, 160), (0x68, 1600)]
)
def test_an_iso_code_means_what_is_marked_on_the_dial(code, nominal):
    assert iso(code) == pytest.approx(nominal, rel=0.02)


def test_codes_that_are_no_numbers_mean_nothing():
    assert shutter_s(0x0C) is None
    assert shutter_s(0x39) is None
    assert iso(0) is None


def test_records_are_read_up_to_their_end_and_no_further():
    one = struct.pack("<IIII", 16, 0xC189, 0xD102, 0x70)
    assert list(records(one + bytes((8, 0, 0, 0, 0, 0, 0, 0)) + b"rest")) == [(0xC189, one[8:])]
    assert list(records(b"")) == []
    for broken in (struct.pack("<II", 4, 1), struct.pack("<II", 99, 1)):
        with pytest.raises(CameraFormatError):
            list(records(broken))


def test_random_records_raise_nothing_but_the_drivers_own_errors():
    rng = np.random.default_rng(0)
    bench = Bench(EosCameraSimulator)
    with bench.open() as camera:
        for _ in range(300):
            whole = b"".join(bench.body._records) or struct.pack("<IIII", 16, 0xC18A, 0xD102, 6)
            data = bytearray(whole + struct.pack("<II", 8, 0))
            for _ in range(3):
                data[rng.integers(len(data))] = rng.integers(256)
            bench.body._records = [bytes(data)]
            try:
                camera.session.body.event(0.0)
            except CameraFormatError:
                bench.body._records = []


@pytest.fixture
def sony():
    return Bench(SonyCameraSimulator)


@pytest.mark.parametrize("sessions", [1, 2])
def test_a_sony_exposes_after_its_handshake_in_every_session(sony, sessions):
    for _ in range(sessions):
        with sony.open() as camera:
            for _ in range(3):
                np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)
    assert len(sony.exposed_s) == 3 * sessions
    phases = [p[0] for code, p in sony.asked if code == SonyOperation.CONNECT]
    assert phases == [1, 2, 3] * sessions
    assert Operation.INITIATE_CAPTURE not in sony.codes()
    assert Operation.GET_OBJECT_HANDLES not in sony.codes()


def test_the_exposure_of_a_sony_is_set_on_the_camera_and_read_from_the_file(sony):
    with sony.open() as camera:
        with pytest.raises(CameraSettingError, match="see the frames' own"):
            camera.exposure_s  # noqa: B018
        assert camera.snap().exposure_s == pytest.approx(0.008)
        assert camera.gain_limits == (1.0, 1.0)


def test_a_sony_whose_picture_never_comes_is_an_error_in_time(sony):
    sony.body._queue_event = lambda *event: None
    with sony.open() as camera:
        start_s = sony.clock.now_s()
        with pytest.raises(CaptureError, match="check focus"):
            camera.snap()
        assert sony.clock.now_s() - start_s < 30


def test_a_camera_without_any_release_that_is_known_is_refused():
    bench = Bench(partial(PtpCameraSimulator, lacks=(Operation.INITIATE_CAPTURE,)))
    with pytest.raises(CameraRefusedError, match="tethering"), bench.open():
        pass


def test_a_maker_is_known_by_its_operations_not_by_its_name_alone():
    bench = Bench(PtpCameraSimulator)
    bench.body.maker = "Canon Inc."
    with bench.open() as camera:
        np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)
    assert EosOperation.SET_REMOTE_MODE not in bench.codes()

"""What every camera does, simulated or real: `pytest -m hardware --camera ptp:` for a real one."""

import hashlib
import itertools

import numpy as np
import pytest

from drivers.camera import Camera, RawFileCamera
from drivers.errors import CameraSettingError, DriverError
from drivers.folder import FolderCamera
from drivers.ptp import PtpCamera, PtpSession
from drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from drivers.u3v import open_u3v
from drivers.usb import open_device
from simulators.camera import SimulatedRawCamera
from simulators.clock import ManualClock
from simulators.dng import encode_dng
from simulators.ptp import PtpCameraSimulator, PtpUsbFunction
from simulators.u3v import U3vCameraSimulator
from simulators.usb import SimulatedUsb

SHAPE, CFA = (40, 48), "grbg"
MOSAIC = np.random.default_rng(0).integers(0, 4095, SHAPE, dtype=np.uint16)


def see(exposure_s):
    return MOSAIC


def raw_file_camera(folder):
    clock = ManualClock()
    return RawFileCamera(SimulatedRawCamera(see, clock, CFA), SHAPE, CFA, clock=clock)


def ptp_camera(folder):
    clock = ManualClock()
    bus = SimulatedUsb(clock, PtpUsbFunction(PtpCameraSimulator(see, clock, CFA)))
    device = open_device(PTP_INTERFACE, backend=bus)
    return PtpCamera(PtpSession(PtpUsb(device, clock), clock))


def folder_camera(folder):
    for number in range(6):
        (folder / f"shot-{number}.dng").write_bytes(encode_dng(MOSAIC, CFA, 64, 4095, 0.01))
    return FolderCamera(folder, ManualClock())


def u3v_camera(folder):
    clock = ManualClock()
    bus = SimulatedUsb(clock, U3vCameraSimulator(see, clock, SHAPE, CFA))
    return open_u3v(backend=bus, clock=clock)


CAMERAS = {
    "raw file": raw_file_camera,
    "ptp": ptp_camera,
    "folder": folder_camera,
    "u3v": u3v_camera,
}
"""A new camera joins by a line here; it must see `MOSAIC` with black at 64 and white at 4095."""


@pytest.fixture(params=[*CAMERAS, pytest.param("hardware", marks=pytest.mark.hardware)])
def camera_kind(request):
    return request.param


@pytest.fixture
def camera(camera_kind, request, tmp_path):
    if camera_kind == "hardware":
        from emmc_rig.rig.hardware import open_camera

        opened: Camera = open_camera(request.config.getoption("--camera"))
    else:
        opened = CAMERAS[camera_kind](tmp_path)
    yield opened
    opened.close()


def choose(limits, most=0.2):
    """A value well inside the limits, not longer than `most` where that is inside too."""
    low, high = limits
    return float(min(np.sqrt(low * high), max(low, most)))


def test_a_frame_has_the_size_and_colours_that_the_camera_states(camera):
    frame = camera.snap()
    assert frame.mosaic.shape == camera.shape
    assert frame.cfa == camera.cfa
    assert frame.mosaic.dtype == np.uint16
    assert not frame.mosaic.flags.writeable


def test_a_simulated_camera_gives_what_its_sensor_reads(camera, camera_kind):
    if camera_kind == "hardware":
        pytest.skip("nobody knows what a real sensor reads")
    frame = camera.snap()
    np.testing.assert_array_equal(frame.mosaic, MOSAIC)
    np.testing.assert_array_equal(frame.black_level_dn, np.full((2, 2), 64))
    assert (frame.white_level_dn, frame.cfa) == (4095, CFA)


def test_the_levels_of_a_frame_are_in_order(camera):
    frame = camera.snap()
    assert frame.black_level_dn.shape == (2, 2)
    assert (frame.black_level_dn >= 0).all()
    assert (frame.black_level_dn < frame.white_level_dn).all()


def test_a_frame_keeps_the_cameras_bytes_and_their_digest(camera):
    frame = camera.snap()
    assert hashlib.sha256(frame.original).hexdigest() == frame.sha256


def test_frames_are_stamped_in_their_order(camera):
    first, second = camera.snap(), camera.snap()
    assert first.host_time_s is not None
    assert second.host_time_s >= first.host_time_s


def test_the_exposure_that_was_taken_is_reported(camera):
    low, high = camera.exposure_limits_s
    asked_s = choose((low, high))
    camera.set_exposure_s(asked_s)
    taken_s = camera.exposure_s
    assert low <= taken_s <= high
    assert camera.snap().exposure_s == pytest.approx(taken_s, rel=0.1, abs=1e-4)
    camera.set_exposure_s(taken_s)
    assert camera.exposure_s == pytest.approx(taken_s)


def test_the_gain_that_was_taken_is_reported(camera):
    low, high = camera.gain_limits
    camera.set_gain(choose((low, high), most=high))
    assert low <= camera.gain <= high
    assert camera.snap().gain in (None, pytest.approx(camera.gain))
    camera.set_gain(camera.gain)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_what_is_out_of_reach_is_refused_and_changes_nothing(camera, factor):
    for limits, ask, read in (
        (camera.exposure_limits_s, camera.set_exposure_s, lambda: camera.exposure_s),
        (camera.gain_limits, camera.set_gain, lambda: camera.gain),
    ):
        before = read()
        with pytest.raises(CameraSettingError):
            ask(limits[0] * factor if factor < 1 else limits[1] * factor)
        assert read() == before


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_what_is_not_positive_is_refused(camera, value):
    with pytest.raises(ValueError, match="not positive"):
        camera.set_exposure_s(value)
    with pytest.raises(ValueError, match="not positive"):
        camera.set_gain(value)


def test_a_camera_says_who_made_it(camera):
    identity = camera.identity
    for text in (identity.maker, identity.model, identity.serial, identity.firmware):
        assert isinstance(text, str)


def test_a_closed_camera_gives_no_frame_and_may_be_closed_again(camera):
    camera.snap()
    camera.close()
    camera.close()
    with pytest.raises(DriverError):
        camera.snap()


def test_a_stream_gives_frames_and_stops_when_it_is_closed(camera):
    if not hasattr(camera, "stream"):
        pytest.skip("this camera takes one frame at a time")
    stream = camera.stream()
    for frame in itertools.islice(stream, 3):
        assert frame.mosaic.shape == camera.shape
    stream.close()
    assert camera.snap().mosaic.shape == camera.shape

"""Every camera of this package against what every camera does; and a real one.

`pytest -m hardware --camera ptp:` runs it against a real one, as `emmc-rig devices conform` does.
"""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.bench.conformance.cameras import *  # noqa: F403
from emmc_rig.drivers.camera import Camera, RawFileCamera
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.folder import FolderCamera
from emmc_rig.drivers.ptp import PtpCamera, PtpSession
from emmc_rig.drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from emmc_rig.drivers.u3v import open_camera
from emmc_rig.drivers.usb import open_device
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.ptp import PtpCameraSimulator, PtpUsbFunction
from emmc_rig.simulators.u3v import U3vCameraSimulator
from emmc_rig.simulators.usb import SimulatedUsb

SHAPE, CFA = (40, 48), "grbg"
MOSAIC = np.random.default_rng(0).integers(0, 4095, SHAPE, dtype=np.uint16)


def see(exposure_s):
    return MOSAIC


class Files:
    """A `drivers.camera.CaptureTransport` whose every file shows `MOSAIC`."""

    def __init__(self, clock):
        self.clock = clock

    def capture(self, exposure_s):
        self.clock.sleep(exposure_s)
        return encode_dng(MOSAIC, CFA, 64, 4095, exposure_s)


def raw_file_camera(folder):
    clock = ManualClock()
    return RawFileCamera(Files(clock), SHAPE, CFA, clock=clock)


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
    return open_camera("", clock, bus)


class DumpCamera(RawFileCamera):
    """As a plug-in may be: its own bytes are bare samples, which nothing else can decode."""

    def snap(self):
        frame = super().snap()
        data = frame.mosaic.tobytes()
        return replace(frame, original=data, sha256=hashlib.sha256(data).hexdigest())


def dump_camera(folder):
    clock = ManualClock()
    return DumpCamera(Files(clock), SHAPE, CFA, clock=clock)


CAMERAS = {
    "raw file": raw_file_camera,
    "ptp": ptp_camera,
    "folder": folder_camera,
    "u3v": u3v_camera,
    "dump": dump_camera,
}
"""A new camera joins by a line here; it must see `MOSAIC` with black at 64 and white at 4095."""


@pytest.fixture(params=[*CAMERAS, pytest.param("hardware", marks=pytest.mark.hardware)])
def camera_kind(request):
    return request.param


@pytest.fixture
def camera(camera_kind, request, tmp_path):
    if camera_kind == "hardware":
        from emmc_rig.bench.hardware import open_camera

        opened: Camera = open_camera(request.config.getoption("--camera"))
    else:
        opened = CAMERAS[camera_kind](tmp_path)
    yield opened
    opened.close()


def test_a_simulated_camera_gives_what_its_sensor_reads(camera, camera_kind):
    if camera_kind == "hardware":
        pytest.skip("nobody knows what a real sensor reads")
    frame = camera.snap()
    np.testing.assert_array_equal(frame.mosaic, MOSAIC)
    np.testing.assert_array_equal(frame.black_level_dn, np.full((2, 2), 64))
    assert (frame.white_level_dn, frame.cfa) == (4095, CFA)

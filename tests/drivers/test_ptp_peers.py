"""PTP against an independent program: libgphoto2's virtual camera; as the host: test_gphoto.py.

Needs the extra `peers` (the gphoto2 wheel brings libgphoto2 with its virtual camera).
"""

import ctypes
import hashlib
import struct
from pathlib import Path

import numpy as np
import pytest

from emmc_rig.drivers.clock import SystemClock
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.ptp import PtpSession, PtpSettings, is_raw
from emmc_rig.drivers.ptp_codec import HEADER_SIZE, Format, Operation, Property
from emmc_rig.drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.drivers.usb import INTERRUPT, open_device
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.ptp import BULK_IN, BULK_OUT, INTERRUPT_IN
from emmc_rig.simulators.usb import (
    DeviceSpec,
    EndpointSpec,
    InterfaceSpec,
    SimulatedUsb,
    StallError,
    UsbFunction,
)

gphoto2 = pytest.importorskip("gphoto2", reason="the extra `peers` is not installed")
pytestmark = pytest.mark.peers

LIBRARIES = Path(gphoto2.__file__).parent / "libgphoto2"
PORT_LIBRARY = next(LIBRARIES.glob("libgphoto2_port.so*"), None)
VIRTUAL_USB = LIBRARIES / "vusb"
MOSAIC = np.random.default_rng(3).integers(0, 4095, (300, 400), dtype=np.uint16)
DNG = encode_dng(MOSAIC, "rggb", 64, 4095, 0.01)


class VirtualCamera(UsbFunction):
    """libgphoto2's virtual camera, its port's reads and writes cut into USB packets.

    The port hands over bytes without their packets; a container's own length tells where a real
    camera would end one.
    """

    spec = DeviceSpec(
        0x04B0,
        0x0437,
        "GP",
        "VC",
        "1",
        (
            InterfaceSpec(
                PTP_INTERFACE,
                (
                    EndpointSpec(BULK_OUT),
                    EndpointSpec(BULK_IN),
                    EndpointSpec(INTERRUPT_IN, INTERRUPT, 64),
                ),
            ),
        ),
    )

    def __init__(self):
        self.port = ctypes.CDLL(str(PORT_LIBRARY))
        self.handle, listed, info = (ctypes.c_void_p() for _ in range(3))
        self._ok(self.port.gp_port_info_list_new(ctypes.byref(listed)))
        self._ok(self.port.gp_port_info_list_load(listed))
        index = self._ok(self.port.gp_port_info_list_lookup_path(listed, b"usb:"))
        self._ok(self.port.gp_port_info_list_get_info(listed, index, ctypes.byref(info)))
        self._ok(self.port.gp_port_new(ctypes.byref(self.handle)))
        self._ok(self.port.gp_port_set_info(self.handle, info))
        self._ok(self.port.gp_port_open(self.handle))

    def _ok(self, result):
        assert result >= 0, f"libgphoto2 says {result}"
        return result

    def close(self):
        self._ok(self.port.gp_port_close(self.handle))

    def bulk_out(self, endpoint, data):
        if data:
            self._ok(self.port.gp_port_write(self.handle, data, len(data)))
        return len(data)

    def bulk_in(self, endpoint, length, timeout_s):
        header = self._read(HEADER_SIZE)
        if not header:
            return None
        return header + self._read(struct.unpack_from("<I", header)[0] - HEADER_SIZE)

    def _read(self, length):
        buffer = ctypes.create_string_buffer(max(1, length))
        count = self.port.gp_port_read(self.handle, buffer, length) if length else 0
        return buffer.raw[: self._ok(count)]

    def interrupt(self, endpoint, length, timeout_s):
        buffer = ctypes.create_string_buffer(length)
        self._ok(self.port.gp_port_set_timeout(self.handle, max(1, round(timeout_s * 1000))))
        count = self.port.gp_port_check_int(self.handle, buffer, length)
        return buffer.raw[:count] if count > 0 else None

    def control(self, request_type, request, value, index, data):
        raise StallError


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """What the virtual camera has on its card; a capture there copies a file named .jpg."""
    folder = tmp_path_factory.mktemp("card")
    (folder / "template.jpg").write_bytes(DNG)
    (folder / "recorded.dng").write_bytes(DNG)
    return folder


@pytest.fixture
def session(store, monkeypatch):
    if PORT_LIBRARY is None or not VIRTUAL_USB.is_dir():
        pytest.skip("this build of gphoto2 has no virtual camera")
    monkeypatch.setenv("IOLIBS", str(VIRTUAL_USB))
    monkeypatch.setenv("VCAMERADIR", str(store))
    virtual_camera = VirtualCamera()
    # The virtual camera waits in real time itself; what the bus adds to that costs nothing.
    bus = SimulatedUsb(ManualClock(), virtual_camera)
    device = open_device(PTP_INTERFACE, backend=bus)
    settings = PtpSettings(event_poll_s=0.2, capture_limit_s=5.0)
    opened = PtpSession(PtpUsb(device, SystemClock()), SystemClock(), settings)
    yield opened
    opened.close()
    virtual_camera.close()


def test_libgphoto2s_camera_says_who_it_is(session):
    assert (session.info.maker, session.info.model) == ("GP", "VC")
    assert session.can(Operation.INITIATE_CAPTURE)
    (storage,) = session.storages()
    assert storage.description == "GPVC Storage"


def test_our_driver_captures_and_downloads_from_libgphoto2s_camera(session):
    handles = set(session.handles())
    taken, info = session.capture(0.0, lambda info: info.format == Format.JPEG)
    assert taken not in handles
    data = session.download(taken, info)
    np.testing.assert_array_equal(decode_raw(data).mosaic, MOSAIC)


def test_our_driver_finds_and_downloads_the_raw_file_on_libgphoto2s_card(session):
    found = {handle: session.object_info(handle) for handle in session.handles()}
    (handle,) = (handle for handle, info in found.items() if is_raw(info))
    progress = []
    data = session.download(handle, found[handle], lambda done, size: progress.append(done))
    assert hashlib.sha256(data).digest() == hashlib.sha256(DNG).digest()
    assert progress[-1] == len(DNG)


def test_our_driver_sets_the_shutter_of_libgphoto2s_camera(session):
    shutter = session.describe(Property.EXPOSURE_TIME)
    for units in (1000, 25):
        assert session.write(shutter, units) == units

# pyright: reportMissingImports=false
"""The simulated USB3 Vision camera behind a real libusb, driven by Aravis or by our driver.

Run as `umockdev-wrapper python u3v_over_libusb.py aravis|driver|fake`; prints what was seen as
JSON. `fake` needs no USB: our reader of camera descriptions on Aravis's own fake camera.
"""

import hashlib
import itertools
import json
import os
import signal
import sys

# After everything else, so that only what this Python lacks comes from the system's.
sys.path.append("/usr/lib/python3/dist-packages")

import gi
import numpy as np

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402
from usbfs import mock  # noqa: E402

from emmc_rig.drivers.clock import SYSTEM_CLOCK  # noqa: E402
from emmc_rig.drivers.genapi import Features  # noqa: E402
from emmc_rig.drivers.pixel_formats import BY_CODE, unpack  # noqa: E402
from emmc_rig.drivers.u3v import open_camera  # noqa: E402
from emmc_rig.drivers.u3v_codec import CONTROL  # noqa: E402
from emmc_rig.drivers.usb import list_devices  # noqa: E402
from emmc_rig.simulators.u3v import U3vCameraSimulator  # noqa: E402
from emmc_rig.simulators.usb import SimulatedUsb  # noqa: E402

SHAPE, FRAMES, SESSIONS = (1024, 1022), 4, 2
MOSAIC = np.random.default_rng(7).integers(64, 4096, SHAPE, dtype=np.uint16)
PATIENCE_US = 5_000_000

KEPT = []
"""Never freed: Aravis joins its thread then, which waits for us while we hold Python's lock."""


def with_aravis():
    """Take frames as Aravis does."""
    simulator = U3vCameraSimulator(lambda exposure_s: MOSAIC, SYSTEM_CLOCK, SHAPE, "gbrg")
    testbed, usbfs = mock(SimulatedUsb(SYSTEM_CLOCK, simulator))
    for name in ("GigEVision", "Fake"):
        Aravis.disable_interface(name)
    Aravis.update_device_list()
    found = [Aravis.get_device_id(i) for i in range(Aravis.get_n_devices())]
    camera = Aravis.Camera.new(found[0])
    device = camera.get_device()
    KEPT.extend((testbed, camera, device))
    for name in ("ExposureAuto", "GainAuto", "TriggerMode"):
        device.set_string_feature_value(name, "Off")
    camera.set_exposure_time(5000.0)
    camera.set_gain(6.0)
    seen = {
        "found": found,
        "maker": camera.get_vendor_name(),
        "model": camera.get_model_name(),
        "exposure_us": camera.get_exposure_time(),
        "exposure_limits_us": list(camera.get_exposure_time_bounds()),
        "gain_db": camera.get_gain(),
        "gain_limits_db": list(camera.get_gain_bounds()),
        "sensor": list(camera.get_sensor_size()),
        "formats": camera.dup_available_pixel_formats_as_strings(),
    }
    camera.set_gain(0.0)
    camera.set_pixel_format_from_string("BayerGB12p")
    stream = camera.create_stream(None, None)
    KEPT.append(stream)
    seen["payload"] = camera.get_payload()
    for _ in range(3):
        stream.push_buffer(Aravis.Buffer.new_allocate(seen["payload"]))
    seen["sessions"] = [acquired(camera, stream) for _ in range(SESSIONS)]
    seen["faults"] = usbfs.faults
    return seen


def acquired(camera, stream):
    """Start an acquisition, take frames, stop; return what each frame came with."""
    camera.start_acquisition()
    frames = []
    for _ in range(FRAMES):
        buffer = stream.timeout_pop_buffer(PATIENCE_US)
        form = BY_CODE[buffer.get_image_pixel_format()]
        pixels = unpack(bytes(buffer.get_data()), form, SHAPE)
        frames.append(
            {
                "whole": buffer.get_status() == Aravis.BufferStatus.SUCCESS,
                "format": form.name,
                "equal": bool((pixels == MOSAIC).all()),
                "block": buffer.get_frame_id(),
                "time_ns": buffer.get_timestamp(),
            }
        )
        stream.push_buffer(buffer)
    camera.stop_acquisition()
    late = []
    while (buffer := stream.try_pop_buffer()) is not None:
        late.append(buffer)
    for buffer in late:
        stream.push_buffer(buffer)
    return frames


def with_driver():
    """Take frames with our driver, through pyusb's own libusb."""
    simulator = U3vCameraSimulator(lambda exposure_s: MOSAIC, SYSTEM_CLOCK, SHAPE, "gbrg")
    testbed, usbfs = mock(SimulatedUsb(SYSTEM_CLOCK, simulator))
    KEPT.append(testbed)
    listings = list_devices(CONTROL)
    frames = []
    for _ in range(SESSIONS):
        camera = open_camera("U1", SYSTEM_CLOCK)
        camera.set_exposure_s(0.005)
        frames += [camera.snap(), *itertools.islice(camera.stream(), FRAMES)]
        camera.close()
    return {
        "listed": [(listing.maker, listing.model, listing.serial) for listing in listings],
        "exposure_s": camera.exposure_s,
        "frames": [bool((frame.mosaic == MOSAIC).all()) for frame in frames],
        "streaming": simulator.streaming,
        "faults": usbfs.faults,
    }


class AravisMemory:
    """The memory of Aravis's fake camera, as a port: registers of four bytes, big endian."""

    def __init__(self, device):
        self._device = device

    def read(self, address, length):
        words = range(address & ~3, address + length, 4)
        raw = b"".join(self._device.read_register(word).to_bytes(4, "big") for word in words)
        return raw[address & 3 :][:length]

    def write(self, address, data):
        self._device.write_register(address, int.from_bytes(data, "big"))


def with_fake():
    """Read Aravis's fake camera by its own description."""
    Aravis.enable_interface("Fake")
    Aravis.update_device_list()
    device = Aravis.Camera.new("Fake_1").get_device()
    xml = device.get_genicam_xml()
    xml = xml[0] if isinstance(xml, tuple) else xml
    features = Features(xml.encode(), AravisMemory(device))
    readers = {
        "Width": device.get_integer_feature_value,
        "Height": device.get_integer_feature_value,
        "SensorWidth": device.get_integer_feature_value,
        "PayloadSize": device.get_integer_feature_value,
        "GainRaw": device.get_integer_feature_value,
        "ExposureTimeAbs": device.get_float_feature_value,
        "AcquisitionFrameRate": device.get_float_feature_value,
        "PixelFormat": device.get_string_feature_value,
        "AcquisitionMode": device.get_string_feature_value,
        "TriggerMode": device.get_string_feature_value,
        "TriggerSource": device.get_string_feature_value,
    }
    read = [(name, features.value(name), theirs(name)) for name, theirs in readers.items()]
    features.set("Width", 320)
    features.set("ExposureTimeAbs", 2500.0)
    features.set("PixelFormat", "Mono16")
    features.set("GainRaw", 7)
    written = [
        (name, features.value(name), readers[name](name))
        for name in ("Width", "ExposureTimeAbs", "PixelFormat", "GainRaw", "PayloadSize")
    ]
    limits = [
        ("Width", features.limits("Width"), device.get_integer_feature_bounds("Width")),
        (
            "ExposureTimeAbs",
            features.limits("ExposureTimeAbs"),
            device.get_float_feature_bounds("ExposureTimeAbs"),
        ),
        ("GainRaw", features.limits("GainRaw"), device.get_integer_feature_bounds("GainRaw")),
    ]
    return {
        "read": read,
        "written": written,
        "limits": [(name, list(ours), list(theirs)) for name, ours, theirs in limits],
        "formats": {
            name: getattr(Aravis, name) for name in dir(Aravis) if name.startswith("PIXEL_FORMAT_")
        },
        "xml_sha256": hashlib.sha256(xml.encode()).hexdigest(),
    }


if __name__ == "__main__":
    result = {"aravis": with_aravis, "driver": with_driver, "fake": with_fake}[sys.argv[1]]()
    print(json.dumps(result), flush=True)
    # Aravis's and umockdev's threads outlive the work; nothing is left to be tidied.
    os.kill(os.getpid(), signal.SIGKILL)

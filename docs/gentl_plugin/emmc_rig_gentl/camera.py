"""A camera of a GenTL producer, such as a maker ships with its GigE Vision or CoaXPress cameras.

    driver: gentl
    address: /opt/maker/lib/producer.cti
    serial: "40012345"

Source: harvesters 1.4; EMVA Standard Features Naming Convention 2.7 (names, exposure in
microseconds, gain in decibels).
"""

import math
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from genicam.gentl import GenericException, TimeoutException
from harvesters.core import Harvester

from emmc_rig.drivers.camera import CameraIdentity, Limits, check_setting
from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.dng import frame_of_array
from emmc_rig.drivers.errors import CameraClosedError, CameraSettingError, CaptureError, DriverError
from emmc_rig.drivers.pixel_formats import FORMATS
from emmc_rig.drivers.raw import RawFrame

RAW_SETTINGS = {
    "ExposureAuto": "Off",
    "ExposureMode": "Timed",
    "GainAuto": "Off",
    "BalanceWhiteAuto": "Off",
    "GammaEnable": False,
    "TriggerMode": "Off",
}
"""What makes frames raw, manual and untriggered, where the camera has it."""
FRAME_GRACE_S = 2.0


def open_camera(
    address: str,
    clock: Clock,
    *,
    serial: str = "",
    black_level_dn: int = 0,
    exposure_s: float = 0.0,
) -> "GenTlCamera":
    """Open the first camera of the GenTL producer in the file `address`, or the camera `serial`.

    exposure_s: of a camera without an exposure feature. Raises a `DriverError`.
    """
    harvester = Harvester()
    try:
        harvester.add_file(address)
        harvester.update()
        found = [str(device.serial_number) for device in harvester.device_info_list]
        if not found or (serial and serial not in found):
            there = ", ".join(found) or "none"
            raise DriverError(f"no camera {serial} of {address}", f"those there are: {there}")
        acquirer = harvester.create({"serial_number": serial or found[0]})
        return GenTlCamera(harvester, acquirer, clock, black_level_dn, exposure_s)
    except BaseException:
        harvester.reset()
        raise


class GenTlCamera:
    """A `drivers.camera.StreamingCamera` of a harvester's image acquirer, both of which it closes.

    The deepest format that is not packed is taken.
    """

    def __init__(
        self,
        harvester: Harvester,
        acquirer: Any,
        clock: Clock,
        black_level_dn: int = 0,
        exposure_s: float = 0.0,
    ) -> None:
        self._harvester, self._acquirer, self._clock = harvester, acquirer, clock
        self._black_dn = black_level_dn
        self._known_s = exposure_s
        self._busy = self._closed = False
        self._nodes: Any = acquirer.remote_device.node_map
        for name, value in RAW_SETTINGS.items():
            # A camera may have the feature and not this value, or lock it.
            with suppress(GenericException):
                if (node := self._node(name)) is not None:
                    node.value = value
        offered = self._nodes.PixelFormat.symbolics
        whole = [
            format for format in FORMATS if format.name in offered and format.stored_bits in (8, 16)
        ]
        if not whole:
            raise CameraSettingError("PixelFormat", f"offers {', '.join(offered)}, none to read")
        self._format = whole[0]
        self._nodes.PixelFormat.value = self._format.name
        self.cfa = self._format.cfa
        self.shape: tuple[int, int] = (self._nodes.Height.value, self._nodes.Width.value)
        names = ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber", "DeviceVersion")
        self.identity = CameraIdentity(
            *(str(getattr(self._node(name), "value", "")) for name in names)
        )

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame; raises `CameraSettingError` where nobody knows it."""
        node = self._node("ExposureTime")
        if node is None and not self._known_s:
            raise CameraSettingError("exposure", "is no feature: state exposure_s")
        return self._known_s if node is None else node.value / 1e6

    @property
    def exposure_limits_s(self) -> Limits:
        """Shortest and longest exposure; equal where it cannot be chosen."""
        node = self._node("ExposureTime")
        if node is None:
            return self.exposure_s, self.exposure_s
        return node.min / 1e6, node.max / 1e6

    @property
    def gain(self) -> float:
        """Gain of the next frame, linear."""
        node = self._node("Gain")
        return 1.0 if node is None else 10 ** (node.value / 20)

    @property
    def gain_limits(self) -> Limits:
        """Lowest and highest gain; equal where it cannot be chosen."""
        node = self._node("Gain")
        return (1.0, 1.0) if node is None else (10 ** (node.min / 20), 10 ** (node.max / 20))

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure; raises `ValueError` or `CameraSettingError`."""
        check_setting("exposure in seconds", exposure_s, self.exposure_limits_s)
        if (node := self._node("ExposureTime")) is not None:
            node.value = 1e6 * exposure_s

    def set_gain(self, gain: float) -> None:
        """Choose the gain; raises as `set_exposure_s`."""
        check_setting("gain", gain, self.gain_limits)
        if (node := self._node("Gain")) is not None:
            node.value = 20 * math.log10(gain)

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises a `DriverError`."""
        with self._acquiring():
            return self._fetch()

    def stream(self) -> Generator[RawFrame, None, None]:
        """Yield frames as they come; closing the generator stops the acquisition."""
        with self._acquiring():
            while True:
                yield self._fetch()

    def close(self) -> None:
        """Let go of the camera; closing twice is allowed."""
        if not self._closed:
            self._closed = True
            self._acquirer.destroy()
            self._harvester.reset()

    def _node(self, name: str) -> Any:
        return getattr(self._nodes, name) if self._nodes.has_node(name) else None

    @contextmanager
    def _acquiring(self) -> Iterator[None]:
        if self._closed:
            raise CameraClosedError(self.identity.model or "the camera")
        if self._busy:
            raise CameraSettingError("acquisition", "runs already: close its stream first")
        self._busy = True
        try:
            self._acquirer.start()
            yield
        finally:
            self._acquirer.stop()
            self._busy = False

    def _fetch(self) -> RawFrame:
        exposure_s = self.exposure_s
        try:
            with self._acquirer.fetch(timeout=exposure_s + FRAME_GRACE_S) as buffer:
                if not buffer.is_complete():
                    raise CaptureError("it did not come whole")
                component = buffer.payload.components[0]
                # The buffer goes back to the producer: its contents must be copied.
                mosaic = np.array(component.data, dtype=np.uint16)
                shape = (int(component.height), int(component.width))
                camera_time_s = None
                with suppress(GenericException):  # raised where a producer states no time
                    camera_time_s = buffer.timestamp_ns / 1e9
        except TimeoutException as error:
            raise CaptureError("no frame came from the camera") from error
        if shape != self.shape or mosaic.size != shape[0] * shape[1]:
            raise CaptureError(f"it has {shape[0]}x{shape[1]} pixels instead of {self.shape}")
        return frame_of_array(
            mosaic.reshape(shape),
            self.cfa,
            self._black_dn,
            self._format.white_dn,
            exposure_s,
            self.identity,
            self._clock.now_s(),
            {"pixel_format": self._format.name},
            camera_time_s=camera_time_s,
        )

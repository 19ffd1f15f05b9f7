"""USB3 Vision cameras with GenICam's names for exposure, gain and pixels, and their frames.

A recorded frame (`RawFrame.original`) is the camera's leader, payload and trailer in a row, as they
came; `decode_frame` reads it again. Source: USB3 Vision 1.0; EMVA Standard Features Naming
Convention 2.7 (feature names, exposure in microseconds, gain in decibels).
"""

from __future__ import annotations

import hashlib
import io
import logging
import math
import zipfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np

from emmc_rig.drivers import u3v_codec as codec
from emmc_rig.drivers.camera import CameraIdentity, Limits, check_setting
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import (
    CameraDescriptionError,
    CameraFormatError,
    CameraRefusedError,
    CameraSettingError,
    CaptureError,
    DriverError,
    NoFrameError,
    RawFrameError,
)
from emmc_rig.drivers.genapi import Features
from emmc_rig.drivers.pixel_formats import (
    BY_CODE,
    BY_NAME,
    FORMATS,
    PixelFormat,
    image_bytes,
    unpack,
)
from emmc_rig.drivers.raw import RawFrame, hashed
from emmc_rig.drivers.transport import repeated
from emmc_rig.drivers.trigger import begin_by_line, show_exposure
from emmc_rig.drivers.u3v_control import U3vControl
from emmc_rig.drivers.u3v_stream import U3vStream
from emmc_rig.drivers.usb import BULK, UsbDevice, open_device

_log = logging.getLogger(__name__)

MANIFEST_LIMIT = 64
XML_LIMIT = 16 << 20
UNZIPPED_LIMIT = 32 << 20

EXPOSURE_NAMES = ("ExposureTime", "ExposureTimeAbs")
SECONDS = {"": 1e-6, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ms": 1e-3, "s": 1.0}
GAIN_NAMES = ("Gain", "GainAbs")
DECIBEL = ("", "db")
BLACK_LEVEL_NAMES = ("BlackLevel", "BlackLevelAbs", "BlackLevelRaw")

TEMPERATURE = "DeviceTemperature"
RAW_SETTINGS = (
    ("ExposureAuto", "Off"),
    ("ExposureMode", "Timed"),
    ("GainAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("GammaEnable", False),
    ("LUTEnable", False),
    ("TestPattern", "Off"),
    ("GainSelector", "All"),
    ("BlackLevelSelector", "All"),
    ("TriggerSelector", "FrameStart"),
    ("TriggerMode", "Off"),
)
"""What makes frames raw, manual and untriggered, where the camera has it."""

RATE = "AcquisitionFrameRate"
SHORTEST_S, LONGEST_S = 1e-7, 3600.0
FRAME_GRACE_S = 2.0
LOST = (CaptureError,)
"""Of a stream: such frames are passed over, unless three are lost in a row."""
IN_FLIGHT = 3
"""Frames that a camera may have begun before a new setting counts."""


def open_camera(address: str, clock: Clock, backend: Any = None) -> U3vCamera:
    """Open the camera with a serial number, "" for the first; see `drivers.cameras`."""
    device = open_device(
        codec.CONTROL, serial=address, backend=backend, wanted="USB3 Vision camera"
    )
    return U3vCamera(device, clock)


class U3vCamera:
    """A `drivers.camera.StreamingCamera` over an open USB device, which it closes.

    Pixels come in the deepest format that it offers and we can read. The black level is the feature
    `BlackLevel` in DN, or in per cent of white if its unit is %.
    The constructor switches automatic and processed modes off and stops an acquisition that was
    left running. Raises a `DriverError`, the device closed.
    """

    def __init__(self, device: UsbDevice, clock: Clock = SYSTEM_CLOCK) -> None:
        self._device = device
        self._clock = clock
        self._acquiring = False
        self._in_flight = 0
        # The line that begins frames, and how long its pulse is waited for.
        self._trigger, self._trigger_limit_s = "", 0.0
        try:
            self._open()
        except BaseException:
            device.close()
            raise

    def _open(self) -> None:
        device, clock = self._device, self._clock
        interface = device.claim(codec.CONTROL)
        self._control = control = U3vControl(
            device.name, interface.pipe(BULK, False), interface.pipe(BULK, True), clock
        )
        sbrm = control.integer(codec.ABRM_SBRM, 8)
        control.learn_sizes(sbrm)
        sirm = control.integer(sbrm + codec.SBRM_SIRM, 8)
        pipe = device.claim(codec.STREAM).pipe(BULK, True)
        self._stream = U3vStream(device, pipe, control, sirm, clock)
        self.identity = CameraIdentity(
            control.text(codec.ABRM_MAKER),
            control.text(codec.ABRM_MODEL),
            control.text(codec.ABRM_SERIAL),
            control.text(codec.ABRM_VERSION),
        )
        self.features = Features(read_description(control), control)
        self._stop()
        for name, value in RAW_SETTINGS:
            self._set_if_possible(name, value)
        self._format = self._choose_format()
        self.cfa = self._format.cfa
        self.shape = (int(self.features.number("Height")), int(self.features.number("Width")))
        self._exposure_name = self._first_of(EXPOSURE_NAMES)
        if not self._exposure_name:
            raise CameraDescriptionError(f"it has none of {', '.join(EXPOSURE_NAMES)}")
        self._gain_name = self._first_of(GAIN_NAMES)
        self._read_settings()

    @property
    def pixel_format(self) -> str:
        """GenICam name of the format that pixels come in."""
        return self._format.name

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow: the nearest that the camera has.

        Raises `ValueError` unless positive, `CameraSettingError` outside the limits.
        """
        check_setting("exposure in seconds", exposure_s, self.exposure_limits_s)
        self.features.set_nearest(self._exposure_name, exposure_s / self._exposure_unit_s)
        self._read_settings()

    def set_gain(self, gain: float) -> None:
        """Choose the gain of the frames that follow; raises as `set_exposure_s`."""
        check_setting("gain", gain, self.gain_limits)
        if self._gain_name:
            shown = 20 * math.log10(gain) if self._gain_in_decibels() else gain
            self.features.set_nearest(self._gain_name, shown)
        self._read_settings()

    def set_trigger(self, source: str, edge: str, limit_s: float) -> None:
        """Let a line begin every frame from now on, within limit_s; edge: rising or falling.

        `NoFrameError` is raised for a frame without a pulse. Raises `CameraSettingError` for what
        the camera lacks.
        """
        begin_by_line(self, source, edge)
        self._trigger, self._trigger_limit_s = source, limit_s

    def set_exposure_output(self, line: str) -> None:
        """Let a line be high during exposures; raises as `set_trigger`."""
        show_exposure(self, line)

    def choices(self, name: str) -> tuple[str, ...]:
        """As `drivers.trigger.Choices`."""
        return self.features.choices(name) if self.features.has(name) else ()

    def choose(self, name: str, value: str) -> None:
        """As `drivers.trigger.Choices`; a feature that has the value already may be fixed."""
        if self.features.is_writable(name) or self.features.value(name) != value:
            self.features.set(name, value)

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises a `DriverError`.

        The exposure begins after the call. A frame that does not come whole raises
        `CaptureError`; the camera is ready for another.
        """
        with self._acquisition("SingleFrame"):
            return self._decode(self._receive())

    def stream(self) -> Generator[RawFrame, None, None]:
        """Yield frames as they come; closing the generator stops the acquisition.

        `metadata["frames_lost"]` counts the frames missing right before this one, by the camera's
        numbers. Frames that come torn are passed over; three in a row raise `CaptureError`.
        Exposure and gain are None for frames that may have begun before a change of a setting.
        """
        self._in_flight = 0
        last_block: int | None = None
        with self._acquisition("Continuous"):
            while True:
                raw = repeated(self._receive, f"{self._device.name} to stream", faults=LOST)
                frame = self._decode(raw)
                block = int(frame.metadata["block_id"])
                lost = 0 if last_block is None else max(0, block - last_block - 1)
                last_block = block
                if self._in_flight:
                    self._in_flight -= 1
                    frame = replace(frame, exposure_s=None, gain=None)
                yield replace(frame, metadata={**frame.metadata, "frames_lost": str(lost)})

    @property
    def rate_limits_hz(self) -> Limits:
        """Fewest and most frames a second at the present exposure; equal for a fixed rate."""
        if not self.features.has(RATE):
            return 1 / LONGEST_S, 1 / SHORTEST_S
        if not self.features.is_writable(RATE):
            only = self.features.number(RATE)
            return only, only
        return self.features.limits(RATE)

    def stream_at(self, rate_hz: float) -> Generator[RawFrame, None, None]:
        """Yield frames as `stream` at a rate, where the camera can be told one; then as before."""
        self._set_if_possible(f"{RATE}Enable", 1)
        if not (self.features.has(RATE) and self.features.is_writable(RATE)):
            yield from self.stream()
            return
        check_setting("frame rate in Hz", rate_hz, self.rate_limits_hz)
        before_hz = self.features.number(RATE)
        self.features.set_nearest(RATE, rate_hz)
        self._read_settings()
        try:
            yield from self.stream()
        finally:
            with suppress(DriverError):
                self.features.set_nearest(RATE, before_hz)
                self._read_settings()

    def stop_exposure(self) -> bool:
        """Break off the exposure under way, within half a second; any thread may call.

        `snap` or `stream` raises `ExposureStoppedError`.
        """
        self._stream.stop_wanted.set()
        return True

    def close(self) -> None:
        """Stop an acquisition and let go of the camera; closing twice is allowed."""
        if self._acquiring:
            with suppress(DriverError):
                self._stop()
            self._acquiring = False
        self._device.close()

    @contextmanager
    def _acquisition(self, mode: str) -> Iterator[None]:
        if self._acquiring:
            raise CameraSettingError("acquisition", "runs already: close its stream first")
        self._acquiring = True
        try:
            self._start(mode)
            yield
        except GeneratorExit:
            # A camera that was closed meanwhile has been stopped by that.
            if self._acquiring:
                self._stop()
            raise
        except BaseException:
            # The first fault is reported; a camera that is gone cannot be stopped.
            with suppress(DriverError):
                self._stop()
            raise
        else:
            self._stop()
        finally:
            self._acquiring = False

    def _start(self, mode: str) -> None:
        for choice in (mode, "Continuous"):
            if self._set_if_possible("AcquisitionMode", choice):
                break
        self._stream.start()
        self._set_if_possible("TLParamsLocked", 1)
        self.features.execute("AcquisitionStart")

    def _stop(self) -> None:
        try:
            if "AcquisitionStop" in self.features:
                self.features.execute("AcquisitionStop")
        except (CameraRefusedError, CameraSettingError) as error:
            _log.debug("%s: no acquisition to stop (%s)", self._device.name, error)
        finally:
            self._stream.stop()
        self._set_if_possible("TLParamsLocked", 0)

    def _receive(self) -> bytes:
        wait_s = max(self.exposure_s, self._period_s) + FRAME_GRACE_S + self._trigger_limit_s
        try:
            return self._stream.receive(wait_s)
        except NoFrameError as fault:
            if not self._trigger:
                raise
            raise NoFrameError(
                f"no pulse came on {self._trigger} within {self._trigger_limit_s:g} s",
                "check what gives the pulses, its cable, and trigger: in the plan",
            ) from fault

    def _decode(self, original: bytes) -> RawFrame:
        host_time_s = self._clock.now_s()
        try:
            frame = decode_frame(original, self.black_level_dn, self.white_level_dn)
        except (CameraFormatError, RawFrameError) as error:
            raise CaptureError(error.reason) from error
        if (frame.mosaic.shape, frame.cfa) != (self.shape, self.cfa):
            rows, columns = frame.mosaic.shape
            raise RawFrameError(
                f"it is {rows}x{columns} {frame.cfa} instead of {self.shape[0]}x{self.shape[1]} "
                f"{self.cfa}"
            )
        return replace(frame, exposure_s=self.exposure_s, gain=self.gain, host_time_s=host_time_s)

    def temperatures_c(self) -> dict[str, float]:
        """Return the camera's temperature, by the selector it has now; {} where it has none."""
        has = self.features.has(TEMPERATURE)
        return {TEMPERATURE: self.features.number(TEMPERATURE)} if has else {}

    def _choose_format(self) -> PixelFormat:
        features = self.features
        offered = features.choices("PixelFormat")
        if features.is_writable("PixelFormat"):
            best = next((form.name for form in FORMATS if form.name in offered), None)
            if best is None:
                raise CameraSettingError(
                    "PixelFormat", f"offers {', '.join(offered)}, none of which is raw"
                )
            features.set("PixelFormat", best)
        name = str(features.value("PixelFormat"))
        if name not in BY_NAME:
            raise CameraSettingError("PixelFormat", f"is {name}, which is not raw")
        return BY_NAME[name]

    def _first_of(self, names: tuple[str, ...]) -> str:
        return next((name for name in names if self.features.has(name)), "")

    def _set_if_possible(self, name: str, value: str | int) -> bool:
        """Set a feature where the camera has it and takes that value; return whether it did."""
        features = self.features
        try:
            if not features.is_writable(name):
                return False
            if isinstance(value, str) and value not in features.choices(name):
                return False
            features.set(name, value)
        except (CameraDescriptionError, CameraSettingError, CameraRefusedError) as error:
            _log.debug("%s: %s stays as it is (%s)", self._device.name, name, error)
            return False
        return True

    def _read_settings(self) -> None:
        """Take the settings over as the camera has them."""
        features = self.features
        name = self._exposure_name
        unit_s = SECONDS.get(features.unit(name), SECONDS[""])
        self._exposure_unit_s = unit_s
        self.exposure_s = features.number(name) * unit_s
        low, high = (end * unit_s for end in features.limits(name))
        self.exposure_limits_s: Limits = (max(low, SHORTEST_S), min(high, LONGEST_S))
        if not features.is_writable(name):
            self.exposure_limits_s = (self.exposure_s, self.exposure_s)
        self.gain, self.gain_limits = 1.0, (1.0, 1.0)
        if self._gain_name:
            self.gain = self._linear(features.number(self._gain_name))
            low, high = (self._linear(end) for end in features.limits(self._gain_name))
            self.gain_limits = (max(low, 1e-3), min(high, 1e6))
            if not features.is_writable(self._gain_name):
                self.gain_limits = (self.gain, self.gain)
        self.white_level_dn = self._format.white_dn
        self.black_level_dn = self._black_level_dn()
        self._period_s = 0.0
        if features.has(RATE):
            self._period_s = 1 / max(features.number(RATE), 1 / LONGEST_S)
        self._in_flight = IN_FLIGHT

    def _linear(self, shown: float) -> float:
        if self._gain_in_decibels():
            return 10 ** (min(max(shown, -60.0), 120.0) / 20)
        return shown

    def _gain_in_decibels(self) -> bool:
        return self.features.unit(self._gain_name).lower() in DECIBEL

    def _black_level_dn(self) -> float:
        name = self._first_of(BLACK_LEVEL_NAMES)
        if not name:
            return 0.0
        shown = float(self.features.number(name))
        if self.features.unit(name) == "%":
            shown *= self.white_level_dn / 100
        return min(max(shown, 0.0), float(self.white_level_dn))


def decode_frame(
    original: bytes, black_level_dn: float = 0.0, white_level_dn: int | None = None
) -> RawFrame:
    """Return the frame in a leader, payload and trailer, as `RawFrame.original` holds them.

    Values that the bytes do not state are None, or as given here. Raises `CameraFormatError` for
    bytes that are no frame, `RawFrameError` for a frame with pixels that cannot be unpacked.
    """
    leader, payload, trailer = codec.split_frame(original)
    form = BY_CODE.get(leader.pixel_format)
    if form is None:
        raise RawFrameError(f"its pixel format {leader.pixel_format:#010x} is not raw")
    shape = (leader.height, leader.width)
    needed = image_bytes(form, shape, leader.padding_x)
    if not 0 < needed <= min(len(payload), trailer.valid_bytes):
        raise RawFrameError(
            f"{min(len(payload), trailer.valid_bytes)} bytes are not the {needed} of "
            f"{shape[0]}x{shape[1]} pixels of {form.name}"
        )
    with hashed(original) as digest:
        mosaic = unpack(payload, form, shape, leader.padding_x)
    black = np.full((2, 2), float(black_level_dn))
    mosaic.flags.writeable = False
    black.flags.writeable = False
    return RawFrame(
        mosaic=mosaic,
        black_level_dn=black,
        white_level_dn=form.white_dn if white_level_dn is None else white_level_dn,
        cfa=form.cfa,
        exposure_s=None,
        original=original,
        sha256=digest.hexdigest(),
        camera_time_s=leader.timestamp_ns / 1e9,
        metadata={
            "pixel_format": form.name,
            "block_id": str(leader.block_id),
            "offset_x": str(leader.offset_x),
            "offset_y": str(leader.offset_y),
        },
    )


def read_description(control: U3vControl) -> bytes:
    """Return the camera's XML, from its manifest table; raises `CameraDescriptionError`."""
    table = control.integer(codec.ABRM_MANIFEST, 8)
    count = control.integer(table, 8)
    if not 0 < count <= MANIFEST_LIMIT:
        raise CameraDescriptionError(f"its manifest table has {count} entries")
    size = codec.MANIFEST_ENTRY_SIZE
    entries = [
        codec.decode_manifest_entry(control.read(table + 8 + i * size, size)) for i in range(count)
    ]
    usable = [
        entry
        for entry in entries
        if entry.file_type == 0 and entry.file_format in (codec.XML_PLAIN, codec.XML_ZIPPED)
    ]
    if not usable:
        raise CameraDescriptionError("its manifest table names no XML")
    entry = max(usable, key=lambda entry: entry.version)
    if not 0 < entry.size <= XML_LIMIT:
        raise CameraDescriptionError(f"its XML is {entry.size} bytes long")
    data = control.read(entry.address, entry.size)
    if any(entry.sha1) and hashlib.sha1(data, usedforsecurity=False).digest() != entry.sha1:
        raise CameraDescriptionError("the XML and its checksum differ")
    return _unzipped(data) if entry.file_format == codec.XML_ZIPPED else data.rstrip(b"\0")


def _unzipped(data: bytes) -> bytes:
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        with archive.open(archive.infolist()[0]) as file:
            xml = file.read(UNZIPPED_LIMIT + 1)
    except Exception as error:  # zipfile raises whatever it runs into in a damaged archive
        raise CameraDescriptionError(f"its zipped XML cannot be unpacked ({error})") from error
    if len(xml) > UNZIPPED_LIMIT:
        raise CameraDescriptionError(f"its XML unpacks to more than {UNZIPPED_LIMIT} bytes")
    return xml

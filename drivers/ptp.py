"""PTP still cameras: sessions, captures, downloads, and the camera that gives RAW frames.

Source: ISO 15740 (PIMA 15740:2000), clauses 10 (operations), 11 (responses), 12 (events) and
13 (properties). Cameras that release by operations of their makers' own are `drivers.gphoto`'s.
"""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import IntEnum
from typing import Any

from emmc_rig.drivers import ptp_codec as codec
from emmc_rig.drivers.camera import (
    EXPOSURE_UNIT_S,
    CameraIdentity,
    Limits,
    ShapeFromFrames,
    check_setting,
)
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import (
    CameraBusyError,
    CameraClosedError,
    CameraFormatError,
    CameraRefusedError,
    CameraSettingError,
    CaptureError,
    CardFullError,
    DownloadError,
    DriverError,
    ExposureStoppedError,
    UsbStalledError,
    UsbTimeoutError,
)
from emmc_rig.drivers.ptp_codec import (
    Code,
    EventCode,
    Format,
    Message,
    ObjectInfo,
    Operation,
    Property,
)
from emmc_rig.drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from emmc_rig.drivers.raw import RawFrame, has_raw_suffix
from emmc_rig.drivers.transport import repeated
from emmc_rig.drivers.usb import open_device

_log = logging.getLogger(__name__)

SESSION = 1
OPEN_ATTEMPTS = 3
LAST_TRANSACTION = 0xFFFFFFFE
MOST_DATASET_BYTES = 1 << 24
STALE_EVENTS_TOLERATED = 64
NO_WAIT_S = 0.001
MOST_NEW_OBJECTS = 64
LONGEST_EXPOSURE_S = 3600.0
"""Upper bound on the wait for an exposure, whatever the camera states."""
EXPOSURE_SPECIALS = frozenset((0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD))
"""Bulb and time, by which no exposure can be asked for."""
ISO_SPECIALS = frozenset((0xFFFF,))
"""Automatic."""

REFUSALS: Mapping[int, str] = {
    Code.SESSION_NOT_OPEN: "open the camera again",
    Code.OPERATION_NOT_SUPPORTED: "this camera cannot do it by the standard of PTP; look in its "
    "menus for a mode like PTP, PC remote or tethering, or open it as gphoto2:",
    Code.INVALID_HANDLE: "the picture is gone from the card",
    Code.PROPERTY_NOT_SUPPORTED: "set it on the camera itself",
    Code.STORE_READ_ONLY: "unlock the card",
    Code.WRITE_PROTECTED: "the picture is protected, unprotect it on the camera",
    Code.ACCESS_DENIED: "turn its mode dial to M, and wake it up",
    Code.STORE_NOT_AVAILABLE: "insert a card",
    Code.INVALID_PROPERTY_VALUE: "choose another value; its mode dial may limit them",
}
SEE_MANUAL = "switch it off and on, then try again; see its manual"

Parameters = tuple[int, ...]


@dataclass(frozen=True)
class PtpSettings:
    """How patient the driver is.

    busy_limit_s: how long "busy" is believed. capture_limit_s: from the end of the exposure until
    the picture is on the card. pair_limit_s: how long to wait for a RAW file once the camera says
    that it is done. attempts: how often a picture is fetched, where that breaks off.
    """

    busy_limit_s: float = 10.0
    busy_poll_s: float = 0.1
    capture_limit_s: float = 20.0
    pair_limit_s: float = 2.0
    event_poll_s: float = 0.5
    attempts: int = 3


class PtpSession:
    """An open session with a camera, whose DeviceInfo is `info`.

    An exchange that breaks off, Ctrl-C included, is cleared away before the next one. Any thread
    may call; `lock` is held for one exchange, and by a camera for a whole capture.
    """

    def __init__(
        self,
        transport: PtpUsb,
        clock: Clock = SYSTEM_CLOCK,
        settings: PtpSettings | None = None,
    ) -> None:
        self.lock = threading.RLock()
        self.name = transport.name
        self.clock = clock
        self.settings = settings or PtpSettings()
        self._transport = transport
        self._transaction = 0
        self._broken = False
        self._picture_pending = False
        self._stop_wanted = threading.Event()
        self._closed = False
        try:
            self._open()
            self.info = codec.DeviceInfo.decode(self.fetch(Operation.GET_DEVICE_INFO))
        except BaseException:
            transport.close()
            raise

    def close(self) -> None:
        """End the session and let go of the camera, there or not; closing twice is allowed."""
        with self.lock:
            if self._closed:
                return
            try:
                # It may be unplugged or off: then there is no session to end.
                with suppress(DriverError):
                    self.request(Operation.CLOSE_SESSION, patient=False)
            finally:
                self._closed = True
                self._transport.close()

    def can(self, operation: int) -> bool:
        """Whether the camera says that it knows the operation."""
        return operation in self.info.operations

    def request(
        self,
        operation: int,
        *parameters: int,
        data: bytes | None = None,
        sink: Callable[[memoryview], object] = lambda piece: None,
        most: int = MOST_DATASET_BYTES,
        patient: bool = True,
    ) -> Parameters:
        """Make one exchange and return the response's parameters; "busy" is asked again.

        Raises `CameraBusyError`, `CardFullError`, `CameraRefusedError`, or an error of the
        transport. Not `patient`: busy at once.
        """
        started_s = self.clock.now_s()
        while True:
            response = self._exchange(operation, parameters, data, sink, most)
            if response.code == Code.OK:
                return response.parameters
            if response.code == Code.STORE_FULL:
                raise CardFullError(self.name)
            if response.code != Code.BUSY:
                raise _refused(operation, response.code)
            waited_s = self.clock.now_s() - started_s
            if not patient or waited_s >= self.settings.busy_limit_s:
                raise CameraBusyError(f"for {_shown(operation)}", waited_s)
            self.clock.sleep(self.settings.busy_poll_s)

    def fetch(self, operation: int, *parameters: int, patient: bool = True) -> bytes:
        """Make one exchange and return the data that came; raises as `request`."""
        received = io.BytesIO()
        self.request(operation, *parameters, sink=received.write, patient=patient)
        return received.getvalue()

    def handles(self, patient: bool = True) -> tuple[int, ...]:
        """Return the handles of everything on the cards."""
        data = self.fetch(Operation.GET_OBJECT_HANDLES, codec.EVERYTHING, 0, 0, patient=patient)
        return codec.decode_handles(data)

    def object_info(self, handle: int) -> ObjectInfo:
        """Return what an object is."""
        return ObjectInfo.decode(self.fetch(Operation.GET_OBJECT_INFO, handle))

    def storages(self) -> tuple[codec.StorageInfo, ...]:
        """Return the cards in the camera."""
        ids = codec.decode_handles(self.fetch(Operation.GET_STORAGE_IDS))
        return tuple(
            codec.StorageInfo.decode(self.fetch(Operation.GET_STORAGE_INFO, storage))
            for storage in ids
        )

    def describe(self, code: int) -> codec.PropertyDescription | None:
        """Return a property's type, value and choices, None where the camera lacks it."""
        if code not in self.info.properties:
            return None
        return codec.decode_description(self.fetch(Operation.GET_PROPERTY_DESCRIPTION, code))

    def read(self, described: codec.PropertyDescription) -> int:
        """Return a property's present value."""
        data = self.fetch(Operation.GET_PROPERTY, described.code)
        return codec.decode_value(described.data_type, data)

    def write(self, described: codec.PropertyDescription, value: int) -> int:
        """Set a property and return what the camera made of it."""
        data = codec.encode_value(described.data_type, value)
        self.request(Operation.SET_PROPERTY, described.code, data=data)
        return self.read(described)

    def capture(
        self, exposure_s: float, accept: Callable[[ObjectInfo], bool]
    ) -> tuple[int, ObjectInfo]:
        """Release the shutter and return handle and info of the first new object that is accepted.

        Folders are passed over. An event that never comes is made up for by looking at the card.
        Raises `CaptureError`, `CardFullError`, or as `request` does.
        """
        with self.lock:
            self._forget_events()
            seen = set(self.handles())
            self._stop_wanted.clear()
            self.request(Operation.INITIATE_CAPTURE, 0, 0)
            self._picture_pending = True
            taken = self._await_object(seen, self._transaction, exposure_s, accept)
            self._picture_pending = False
            return taken

    def stop_capture(self) -> None:
        """Let the capture under way raise `ExposureStoppedError`; any thread may call."""
        self._stop_wanted.set()

    def download(
        self,
        handle: int,
        info: ObjectInfo,
        on_progress: Callable[[int, int], object] = lambda done, size: None,
    ) -> bytes:
        """Return the bytes of an object; one that breaks off is fetched again, as `settings` say.

        `on_progress` gets bytes done and in all. Raises `DownloadError`, or as `request` does.
        """
        known = info.size != codec.EVERYTHING
        most = info.size if known else codec.EVERYTHING

        def fetch() -> bytes:
            received, reason = io.BytesIO(), "the camera sent no more"

            def take(piece: memoryview) -> None:
                received.write(piece)
                on_progress(received.tell(), info.size if known else received.tell())

            try:
                self.request(Operation.GET_OBJECT, handle, sink=take, most=most)
                if not known or received.tell() == info.size:
                    return received.getvalue()
            except (CameraFormatError, UsbTimeoutError, UsbStalledError) as error:
                reason = str(error)
            raise DownloadError(info.name, received.tell(), info.size, reason)

        what = f"{self.name} to fetch {info.name}"
        return repeated(fetch, what, faults=(DownloadError,), attempts=self.settings.attempts)

    def _open(self) -> None:
        """Open the session, whatever state an earlier program left the camera in."""
        for attempt in range(OPEN_ATTEMPTS):
            last = attempt == OPEN_ATTEMPTS - 1
            try:
                response = self._exchange(
                    Operation.OPEN_SESSION, (SESSION,), None, lambda piece: None, 0, transaction=0
                )
            except (CameraFormatError, UsbTimeoutError, UsbStalledError) as error:
                if last:
                    raise
                _log.info("%s: opening it again after: %s", self.name, error)
                continue
            if response.code == Code.OK:
                return
            if response.code == Code.BUSY and not last:
                self.clock.sleep(self.settings.busy_poll_s)
            elif response.code == Code.SESSION_ALREADY_OPEN and not last:
                _log.info("%s: closing a session that was left open", self.name)
                try:
                    self.request(Operation.CLOSE_SESSION)
                except CameraRefusedError:
                    self._transport.reset()
            else:
                raise _refused(Operation.OPEN_SESSION, response.code)

    def _exchange(
        self,
        operation: int,
        parameters: Parameters,
        data: bytes | None,
        sink: Callable[[memoryview], object],
        most: int,
        transaction: int | None = None,
    ) -> Message:
        with self.lock:
            if self._closed:
                raise CameraClosedError(self.name)
            if self._broken:
                self._transport.recover(self._transaction)
            if transaction is None:
                transaction = self._transaction % LAST_TRANSACTION + 1
            self._transaction = transaction
            command = Message(codec.Kind.COMMAND, operation, self._transaction, parameters)
            self._broken = True
            response = self._transport.exchange(command, data, sink, most)
            self._broken = False
            return response

    def _forget_events(self) -> None:
        """Read events away; one picture too late must not pass for the next."""
        wait_s = self.settings.pair_limit_s if self._picture_pending else NO_WAIT_S
        for _ in range(STALE_EVENTS_TOLERATED):
            if self._transport.event(wait_s) is None:
                return

    def _await_object(
        self,
        seen: set[int],
        transaction: int,
        exposure_s: float,
        accept: Callable[[ObjectInfo], bool],
    ) -> tuple[int, ObjectInfo]:
        settings, clock = self.settings, self.clock
        exposed_s = clock.now_s() + min(exposure_s, LONGEST_EXPOSURE_S)
        deadline_s = exposed_s + settings.capture_limit_s
        others: list[str] = []
        while (now_s := clock.now_s()) < deadline_s:
            if self._stop_wanted.is_set() and now_s < exposed_s:
                # Device Reset Request: the camera becomes idle (USB Still Image Capture, 5.2.3).
                self._transport.reset()
                self._open()
                raise ExposureStoppedError(self.name)
            event = self._transport.event(min(settings.event_poll_s, deadline_s - now_s))
            if event is None and clock.now_s() < exposed_s:
                continue
            new = self._new_objects(event, seen)
            if len(new) > MOST_NEW_OBJECTS:
                raise CaptureError(f"{len(new)} new objects at once", "open the camera again")
            for handle in new:
                seen.add(handle)
                info = self.object_info(handle)
                if info.format == Format.FOLDER:
                    continue
                if accept(info):
                    return handle, info
                others.append(info.name)
            if event is None:
                continue
            if event.code == EventCode.STORE_FULL:
                raise CardFullError(self.name)
            if event.code == EventCode.CAPTURE_COMPLETE and event.transaction in (
                0,
                transaction,
                codec.EVERYTHING,
            ):
                grace_s = settings.pair_limit_s
                deadline_s = min(deadline_s, max(clock.now_s(), exposed_s) + grace_s)
        if others:
            raise CaptureError(
                f"the camera gave {', '.join(others)}",
                "set its image quality to RAW, or RAW with JPEG",
            )
        raise CaptureError(
            f"nothing new on the card after {clock.now_s() - exposed_s + exposure_s:.3g} s",
            "check focus (switch it to manual), mode dial and card",
        )

    def _new_objects(self, event: Message | None, seen: set[int]) -> list[int]:
        if event is None or event.code == EventCode.CAPTURE_COMPLETE:
            try:
                return [handle for handle in self.handles(patient=False) if handle not in seen]
            except CameraBusyError:
                return []
        if event.code == EventCode.OBJECT_ADDED and event.parameters:
            return [handle for handle in event.parameters[:1] if handle not in seen]
        return []


def is_raw(info: ObjectInfo) -> bool:
    """Whether an object is a RAW file: by its format for DNG, else by its name."""
    return info.format == Format.DNG or has_raw_suffix(info.name)


class Dial:
    """A numeric property of the camera, in multiples of `unit`; `special` values are no numbers."""

    def __init__(
        self, session: PtpSession, code: Property, unit: float, special: frozenset[int]
    ) -> None:
        self._session = session
        self._unit = unit
        self._special = special
        self._described = session.describe(code)
        self._now = self._described.current if self._described else None

    @property
    def value(self) -> float | None:
        """What it is; None where the camera does not say, or it is automatic."""
        now = self._now
        if now is None or now <= 0 or now in self._special:
            return None
        return now * self._unit

    @property
    def limits(self) -> Limits | None:
        """Lowest and highest value; None where it cannot be chosen."""
        if self._described is None or not self._described.writable:
            return None
        low, high = codec.limits(self._described, self._special)
        return low * self._unit, high * self._unit

    def choose(self, target: float) -> None:
        """Set the nearest value that the camera has; raises `CameraSettingError`."""
        described = self._described
        if described is None or not described.writable:
            return
        value = codec.nearest(described, target / self._unit, self._special)
        try:
            self._now = self._session.write(described, value)
        except ValueError as error:
            raise CameraSettingError(f"property {described.code:#06x}", str(error)) from error


class PtpCamera(ShapeFromFrames):
    """A still camera set to RAW (or RAW with JPEG) and manual exposure.

    PTP does not state how large a RAW frame is: where `shape` is not given, asking for it before
    the first frame exposes one. Every frame must have that shape and its colours. `from_card`:
    delete each RAW file from the card once it has arrived; otherwise the card fills up.
    `on_progress` gets the bytes of a picture done and in all.
    """

    def __init__(
        self,
        session: PtpSession,
        shape: tuple[int, int] | None = None,
        cfa: str | None = None,
        from_card: bool = False,
        on_progress: Callable[[int, int], object] = lambda done, size: None,
    ) -> None:
        self.session = session
        self.on_progress = on_progress
        self._shape = shape
        self._cfa = cfa
        self._from_card = from_card
        try:
            info = session.info
            if not session.can(Operation.INITIATE_CAPTURE):
                raise _refused(Operation.INITIATE_CAPTURE, Code.OPERATION_NOT_SUPPORTED)
            self._exposure = Dial(
                session, Property.EXPOSURE_TIME, EXPOSURE_UNIT_S, EXPOSURE_SPECIALS
            )
            self._iso = Dial(session, Property.EXPOSURE_INDEX, 1.0, ISO_SPECIALS)
            self.identity = CameraIdentity(info.maker, info.model, info.serial, info.version)
        except BaseException:
            session.close()
            raise

    def __enter__(self) -> PtpCamera:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame, as the camera states it."""
        exposure_s = self._exposure.value
        if exposure_s is None:
            raise CameraSettingError("exposure", "is not reported over PTP: see the frames' own")
        return exposure_s

    @property
    def exposure_limits_s(self) -> Limits:
        """Shortest and longest exposure; equal where it cannot be chosen."""
        return self._exposure.limits or (self.exposure_s, self.exposure_s)

    @property
    def gain(self) -> float:
        """Gain of the next frame: ISO over the lowest ISO."""
        return (self._iso.value or self._base_iso) / self._base_iso

    @property
    def gain_limits(self) -> Limits:
        """Lowest and highest gain; equal where it cannot be chosen."""
        limits = self._iso.limits
        if limits is None:
            return self.gain, self.gain
        return limits[0] / self._base_iso, limits[1] / self._base_iso

    def details(self) -> dict[str, str]:
        """Return what else the camera says of itself, by name."""
        battery = self.session.describe(Property.BATTERY_LEVEL)
        cards = ", ".join(
            f"{card.free_bytes / 1e9:.3g} of {card.capacity_bytes / 1e9:.3g} GB free"
            for card in self.session.storages()
        )
        return {
            "battery": f"{battery.current} %" if battery and battery.current else "not reported",
            "cards": cards or "none",
        }

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow: the nearest that the camera has.

        Raises `ValueError` unless positive, `CameraSettingError` outside the limits, or an error
        of the session.
        """
        check_setting("exposure in seconds", exposure_s, self.exposure_limits_s)
        if self._exposure.limits is not None:
            self._exposure.choose(exposure_s)

    def set_gain(self, gain: float) -> None:
        """Choose the gain of the frames that follow: the nearest ISO; raises as the exposure."""
        check_setting("gain", gain, self.gain_limits)
        if self._iso.limits is not None:
            self._iso.choose(gain * self._base_iso)

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises `RawFrameError` or an error of the session.

        The frame's exposure is the file's own where it states one: PTP only knows 0.1 ms.
        """
        session = self.session
        with session.lock:
            exposure_s = self._exposure.value
            handle, info = session.capture(exposure_s or 0.0, is_raw)
            data = session.download(handle, info, self.on_progress)
            frame = self._decoded(info.name, data, exposure_s, self.gain, session.clock.now_s())
            if self._from_card:
                session.request(Operation.DELETE_OBJECT, handle, 0)
        return replace(frame, camera_time_s=_camera_time_s(info.captured))

    def stop_exposure(self) -> bool:
        """Break off the exposure under way, within half a second; any thread may call.

        `snap` raises `ExposureStoppedError`.
        """
        self.session.stop_capture()
        return True

    def close(self) -> None:
        """End the session and let go of the camera; closing twice is allowed."""
        self.session.close()

    @property
    def _base_iso(self) -> float:
        limits = self._iso.limits
        return limits[0] if limits else self._iso.value or 1.0


def open_camera(
    address: str,
    clock: Clock,
    backend: Any = None,
    shape: tuple[int, int] | None = None,
    cfa: str | None = None,
    from_card: bool = False,
) -> PtpCamera:
    """Open the camera with a serial number, "" for the first; the rest as in `PtpCamera`."""
    device = open_device(PTP_INTERFACE, serial=address, backend=backend, wanted="PTP camera")
    return PtpCamera(PtpSession(PtpUsb(device, clock), clock), shape, cfa, from_card)


def _camera_time_s(text: str) -> float | None:
    """Return a PTP date (YYYYMMDDThhmmss, camera's own time zone) in seconds since 1970."""
    try:
        moment = datetime.strptime(text[:15], "%Y%m%dT%H%M%S")
    except ValueError:
        return None
    return moment.replace(tzinfo=UTC).timestamp()


def _words(codes: type[IntEnum], value: int, unknown: str = "") -> str:
    """Return a code's name in words, else its number after `unknown`."""
    names = (code.name.lower().replace("_", " ") for code in codes if code == value)
    return next(names, f"{unknown}{value:#06x}")


def _shown(operation: int) -> str:
    return _words(Operation, operation, "operation ")


def _refused(operation: int, code: int) -> CameraRefusedError:
    advice = REFUSALS.get(code, SEE_MANUAL)
    return CameraRefusedError(_shown(operation), _words(Code, code), advice)

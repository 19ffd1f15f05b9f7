"""A still camera's firmware: PTP requests in, answers and events out, over USB or TCP.

It exposes whatever scene it is given and stores DNG files on its card. Simplified: one storage,
one folder, nothing is ever displayed. Source: ISO 15740 (PIMA 15740:2000); USB Still Image
Capture Device Definition 1.0; CIPA DC-005 (PTP/IP).
"""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import cv2
import numpy as np

from emmc_rig.drivers.camera import CameraIdentity
from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.dng import Facts, encode_dng
from emmc_rig.drivers.errors import CameraFormatError
from emmc_rig.drivers.ptp_codec import (
    EVERYTHING,
    HEADER,
    HEADER_SIZE,
    Code,
    DeviceInfo,
    EventCode,
    Format,
    Kind,
    Message,
    ObjectInfo,
    Operation,
    Property,
    PropertyDescription,
    StorageInfo,
    decode_header,
    decode_message,
    decode_value,
    encode_description,
    encode_handles,
    encode_message,
    encode_value,
)
from emmc_rig.drivers.usb import INTERRUPT
from emmc_rig.simulators.faults import Faults
from emmc_rig.simulators.usb import (
    DeviceSpec,
    EndpointSpec,
    InterfaceSpec,
    StallError,
    UnpluggedError,
    UsbFunction,
)

Array = np.ndarray

FAULTS = (
    "torn_raw",
    "wrong_size",
    "busy",
    "late",
    "drop_event",
    "duplicate_event",
    "drop_complete",
    "unplug_in_download",
    "stall_in_download",
    "lost_bytes",
    "garbled_header",
    "silent",
    "card_full",
    "stuck_exposure",
)
STORAGE = 0x00010001
FOLDER = 1
EXPOSURE_UNIT_S = 1e-4
WRITE_S = 0.05
"""From the end of the exposure until the file is on the card."""
LATE_S = 60.0
EPOCH = datetime(2024, 1, 1, tzinfo=UTC)

UINT8, UINT16, UINT32 = 2, 4, 6
ANY_EXPOSURE = (1, 36_000_000, 1)
"""0.1 ms to an hour."""
THIRD_STOPS = tuple(
    round(10_000 / n)
    for n in (
        1 / 30, 1 / 15, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4, 8, 15, 30, 60, 125, 250, 500, 1000, 2000, 4000
    )
)  # fmt: skip
ISOS = (100, 200, 400, 800, 1600)

BULK_OUT, BULK_IN, INTERRUPT_IN = 0x02, 0x81, 0x83
CANCEL_REQUEST, DEVICE_RESET, DEVICE_STATUS = 0x64, 0x66, 0x67


@dataclass(frozen=True)
class Answer:
    """What a request brings: a response code, its parameters, and data."""

    code: int = Code.OK
    parameters: tuple[int, ...] = ()
    data: bytes | memoryview | None = None


class PtpCameraSimulator:
    """The camera behind whatever wire; subclasses are other makers' cameras.

    `render(exposure_s)` returns the uint16 `(y, x)` mosaic in DN that the sensor reads at the
    lowest ISO, called when the exposure is over. `exposures`: the choices in units of 0.1 ms, or
    (lowest, highest, step) in `span`. `quality`: "raw", "raw+jpeg" or "jpeg". `lacks`: operations
    of the standard that the camera refuses. Faults are armed with `faults.inject`; those of the
    wire strike there.
    """

    maker, model = "EMMC", "EMMC simulated camera"
    vendor_extension = 0
    vendor_operations: tuple[int, ...] = ()
    hidden: tuple[int, ...] = ()
    """Properties of the standard that the camera lacks."""
    with_data: tuple[int, ...] = (Operation.SET_PROPERTY,)
    """Operations that the host sends data with."""

    def __init__(
        self,
        render: Callable[[float], Array],
        clock: Clock,
        cfa: str = "rggb",
        black_level_dn: float | Array = 64,
        white_level_dn: int = 4095,
        *,
        exposures: tuple[int, ...] = THIRD_STOPS,
        span: tuple[int, int, int] | None = None,
        quality: str = "raw",
        lacks: tuple[Operation, ...] = (),
        capacity_bytes: int = 1 << 36,
        serial: str = "S1",
    ) -> None:
        self.faults = Faults(FAULTS)
        self.quality = quality
        self.serial = serial
        self.session = 0
        self.objects: dict[int, tuple[ObjectInfo, bytes]] = {}
        self.events: deque[Message] = deque()
        self._render = render
        self._clock = clock
        self._cfa = cfa
        self._black_dn = black_level_dn
        self._white_dn = white_level_dn
        self._lacks = frozenset(lacks)
        self._capacity_bytes = capacity_bytes
        self._exposures, self._span = exposures, span
        self._values = {
            Property.BATTERY_LEVEL: 87,
            Property.EXPOSURE_PROGRAM: 1,
            Property.EXPOSURE_TIME: 100 if span else min(exposures, key=lambda v: abs(v - 100)),
            Property.EXPOSURE_INDEX: min(ISOS),
        }
        self._last_handle = FOLDER
        self._shots = 0
        self._due: tuple[float, float, int] | None = None
        self._orphaned = False
        self._lock = threading.RLock()

    def power_up(self) -> None:
        """Forget the session and a capture under way; the card keeps its files."""
        with self._lock:
            self.session = 0
            self._due, self._orphaned = None, False
            self.events.clear()

    def end_session(self) -> None:
        """Close the session, if one is open; its events go with it, a picture is still stored."""
        with self._lock:
            self.session = 0
            self.events.clear()
            self._orphaned = self._due is not None

    def wait_event(self, timeout_s: float) -> Message | None:
        """Return the next event, letting time pass until it comes; None: none in time."""
        with self._lock:
            self.advance()
            wait_s = 0.0
            if not self.events and self._due is not None:
                wait_s = max(0.0, self._due[0] - self._clock.now_s())
        if wait_s > timeout_s:
            return None
        self._clock.sleep(wait_s)
        with self._lock:
            self.advance()
            return self.events.popleft() if self.events else None

    def advance(self) -> None:
        """Advance to the time of the clock: a capture that is over puts its files on the card."""
        if self._due is None or self._clock.now_s() < self._due[0]:
            return
        _, exposure_s, transaction = self._due
        self._due = None
        before = self.events.copy()
        self._store_shot(exposure_s, transaction)
        if self._orphaned:
            self.events, self._orphaned = before, False

    def respond(self, request: Message, data: bytes) -> Answer:
        """Carry out a request; `data` is what came with it."""
        with self._lock:
            self.advance()
            if self.faults.strikes("busy"):
                return Answer(Code.BUSY)
            if not self.session and request.code not in _WITHOUT_SESSION:
                return Answer(Code.SESSION_NOT_OPEN)
            arguments = (*request.parameters, 0, 0, 0, 0, 0)
            if request.code in self.vendor_operations:
                return self._vendor_answer(request.code, arguments, data, request.transaction)
            return self._standard_answer(request.code, arguments, data, request.transaction)

    def _standard_answer(
        self, code: int, arguments: tuple[int, ...], data: bytes, transaction: int
    ) -> Answer:
        """Carry out an operation of the standard, by the method of its name."""
        if code not in tuple(Operation) or code in self._lacks:
            return Answer(Code.OPERATION_NOT_SUPPORTED)
        answer = getattr(self, f"_{Operation(code).name.lower()}")
        return answer(arguments, data, transaction)

    def _vendor_answer(
        self, code: int, arguments: tuple[int, ...], data: bytes, transaction: int
    ) -> Answer:
        """Carry out one of `vendor_operations`."""
        return Answer(Code.OPERATION_NOT_SUPPORTED)

    def _get_device_info(self, *request: object) -> Answer:
        info = DeviceInfo(
            operations=(
                *(o for o in Operation if o not in self._lacks),
                *self.vendor_operations,
            ),
            vendor_extension=self.vendor_extension,
            events=tuple(EventCode),
            properties=tuple(code for code in self._values if code not in self.hidden),
            capture_formats=(Format.DNG,),
            image_formats=(Format.DNG, Format.JPEG),
            maker=self.maker,
            model=self.model,
            version="1.0",
            serial=self.serial,
        )
        return Answer(data=info.encode())

    def _open_session(self, arguments: tuple[int, ...], *request: object) -> Answer:
        if self.session:
            return Answer(Code.SESSION_ALREADY_OPEN, (self.session,))
        if not arguments[0]:
            return Answer(Code.INVALID_PARAMETER)
        self.session = arguments[0]
        return Answer()

    def _close_session(self, *request: object) -> Answer:
        self.end_session()
        return Answer()

    def _get_storage_ids(self, *request: object) -> Answer:
        return Answer(data=encode_handles((STORAGE,)))

    def _get_storage_info(self, arguments: tuple[int, ...], *request: object) -> Answer:
        if arguments[0] != STORAGE:
            return Answer(Code.INVALID_STORAGE)
        free = max(0, self._capacity_bytes - self._used_bytes)
        info = StorageInfo(
            capacity_bytes=self._capacity_bytes,
            free_bytes=free,
            free_images=free >> 24,
            description="card",
            label="EMMC",
        )
        return Answer(data=info.encode())

    def _get_object_handles(self, arguments: tuple[int, ...], *request: object) -> Answer:
        storage, wanted, parent = arguments[:3]
        if storage not in (STORAGE, EVERYTHING):
            return Answer(Code.INVALID_STORAGE)
        found = [
            handle
            for handle, (info, _) in self.objects.items()
            if wanted in (0, info.format)
            and (parent == 0 or info.parent == (0 if parent == EVERYTHING else parent))
        ]
        return Answer(data=encode_handles(tuple(found)))

    def _get_object_info(self, arguments: tuple[int, ...], *request: object) -> Answer:
        if arguments[0] not in self.objects:
            return Answer(Code.INVALID_HANDLE)
        return Answer(data=self.objects[arguments[0]][0].encode())

    def _get_object(self, arguments: tuple[int, ...], *request: object) -> Answer:
        if arguments[0] not in self.objects:
            return Answer(Code.INVALID_HANDLE)
        return Answer(data=memoryview(self.objects[arguments[0]][1]))

    def _delete_object(self, arguments: tuple[int, ...], *request: object) -> Answer:
        if self.objects.pop(arguments[0], None) is None:
            return Answer(Code.INVALID_HANDLE)
        return Answer()

    def _get_property_description(self, arguments: tuple[int, ...], *request: object) -> Answer:
        code = arguments[0]
        if code not in self._values or code in self.hidden:
            return Answer(Code.PROPERTY_NOT_SUPPORTED)
        return Answer(data=encode_description(self._description(code)))

    def _get_property(self, arguments: tuple[int, ...], *request: object) -> Answer:
        code = arguments[0]
        if code not in self._values or code in self.hidden:
            return Answer(Code.PROPERTY_NOT_SUPPORTED)
        described = self._description(code)
        return Answer(data=encode_value(described.data_type, described.current))

    def _set_property(self, arguments: tuple[int, ...], data: bytes, *request: object) -> Answer:
        code = arguments[0]
        if code not in self._values or code in self.hidden:
            return Answer(Code.PROPERTY_NOT_SUPPORTED)
        described = self._description(code)
        if not described.writable:
            return Answer(Code.ACCESS_DENIED)
        try:
            value = decode_value(described.data_type, data)
        except CameraFormatError:
            return Answer(Code.INVALID_PROPERTY_FORMAT)
        span = described.span
        if value not in described.choices and not (span and span[0] <= value <= span[1]):
            return Answer(Code.INVALID_PROPERTY_VALUE)
        if not self.faults.strikes("stuck_exposure"):
            self._values[Property(code)] = value
        return Answer()

    def _initiate_capture(
        self, arguments: tuple[int, ...], data: bytes, transaction: int
    ) -> Answer:
        if self._due is not None:
            return Answer(Code.BUSY)
        if self.faults.strikes("card_full") or self._used_bytes >= self._capacity_bytes:
            return Answer(Code.STORE_FULL)
        exposure_s = self._values[Property.EXPOSURE_TIME] * EXPOSURE_UNIT_S
        late_s = LATE_S if self.faults.strikes("late") else 0.0
        ready_s = self._clock.now_s() + exposure_s + WRITE_S + late_s
        self._due = (ready_s, exposure_s, transaction)
        return Answer()

    @property
    def _used_bytes(self) -> int:
        return sum(info.size for info, _ in self.objects.values())

    def _description(self, code: int) -> PropertyDescription:
        now = self._values[Property(code)]
        if code == Property.BATTERY_LEVEL:
            return PropertyDescription(code, UINT8, False, 100, now, span=(0, 100, 1))
        if code == Property.EXPOSURE_PROGRAM:
            return PropertyDescription(code, UINT16, False, 1, now, choices=(1,))
        if code == Property.EXPOSURE_INDEX:
            return PropertyDescription(code, UINT16, True, min(ISOS), now, ISOS)
        if self._span:
            return PropertyDescription(code, UINT32, True, 100, now, span=self._span)
        return PropertyDescription(code, UINT32, True, 100, now, self._exposures)

    def _store_shot(self, exposure_s: float, transaction: int) -> None:
        """Read the sensor out, and put the files of the shot, and events, where they belong."""
        mosaic = self._amplified(self._render(exposure_s))
        if self.faults.strikes("wrong_size"):
            mosaic = mosaic[:-2]
        self._shots += 1
        handles = []
        if FOLDER not in self.objects:
            handles.append(self._store("100EMMC", Format.FOLDER, b"", 0, FOLDER))
        name = f"EMMC{self._shots:04d}"
        if self.quality != "raw":
            handles.append(self._store(f"{name}.JPG", Format.JPEG, _jpeg(mosaic)))
        if self.quality != "jpeg":
            data = encode_dng(
                mosaic,
                self._cfa,
                self._black_dn,
                self._white_dn,
                exposure_s,
                CameraIdentity(self.maker, self.model, self.serial),
                facts=Facts(self._values[Property.EXPOSURE_INDEX], self._moment()),
            )
            if self.faults.strikes("torn_raw"):
                data = data[: -len(data) // 4]
            handles.append(self._store(f"{name}.DNG", Format.DNG, data))
        for handle in handles:
            if not self.faults.strikes("drop_event"):
                self._queue_event(EventCode.OBJECT_ADDED, transaction, handle)
            if self.faults.strikes("duplicate_event"):
                self._queue_event(EventCode.OBJECT_ADDED, transaction, handle)
        if not self.faults.strikes("drop_complete"):
            self._queue_event(EventCode.CAPTURE_COMPLETE, transaction)

    def _amplified(self, mosaic: Array) -> Array:
        """Return the mosaic at the present ISO: signal and noise alike grow above the black."""
        gain = self._values[Property.EXPOSURE_INDEX] / min(ISOS)
        if gain == 1:
            return mosaic
        black = np.tile(np.broadcast_to(self._black_dn, (2, 2)), (mosaic.shape[0] // 2 + 1, 1))
        black = np.tile(black, (1, mosaic.shape[1] // 2 + 1))[: mosaic.shape[0], : mosaic.shape[1]]
        amplified = np.rint(black + gain * (mosaic.astype(np.float64) - black))
        return np.clip(amplified, 0, self._white_dn).astype(np.uint16)

    def _moment(self) -> datetime:
        """Return the time of day on the camera's own clock."""
        return EPOCH + timedelta(seconds=self._clock.now_s())

    def _store(
        self, name: str, kind: int, data: bytes, parent: int = FOLDER, handle: int = 0
    ) -> int:
        if not handle:
            self._last_handle += 1
            handle = self._last_handle
        stamp = self._moment().strftime("%Y%m%dT%H%M%S")
        info = ObjectInfo(
            storage=STORAGE,
            format=kind,
            size=len(data),
            parent=parent,
            name=name,
            captured=stamp,
            modified=stamp,
            association_type=int(kind == Format.FOLDER),
        )
        self.objects[handle] = (info, data)
        return handle

    def _queue_event(self, code: int, transaction: int, *parameters: int) -> None:
        self.events.append(Message(Kind.EVENT, code, transaction, parameters))


_WITHOUT_SESSION = (Operation.GET_DEVICE_INFO, Operation.OPEN_SESSION)


class PtpUsbFunction(UsbFunction):
    """The camera's USB side: containers in packets, events by interrupt, class requests."""

    def __init__(self, camera: PtpCameraSimulator, packet_size: int = 512) -> None:
        self.camera = camera
        self.spec = DeviceSpec(
            0x1209,
            0xE331,
            "EMMC",
            "EMMC simulated camera",
            camera.serial,
            (
                InterfaceSpec(
                    (6, 1, 1),
                    (
                        EndpointSpec(BULK_OUT, packet_size=packet_size),
                        EndpointSpec(BULK_IN, packet_size=packet_size),
                        EndpointSpec(INTERRUPT_IN, INTERRUPT, 64),
                    ),
                ),
            ),
        )
        self._received = bytearray()
        self._command: Message | None = None
        self._packet_size = packet_size
        self._queue: deque[tuple[bytes | memoryview | Exception, bool]] = deque()
        self._ends = True

    def plugged(self) -> None:
        """Power comes back."""
        self._clear()
        self.camera.power_up()

    def bulk_out(self, endpoint: int, data: bytes) -> int:
        """Gather containers: a command, then its data, if any."""
        self._received += data
        while len(self._received) >= HEADER_SIZE:
            try:
                header = decode_header(bytes(self._received[:HEADER_SIZE]))
            except CameraFormatError:
                self._clear()
                raise StallError from None
            if len(self._received) < header.length:
                break
            container = bytes(self._received[: header.length])
            del self._received[: header.length]
            self._take(header.kind, container)
        return len(data)

    def bulk_in(self, endpoint: int, length: int, timeout_s: float) -> bytes | memoryview | None:
        """Return the next piece of an answer."""
        if not self._queue:
            return None
        piece, self._ends = self._queue.popleft()
        if isinstance(piece, Exception):
            raise piece
        return piece

    def ends_with_empty_packet(self, endpoint: int) -> bool:
        """Whether the piece just given is the end of a container."""
        return self._ends

    def interrupt(self, endpoint: int, length: int, timeout_s: float) -> bytes | None:
        """Return the next event."""
        event = self.camera.wait_event(timeout_s)
        return None if event is None else encode_message(event)

    def control(
        self, request_type: int, request: int, value: int, index: int, data: bytes
    ) -> bytes:
        """Cancel, reset or return the status."""
        if request in (CANCEL_REQUEST, DEVICE_RESET):
            self._clear()
            if request == DEVICE_RESET:
                self.camera.power_up()
            return b""
        if request == DEVICE_STATUS:
            return struct.pack("<HH", 4, Code.OK)
        raise StallError

    def _clear(self) -> None:
        self._received.clear()
        self._command = None
        self._queue.clear()

    def _take(self, kind: int, container: bytes) -> None:
        if kind == Kind.COMMAND:
            self._command = decode_message(container)
            if self._command.code not in self.camera.with_data:
                self._answer(self._command, b"")
        elif kind == Kind.DATA and self._command is not None:
            self._answer(self._command, container[HEADER_SIZE:])

    def _answer(self, command: Message, data: bytes) -> None:
        self._command = None
        faults = self.camera.faults
        answer = self.camera.respond(command, data)
        if faults.strikes("silent"):
            return
        if answer.data is not None:
            size = HEADER_SIZE + len(answer.data)
            header = HEADER.pack(size, Kind.DATA, command.code, command.transaction)
            if faults.strikes("garbled_header"):
                header = header[::-1]
            self._queue_data(header, memoryview(answer.data), command.code == Operation.GET_OBJECT)
        response = Message(Kind.RESPONSE, answer.code, command.transaction, answer.parameters)
        self._queue.append((encode_message(response), True))

    def _queue_data(self, header: bytes, payload: memoryview, download: bool) -> None:
        """Send a data container; the faults of a download strike in its middle.

        Only the first packet is put together; the rest goes out from where it lies.
        """
        faults, packet = self.camera.faults, self._packet_size
        first = packet - HEADER_SIZE
        if len(payload) <= first:
            self._queue.append((header + bytes(payload), True))
            return
        self._queue.append((header + bytes(payload[:first]), False))
        rest = payload[first:]
        half = len(rest) // 2 // packet * packet
        if download and faults.strikes("unplug_in_download"):
            self._queue.extend(((rest[:half], False), (UnpluggedError(), True)))
        elif download and faults.strikes("stall_in_download"):
            self._queue.extend(((rest[:half], False), (StallError(), True)))
        elif download and faults.strikes("lost_bytes"):
            self._queue.append((rest[: max(0, len(rest) - packet)], True))
        else:
            self._queue.append((rest, True))


def _jpeg(mosaic: Array) -> bytes:
    """Return a small grey JPEG of the mosaic, as a camera stores beside its RAW file."""
    grey = cv2.normalize(mosaic[::2, ::2], None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)  # type: ignore[call-overload]
    return cv2.imencode(".jpg", grey)[1].tobytes()

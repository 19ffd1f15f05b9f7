"""PTP over USB: whole containers through the bulk pipes, events through the interrupt pipe.

One thread at a time. Source: USB Still Image Capture Device Definition 1.0, clauses 5 (class
requests) and 7 (containers).
"""

from __future__ import annotations

import array
import logging
import struct
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import (
    CameraBusyError,
    CameraFormatError,
    UsbStalledError,
    UsbTimeoutError,
)
from emmc_rig.drivers.ptp_codec import (
    HEADER_SIZE,
    Code,
    Header,
    Kind,
    Message,
    decode_header,
    decode_message,
    encode_data,
    encode_message,
)
from emmc_rig.drivers.usb import BULK, INTERRUPT, UsbDevice, UsbPipe

_log = logging.getLogger(__name__)

PTP_INTERFACE = (6, 1, 1)
BUFFER_BYTES = 1 << 20
EVENT_BYTES = 64
MOST_UNDER_WAY = 1 << 27
"""A camera that cannot cancel sends its whole picture first."""
EMPTY_READS_TOLERATED = 8
STALE_CONTAINERS_TOLERATED = 8
STATUS_POLLS, STATUS_POLL_S = 20, 0.1

CANCEL_REQUEST, DEVICE_RESET, DEVICE_STATUS = 0x64, 0x66, 0x67
CANCELLATION = 0x4001
CLASS_OUT, CLASS_IN = 0x21, 0xA1
ENDPOINT_STATUS_IN, GET_STATUS = 0x82, 0

Sink = Callable[[memoryview], object]


class PtpUsb:
    """A claimed still-image interface.

    `timeout_s` bounds each transfer, not the exchange: one of 48 MB takes as long as it takes.
    """

    def __init__(
        self, device: UsbDevice, clock: Clock = SYSTEM_CLOCK, timeout_s: float = 5.0
    ) -> None:
        self.name = device.name
        self._device = device
        self._clock = clock
        self._timeout_s = timeout_s
        try:
            interface = device.claim(PTP_INTERFACE)
            self._interface = interface.number
            self._in = interface.pipe(BULK, inward=True)
            self._out = interface.pipe(BULK, inward=False)
            self._events = interface.pipe(INTERRUPT, inward=True)
        except BaseException:
            device.close()
            raise
        self._buffer = array.array("B", bytes(self._in.whole_packets(BUFFER_BYTES)))
        self._first = array.array("B", bytes(self._in.packet_size))
        self._event_buffer = array.array("B", bytes(self._events.whole_packets(EVENT_BYTES)))
        self._unread_events: deque[Message] = deque()

    def exchange(self, command: Message, data: bytes | None, sink: Sink, most: int) -> Message:
        """Send a command, with data or without, and return the response.

        Data that the camera sends goes to `sink` piece by piece, `most` bytes at most; the piece
        is only valid during the call. Raises `CameraFormatError` or an error of USB, after which
        `recover` must come first.
        """
        self._out.write(encode_message(command), self._timeout_s, end=True)
        if data is not None:
            container = encode_data(command.code, command.transaction, data)
            self._out.write(container, self._timeout_s, end=True)
        for _ in range(STALE_CONTAINERS_TOLERATED):
            header, start = self._read_start()
            ours = header.transaction == command.transaction
            if header.kind == Kind.DATA:
                self._read_payload(header, start, sink if ours else lambda piece: None, most)
            elif header.kind == Kind.RESPONSE:
                response = self._read_message(header, start)
                if ours:
                    return response
            else:
                raise CameraFormatError(start, "neither data nor a response")
            if not ours:
                _log.debug("%s: skipped what transaction %d left", self.name, header.transaction)
        raise CameraFormatError(start, f"transaction {command.transaction} is never answered")

    def event(self, timeout_s: float) -> Message | None:
        """Return the next event, None when none came in time; what is no event is skipped."""
        if not self._unread_events:
            try:
                count = self._events.read_into(self._event_buffer, timeout_s)
            except UsbTimeoutError:
                return None
            except UsbStalledError:
                self._events.clear_halt()
                return None
            self._take_events(self._event_buffer[:count].tobytes())
        return self._unread_events.popleft() if self._unread_events else None

    def recover(self, transaction: int) -> None:
        """Bring the pipes back to a clean start after an exchange that did not end.

        Cancels the transaction, waits until the camera is ready again, clears halts and throws
        away what was under way. Raises an error of USB, or `CameraBusyError`.
        """
        # A camera need not know how to cancel.
        with suppress(UsbStalledError, UsbTimeoutError):
            self._device.control(
                CLASS_OUT,
                CANCEL_REQUEST,
                index=self._interface,
                data=struct.pack("<HI", CANCELLATION, transaction),
            )
        self._flush()
        self._await_ready()
        self._flush()

    def reset(self) -> None:
        """Close whatever session the camera believes to be open."""
        with suppress(UsbStalledError, UsbTimeoutError):
            self._device.control(CLASS_OUT, DEVICE_RESET, index=self._interface)
        self.recover(0)

    def close(self) -> None:
        """Close the camera; closing twice is allowed."""
        self._device.close()

    def _flush(self) -> None:
        for pipe in (self._in, self._out):
            self._unhalt(pipe)
        self._in.drain(most=MOST_UNDER_WAY)

    def _await_ready(self) -> None:
        for _ in range(STATUS_POLLS):
            try:
                status = self._device.control(
                    CLASS_IN, DEVICE_STATUS, index=self._interface, data=EVENT_BYTES
                )
            except (UsbStalledError, UsbTimeoutError):
                return
            if len(status) < 4 or status[2:4] != struct.pack("<H", Code.BUSY):
                return
            self._clock.sleep(STATUS_POLL_S)
        raise CameraBusyError("for its status", STATUS_POLLS * STATUS_POLL_S)

    def _unhalt(self, pipe: UsbPipe) -> None:
        """Clear a halted endpoint; a needless CLEAR_FEATURE upsets cameras."""
        try:
            status = self._device.control(
                ENDPOINT_STATUS_IN, GET_STATUS, index=pipe.address, data=2
            )
        except (UsbStalledError, UsbTimeoutError):
            return
        if status[:1] == b"\x01":
            pipe.clear_halt()

    def _read_start(self) -> tuple[Header, bytes]:
        """Return the next container's header and first packet.

        Asking for one packet only means that no read can run on into the next container.
        """
        for _ in range(EMPTY_READS_TOLERATED):
            count = self._in.read_into(self._first, self._timeout_s)
            if count:
                start = self._first[:count].tobytes()
                return decode_header(start), start
        raise CameraFormatError(b"", "only empty packets")

    def _read_message(self, header: Header, start: bytes) -> Message:
        parts = [start]
        if header.length > self._in.packet_size:
            raise CameraFormatError(start, "a response longer than a packet")
        missing = header.length - len(start)
        if missing > 0:
            self._read_rest(missing, lambda piece: parts.append(bytes(piece)))
        return decode_message(b"".join(parts))

    def _read_payload(self, header: Header, start: bytes, sink: Sink, most: int) -> None:
        length = header.payload_length
        if length > most:
            raise CameraFormatError(start, f"{length} bytes of data where {most} are the most")
        had = len(start) - HEADER_SIZE
        if had > length:
            raise CameraFormatError(start, "more data than announced")
        if had:
            sink(memoryview(start)[HEADER_SIZE:])
        self._read_rest(length - had, sink)

    def _read_rest(self, length: int, sink: Sink) -> None:
        """Read exactly `length` bytes, in as many transfers as it takes.

        A short packet before the end means that some were lost: what follows is the response.
        """
        room = memoryview(self._buffer)
        empty = 0
        while length:
            wanted = min(self._in.whole_packets(length), len(self._buffer))
            whole = wanted == len(self._buffer)
            buffer = self._buffer if whole else array.array("B", bytes(wanted))
            count = self._in.read_into(buffer, self._timeout_s)
            if count > length:
                raise CameraFormatError(bytes(memoryview(buffer)[:24]), "more data than announced")
            if count:
                sink((room if whole else memoryview(buffer))[:count])
            empty = 0 if count else empty + 1
            if empty > EMPTY_READS_TOLERATED:
                raise CameraFormatError(b"", f"{length} bytes of data are missing")
            length -= count
            if length and count % self._in.packet_size:
                raise CameraFormatError(b"", f"{length} bytes of data are missing")

    def _take_events(self, data: bytes) -> None:
        while data:
            try:
                length = decode_header(data).length
                message = decode_message(data[:length])
            except CameraFormatError as error:
                _log.debug("%s: %s", self.name, error)
                return
            data = data[length:]
            if message.kind == Kind.EVENT:
                self._unread_events.append(message)

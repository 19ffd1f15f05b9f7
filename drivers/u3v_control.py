"""Control channel of a USB3 Vision camera: its memory, read and written in bounded time.

Commands go out one by one, each with a request id; only reads are repeated when an answer is lost,
since a write may have taken effect. Source: GenCP 1.1; USB3 Vision 1.0, control interface.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from functools import partial
from itertools import cycle

from emmc_rig.drivers import u3v_codec as codec
from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import (
    CameraBusyError,
    CameraFormatError,
    CameraRefusedError,
    UsbStalledError,
    UsbTimeoutError,
)
from emmc_rig.drivers.transport import FOREIGN_MESSAGES_TOLERATED, repeated
from emmc_rig.drivers.usb import UsbPipe

BUSY_LIMIT_S = 30.0
"""Longest that a camera may ask for by pending acknowledges, for one command."""
PENDING_TOLERATED = 4096
FIRST_TIMEOUT_S = 1.0
TIMEOUTS_S = (0.5, 10.0)
"""Bounds on the response time that the camera states."""
DATA_SIZES = (8, 1 << 15)
"""Bounds on the data of one command, whatever lengths the camera states."""

_MENDABLE = (UsbTimeoutError, UsbStalledError, CameraFormatError)


class U3vControl:
    """A `drivers.genapi.Port` over the two bulk pipes of the control interface."""

    def __init__(self, name: str, command: UsbPipe, answer: UsbPipe, clock: Clock) -> None:
        self.name = name
        self._command = command
        self._answer = answer
        self._clock = clock
        self._lock = threading.RLock()
        self._request_ids = cycle(codec.REQUEST_IDS)
        self._timeout_s = FIRST_TIMEOUT_S
        self._read_size = self._write_size = codec.TEXT_SIZE

    def learn_sizes(self, sbrm: int) -> None:
        """Take time limit and greatest lengths from the camera's registers."""
        response_s = self.integer(codec.ABRM_RESPONSE_TIME_MS, 4) / 1000
        command = self.integer(sbrm + codec.SBRM_COMMAND_SIZE, 4) - codec.WRITE_OVERHEAD
        answer = self.integer(sbrm + codec.SBRM_ACKNOWLEDGE_SIZE, 4) - codec.HEADER_SIZE
        self._timeout_s = _bounded(2 * response_s, *TIMEOUTS_S)
        self._write_size = int(_bounded(command, *DATA_SIZES))
        self._read_size = int(_bounded(answer, *DATA_SIZES))

    def integer(self, address: int, length: int) -> int:
        """Return a register; those of the standard are little endian."""
        return int.from_bytes(self.read(address, length), "little")

    def text(self, address: int) -> str:
        """Return a text register of the standard's."""
        return codec.text(self.read(address, codec.TEXT_SIZE))

    def read(self, address: int, length: int) -> bytes:
        """Return `length` bytes; raises a `DriverError`."""
        most = self._read_size
        begins = range(0, length, most)
        return b"".join(self._read(address + at, min(most, length - at)) for at in begins)

    def write(self, address: int, data: bytes) -> None:
        """Store `data`; raises a `DriverError`, after which the memory may have changed or not."""
        for at in range(0, len(data), self._write_size):
            part = data[at : at + self._write_size]
            what = f"to write {part[:8].hex()} at {address + at:#x}"
            encode = partial(codec.encode_write, address=address + at, data=part)
            answer = self._exchange(what, codec.WRITEMEM_ACK, encode, 4)
            # Old cameras leave the count out.
            if len(answer) >= 4 and struct.unpack_from("<HH", answer)[1] not in (0, len(part)):
                raise CameraFormatError(answer, f"not all {len(part)} bytes were written")

    def _read(self, address: int, length: int) -> bytes:
        what = f"to read {length} bytes at {address:#x}"

        def ask() -> bytes:
            encode = partial(codec.encode_read, address=address, length=length)
            data = self._exchange(what, codec.READMEM_ACK, encode, length)
            if len(data) != length:
                raise CameraFormatError(data, f"{len(data)} bytes instead of {length}")
            return data

        return repeated(ask, f"{self.name} {what}", faults=_MENDABLE)

    def _exchange(
        self, what: str, expected: int, encode: Callable[[int], bytes], data_size: int
    ) -> bytes:
        with self._lock:
            request_id = next(self._request_ids)
            try:
                self._command.write(encode(request_id), self._timeout_s)
                raw, message = self._await(what, request_id, data_size)
            except _MENDABLE as error:
                # The pipes are made usable again, and emptied.
                if isinstance(error, UsbStalledError):
                    self._command.clear_halt()
                    self._answer.clear_halt()
                self._answer.drain()
                raise
        if message.status:
            meaning, advice = codec.STATUS.get(message.status, codec.UNKNOWN_STATUS)
            raise CameraRefusedError(what, f"{meaning} ({message.status:#06x})", advice)
        if message.command != expected:
            raise CameraFormatError(raw, f"{message.command:#06x} answers something else")
        return message.data

    def _await(self, what: str, request_id: int, data_size: int) -> tuple[bytes, codec.Acknowledge]:
        """Return the answer to a request; late answers to others are passed over."""
        started_s = self._clock.now_s()
        deadline_s = started_s + self._timeout_s
        foreign = pending = 0
        while foreign < FOREIGN_MESSAGES_TOLERATED and pending < PENDING_TOLERATED:
            now_s = self._clock.now_s()
            if now_s >= deadline_s:
                raise UsbTimeoutError(self.name, deadline_s - started_s)
            raw = self._answer.read(codec.HEADER_SIZE + data_size, deadline_s - now_s)
            message = codec.decode_acknowledge(raw) if raw else None
            if message is None or message.request_id != request_id:
                foreign += 1
                continue
            if message.command != codec.PENDING_ACK:
                return raw, message
            pending += 1
            now_s = self._clock.now_s()
            if now_s - started_s >= BUSY_LIMIT_S:
                raise CameraBusyError(what, now_s - started_s)
            deadline_s = now_s + self._timeout_s + min(message.pending_s, BUSY_LIMIT_S)
        if pending:
            raise CameraBusyError(what, self._clock.now_s() - started_s)
        raise CameraFormatError(b"", f"no answer to request {request_id} among {foreign} messages")


def _bounded(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)

"""Byte streams to serial devices: one object owns one port, and the lock on its exchanges."""

import errno
import threading
import time
from contextlib import AbstractContextManager
from typing import Any, Protocol

import serial

from drivers.errors import (
    PortBusyError,
    PortGoneError,
    PortNotFoundError,
    TransportTimeoutError,
)

try:
    from termios import error as _TermiosError  # noqa: N812
except ImportError:  # Windows
    _TermiosError = OSError

_PORT_FAILURES = (serial.SerialException, OSError, _TermiosError)
"""What pyserial lets through when the port breaks; the terminal's own error is no OSError."""


class Transport(Protocol):
    """What a serial driver needs of a port, real or simulated."""

    @property
    def lock(self) -> AbstractContextManager[Any]:
        """Held by a driver from the first byte of a command to the last of its answer."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`; raises `PortGoneError` or `TransportTimeoutError`."""
        ...

    def read_until(self, terminator: bytes) -> bytes:
        """Return bytes up to and including `terminator`; raises as `write` does."""
        ...

    def discard_input(self) -> None:
        """Forget what has arrived and was not read; raises `PortGoneError`."""
        ...

    def close(self) -> None:
        """Let go of the port; closing twice is allowed."""
        ...


class SerialTransport:
    """A serial port by pyserial, 8 data bits, no parity, 1 stop bit.

    `timeout_s` bounds a read, `write_timeout_s` a write (pyserial waits for ever by default).
    The port is opened for this process alone. Raises `PortNotFoundError` or `PortBusyError`.
    """

    def __init__(
        self,
        port: str,
        baud: int = 115200,
        timeout_s: float = 0.5,
        write_timeout_s: float = 1.0,
    ) -> None:
        self.port = port
        self.timeout_s = timeout_s
        self.write_timeout_s = write_timeout_s
        self._lock = threading.RLock()
        self._unread = bytearray()
        try:
            self._serial = serial.Serial(
                port, baud, timeout=timeout_s, write_timeout=write_timeout_s, exclusive=True
            )
        except serial.SerialException as error:
            if error.errno == errno.ENOENT or "FileNotFoundError" in str(error):
                raise PortNotFoundError(port) from error
            raise PortBusyError(port, str(error)) from error

    @property
    def lock(self) -> AbstractContextManager[Any]:
        """Held by a driver from the first byte of a command to the last of its answer."""
        return self._lock

    def write(self, data: bytes) -> None:
        """Send all of `data`; raises `PortGoneError` or `TransportTimeoutError`."""
        with self._lock:
            try:
                self._serial.write(data)
            except serial.SerialTimeoutException as error:
                raise TransportTimeoutError(self.port, self.write_timeout_s) from error
            except _PORT_FAILURES as error:
                raise PortGoneError(self.port) from error

    def read_until(self, terminator: bytes) -> bytes:
        """Return bytes up to and including `terminator`; raises as `write` does.

        What arrived of an incomplete answer is kept for the next read.
        """
        with self._lock:
            deadline_s = time.monotonic() + self.timeout_s
            while (end := self._unread.find(terminator)) < 0:
                if time.monotonic() > deadline_s:
                    raise TransportTimeoutError(self.port, self.timeout_s, bytes(self._unread))
                try:
                    self._unread += self._serial.read(max(1, self._serial.in_waiting))
                except _PORT_FAILURES as error:
                    raise PortGoneError(self.port) from error
            end += len(terminator)
            message = bytes(self._unread[:end])
            del self._unread[:end]
            return message

    def discard_input(self) -> None:
        """Forget what has arrived and was not read; raises `PortGoneError`."""
        with self._lock:
            self._unread.clear()
            try:
                self._serial.reset_input_buffer()
            except _PORT_FAILURES as error:
                raise PortGoneError(self.port) from error

    def close(self) -> None:
        """Let go of the port; closing twice is allowed."""
        with self._lock:
            self._serial.close()

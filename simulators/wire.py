"""Wires to simulated firmware: one in memory, one a pseudo-terminal that pyserial can open."""

import os
import select
import threading
from contextlib import AbstractContextManager
from typing import Any, Protocol

from drivers.clock import Clock
from drivers.errors import PortGoneError, TransportTimeoutError

READ_SIZE = 4096


class Firmware(Protocol):
    """A simulated device on the end of a wire."""

    @property
    def unplugged(self) -> bool:
        """Whether the wire has been pulled."""
        ...

    def feed(self, data: bytes) -> bytes:
        """Take bytes from the host and return the bytes that answer them, if any."""
        ...


class MemoryTransport:
    """A `drivers.transport.Transport` that ends in firmware; timing out costs simulated time."""

    port = "simulator"

    def __init__(self, firmware: Firmware, clock: Clock, timeout_s: float = 0.5) -> None:
        self._firmware = firmware
        self._clock = clock
        self._timeout_s = timeout_s
        self._lock = threading.RLock()
        self._unread = bytearray()
        self._closed = False

    @property
    def lock(self) -> AbstractContextManager[Any]:
        """Held by a driver from the first byte of a command to the last of its answer."""
        return self._lock

    def write(self, data: bytes) -> None:
        """Send all of `data`; raises `PortGoneError`."""
        with self._lock:
            self._require_open()
            self._unread += self._firmware.feed(data)

    def read_until(self, terminator: bytes) -> bytes:
        """Return bytes up to and including `terminator`; or raise `TransportTimeoutError`."""
        with self._lock:
            self._require_open()
            end = self._unread.find(terminator)
            if end < 0:
                self._clock.sleep(self._timeout_s)
                raise TransportTimeoutError(self.port, self._timeout_s, bytes(self._unread))
            end += len(terminator)
            message = bytes(self._unread[:end])
            del self._unread[:end]
            return message

    def discard_input(self) -> None:
        """Forget what has arrived and was not read; raises `PortGoneError`."""
        with self._lock:
            self._require_open()
            self._unread.clear()

    def close(self) -> None:
        """Let go of the wire; closing twice is allowed."""
        self._closed = True

    def _require_open(self) -> None:
        if self._closed or self._firmware.unplugged:
            raise PortGoneError(self.port)


class PtyServer:
    """Serves firmware on a pseudo-terminal, in a thread, while its `with` block lasts.

    `port` is the name to open. Pulling the plug (`firmware.unplugged`) closes it under the
    reader's feet. POSIX only.
    """

    def __init__(self, firmware: Firmware) -> None:
        self._firmware = firmware
        self.port = ""

    def __enter__(self) -> "PtyServer":
        # Windows has no pseudo-terminals; the wire in memory must import there too.
        import tty

        self._device, self._line = os.openpty()
        tty.setraw(self._line)
        self.port = os.ttyname(self._line)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name=f"pty {self.port}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        os.write(self._wake_write, b"x")
        self._thread.join()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _serve(self) -> None:
        try:
            while not self._firmware.unplugged:
                ready, _, _ = select.select([self._device, self._wake_read], [], [])
                if self._wake_read in ready:
                    return
                answer = self._firmware.feed(os.read(self._device, READ_SIZE))
                while answer:
                    answer = answer[os.write(self._device, answer) :]
        finally:
            os.close(self._device)
            os.close(self._line)

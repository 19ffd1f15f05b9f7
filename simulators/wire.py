"""Wires to simulated firmware: in memory, on a pseudo-terminal that pyserial can open."""

import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Protocol, Self

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import (
    PortError,
    PortGoneError,
    PortNotFoundError,
    TransportTimeoutError,
)
from emmc_rig.drivers.transport import Transport

READ_SIZE = 4096
TICK_S = 0.002
"""How often a server looks for what fell due by itself."""


class Firmware(Protocol):
    """A simulated device on the end of a wire.

    unplugged: whether the wire has been pulled. plugs: count of how often the wire was plugged in.
    """

    unplugged: bool
    plugs: int

    def feed(self, data: bytes) -> bytes:
        """Take bytes from the host; return those that fell due for the host by now."""
        ...

    def due(self) -> bytes:
        """Return the bytes that fell due for the host by now."""
        ...

    def next_due_s(self) -> float | None:
        """Return when something may next fall due, if anything will."""


class MemoryTransport(Transport):
    """A wire that ends in firmware; waiting costs simulated time."""

    def __init__(self, firmware: Firmware, clock: Clock, timeout_s: float = 0.5) -> None:
        super().__init__("simulator", timeout_s)
        self._firmware = firmware
        self._clock = clock
        self._plugs = firmware.plugs
        self._closed = False

    def write(self, data: bytes) -> None:
        """Send all of `data`; raises `PortGoneError`."""
        with self.lock:
            self._require_open()
            self._unread += self._firmware.feed(data)

    def waiting(self) -> int:
        """Return how many bytes can be read at once; raises `PortGoneError`."""
        with self.lock:
            self._require_open()
            self._unread += self._firmware.due()
            return len(self._unread)

    def discard_input(self) -> None:
        """Forget what has arrived and was not read; raises `PortGoneError`."""
        with self.lock:
            self._require_open()
            self._firmware.due()
            self._unread.clear()

    def reopen(self) -> None:
        """Open the wire again; raises `PortNotFoundError` while it is pulled."""
        with self.lock:
            if self._firmware.unplugged:
                raise PortNotFoundError(self.port)
            self._unread.clear()
            self._plugs = self._firmware.plugs
            self._closed = False

    def close(self) -> None:
        """Let go of the wire; closing twice is allowed."""
        self._closed = True

    def _now_s(self) -> float:
        return self._clock.now_s()

    def _receive(self, deadline_s: float) -> None:
        arrived = self._firmware.due()
        self._unread += arrived
        self._require_open()
        if arrived:
            return
        now_s = self._clock.now_s()
        next_s = self._firmware.next_due_s()
        if next_s is None or not now_s < next_s < deadline_s:
            self._clock.sleep(max(deadline_s - now_s, 0.0))
            arrived = self._firmware.due()
            self._unread += arrived
            if not arrived:
                raise TransportTimeoutError(self.port, self.timeout_s, bytes(self._unread))
        else:
            self._clock.sleep(next_s - now_s)

    def _require_open(self) -> None:
        if self._closed or self._firmware.unplugged or self._firmware.plugs != self._plugs:
            raise PortGoneError(self.port)


class PtyServer:
    """Serves firmware on a pseudo-terminal, in a thread, while its `with` block lasts.

    `port` is the name to open, while `is_open`. Pulling the plug closes the port under the
    reader's feet; plugging in again opens a new port, possibly with another name, like a USB port.
    `link` is a path that always leads to the open port, as /dev/serial/by-id does; it must be free,
    or an earlier link. POSIX only.
    """

    def __init__(self, firmware: Firmware, link: Path | None = None) -> None:
        self.port = ""
        self._firmware, self._link = firmware, link
        self._wake_read, self._wake_write = os.pipe()
        self._device = self._line = -1
        self.is_open = False

    def __enter__(self) -> Self:
        self._open()
        self.is_open = True
        self._thread = threading.Thread(target=self._serve, name=f"serve {self.port}", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        os.write(self._wake_write, b"x")
        self._thread.join()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _serve(self) -> None:
        try:
            while True:
                self._follow_plug()
                sources = self._sources() if self.is_open else []
                ready, _, _ = select.select([*sources, self._wake_read], [], [], TICK_S)
                if self._wake_read in ready:
                    return
                answer = b""
                for source in ready:
                    data = self._read(source)
                    if data:
                        answer += self._firmware.feed(data)
                self._follow_plug()
                answer += self._firmware.due()
                if self.is_open and answer:
                    self._write(answer)
        finally:
            if self.is_open:
                self._close()

    def _send(self, channel: Any, send: Callable[[bytes], int], data: bytes) -> None:
        """Send bytes as the host takes them; a host that takes none delays no unplug and no end."""
        while data and not self._firmware.unplugged:
            ready, free, _ = select.select([self._wake_read], [channel], [], TICK_S)
            if ready:
                return
            if free:
                with suppress(BlockingIOError):
                    data = data[send(data) :]

    def _follow_plug(self) -> None:
        plugged = not self._firmware.unplugged
        if self.is_open and not plugged:
            self.is_open = False
            self._close()
        elif plugged and not self.is_open:
            self._open()
            self.is_open = True

    def _open(self) -> None:
        if sys.platform == "win32":
            raise PortError(
                "by a pseudo-terminal",
                "exists on Linux and macOS alone",
                "simulate the device in a rig's file",
            )
        import tty

        self._device, self._line = os.openpty()
        tty.setraw(self._line)
        os.set_blocking(self._device, False)
        self.port = os.ttyname(self._line)
        if self._link is not None:
            if self._link.is_symlink() and self._link.readlink().parent == Path(self.port).parent:
                self._link.unlink()
            self._link.symlink_to(self.port)

    def _close(self) -> None:
        if self._link is not None:
            with suppress(OSError):
                if self._link.readlink() == Path(self.port):
                    self._link.unlink()
        os.close(self._device)
        os.close(self._line)

    def _sources(self) -> list[Any]:
        return [self._device]

    def _read(self, source: Any) -> bytes:
        return os.read(self._device, READ_SIZE)

    def _write(self, data: bytes) -> None:
        self._send(self._device, partial(os.write, self._device), data)

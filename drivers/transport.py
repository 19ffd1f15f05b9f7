"""Byte streams to serial devices: an object per port, with the lock on its exchanges."""

import errno
import logging
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import TypeVar

import serial

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import (
    DriverError,
    GarbledReplyError,
    PortBusyError,
    PortError,
    PortGoneError,
    PortNotFoundError,
    PortPermissionError,
    TransportTimeoutError,
)
from emmc_rig.drivers.ports import (
    BY_SERIAL_NUMBER,
    find_port,
    holder_of,
    usb_serial_number,
)

_PORT_FAILURES: tuple[type[Exception], ...] = (serial.SerialException, OSError)
"""What pyserial lets through when the port breaks."""
if sys.platform != "win32":
    import termios

    _PORT_FAILURES += (termios.error,)  # it is no OSError
_FORBIDDEN = (errno.EACCES, errno.EPERM)
_ABSENT = (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ECONNREFUSED, errno.EHOSTUNREACH)
IN_USE = b"Port already in use"
"""What ser2net, and the simulators' TCP server, say to a second client before they hang up."""
NETWORK_HOLDER = "another program over the network"
QUIET_LIMIT = 20
"""Reads of `discard_until_quiet` before a device counts as one that never falls silent."""
RTS_PAUSE_S = 0.05
BAUD = 115200
"""Of every stage controller with a driver here."""
QUERY_ATTEMPTS = 3
FOREIGN_MESSAGES_TOLERATED = 64
EXCHANGE_LIMIT_S = 2.0
"""Longest wait for one answer among messages that are none."""

_Answer = TypeVar("_Answer")
_log = logging.getLogger(__name__)


def turns(clock: Clock, most: int = FOREIGN_MESSAGES_TOLERATED) -> Iterator[None]:
    """Yield before each message of an exchange, until they are too many or take too long."""
    started_s = clock.now_s()
    for _ in range(most):
        yield
        if clock.now_s() - started_s > EXCHANGE_LIMIT_S:
            return


def repeated(
    ask: Callable[[], _Answer],
    what: str,
    recover: Callable[[], None] = lambda: None,
    faults: tuple[type[DriverError], ...] = (TransportTimeoutError, GarbledReplyError),
    attempts: int = QUERY_ATTEMPTS,
) -> _Answer:
    """Return the answer to what may be asked again without harm, after a few attempts if need be.

    recover: called between them. Raises the fault of the last.
    """
    for attempt in range(1, attempts):
        try:
            return ask()
        except faults as fault:
            _log.warning("attempt %d of %s failed: %s", attempt, what, fault)
            recover()
    return ask()


class Transport(ABC):
    """What a serial driver needs of a port, real or simulated; what is read in pieces is kept.

    `port`: its name, for messages. `lock`: held by a driver from the first byte of a command to
    the last of its answer.
    """

    def __init__(self, port: str, timeout_s: float) -> None:
        self.port = port
        self.timeout_s = timeout_s
        self.lock = threading.RLock()
        self._unread: bytearray = bytearray()

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Send all of `data`; raises `PortGoneError` or `TransportTimeoutError`."""

    @abstractmethod
    def waiting(self) -> int:
        """Return how many bytes can be read at once; raises `PortGoneError`."""

    @abstractmethod
    def discard_input(self) -> None:
        """Forget what has arrived and was not read; raises `PortGoneError`."""

    @abstractmethod
    def reopen(self) -> None:
        """Open the port again, wherever it is now; raises as opening it does."""

    @abstractmethod
    def close(self) -> None:
        """Close the port; closing twice is allowed."""

    @abstractmethod
    def _now_s(self) -> float:
        """Return the time in which a read must end."""

    @abstractmethod
    def _receive(self, deadline_s: float) -> None:
        """Keep what has arrived, or wait for a byte; raises when the deadline has passed."""

    def read_until(self, terminator: bytes) -> bytes:
        """Return bytes up to and including `terminator`; raises as `write` does.

        What arrived of an incomplete answer is kept for the next read.
        """
        with self.lock:
            deadline_s = self._now_s() + self.timeout_s
            while (end := self._unread.find(terminator)) < 0:
                self._receive(deadline_s)
            return self._take(end + len(terminator))

    def read_exactly(self, count: int) -> bytes:
        """Return the next `count` bytes; raises as `read_until` does."""
        with self.lock:
            deadline_s = self._now_s() + self.timeout_s
            while len(self._unread) < count:
                self._receive(deadline_s)
            return self._take(count)

    def discard_until_quiet(self) -> None:
        """Forget what arrives until nothing does; raises `PortGoneError`, `GarbledReplyError`."""
        with self.lock:
            for _ in range(QUIET_LIMIT):
                self.discard_input()
                try:
                    last = self.read_exactly(1)
                except TransportTimeoutError:
                    return
            raise GarbledReplyError(last, f"{self.port} never falls silent")

    def _take(self, count: int) -> bytes:
        message = bytes(self._unread[:count])
        del self._unread[:count]
        return message


class SerialTransport(Transport):
    """A serial port by pyserial, 8 data bits, no parity, 1 stop bit.

    `port` is named as `drivers.ports` says. `timeout_s` bounds a read, `write_timeout_s` a write
    (pyserial waits for ever by default). `flow_control` is RTS/CTS, which APT controllers want.
    `baud`: bits per second.
    The port is opened for this process alone. Raises `PortNotFoundError`, `PortBusyError` or
    `PortPermissionError`.
    """

    def __init__(
        self,
        port: str,
        timeout_s: float = 0.5,
        write_timeout_s: float = 1.0,
        flow_control: bool = False,
        baud: int = BAUD,
    ) -> None:
        super().__init__(port, timeout_s)
        self.write_timeout_s = write_timeout_s
        self._flow_control, self._baud = flow_control, baud
        self._heard = False
        device = find_port(port)
        self._serial = self._open(device)
        self._serial_number = "" if "://" in device else usb_serial_number(device)

    def write(self, data: bytes) -> None:
        """Send all of `data`; raises `PortGoneError` or `TransportTimeoutError`."""
        with self.lock:
            self._require_open()
            try:
                self._serial.write(data)
            except serial.SerialTimeoutException as error:
                raise TransportTimeoutError(self.port, self.write_timeout_s) from error
            except _PORT_FAILURES as error:
                raise self._gone() from error

    def waiting(self) -> int:
        """Return how many bytes can be read at once; raises `PortGoneError`."""
        with self.lock:
            self._require_open()
            try:
                arrived = self._serial.in_waiting
                if arrived:
                    self._unread += self._serial.read(arrived)
            except _PORT_FAILURES as error:
                raise PortGoneError(self.port) from error
            return len(self._unread)

    def discard_input(self) -> None:
        """Forget what has arrived and was not read; raises `PortGoneError`."""
        with self.lock:
            self._unread.clear()
            self._require_open()
            try:
                self._serial.reset_input_buffer()
            except _PORT_FAILURES as error:
                raise PortGoneError(self.port) from error

    def reopen(self) -> None:
        """Open the port again, wherever it is now; raises as the constructor does.

        A port opened by its name is searched by the serial number of its USB adapter, if known:
        after an unplug the port may have another name.
        """
        with self.lock:
            self.close()
            self._unread.clear()
            number = self._serial_number
            self._serial = self._open(find_port(BY_SERIAL_NUMBER + number if number else self.port))

    def close(self) -> None:
        """Close the port; closing twice is allowed."""
        with self.lock:
            # pyserial forgets to close a socket that the other side has closed already.
            opened = getattr(self._serial, "_socket", None)
            self._serial.close()
            if opened is not None:
                opened.close()

    def _open(self, device: str) -> serial.Serial:
        try:
            opened = serial.serial_for_url(
                device,
                baudrate=self._baud,
                timeout=self.timeout_s,
                write_timeout=self.write_timeout_s,
                rtscts=self._flow_control,
                exclusive=True,
            )
        except (serial.SerialException, OSError) as error:
            raise _port_error(self.port, device, error) from error
        except ValueError as error:
            raise PortNotFoundError(self.port, f"is no port ({error})") from error
        if self._flow_control:
            _cycle_rts(opened)
        return opened

    def _now_s(self) -> float:
        return time.monotonic()

    def _receive(self, deadline_s: float) -> None:
        self._require_open()
        if time.monotonic() > deadline_s:
            raise TransportTimeoutError(self.port, self.timeout_s, bytes(self._unread))
        try:
            self._unread += self._serial.read(max(1, self._serial.in_waiting))
        except _PORT_FAILURES as error:
            raise self._gone() from error
        if not self._heard and "://" in self.port and IN_USE in self._unread:
            raise PortBusyError(self.port, IN_USE.decode(), NETWORK_HOLDER)
        self._heard |= not IN_USE.startswith(self._unread[: len(IN_USE)])

    def _gone(self) -> PortError:
        """Return why the port failed; a network port that never answered is in use."""
        if "://" in self.port and not self._heard:
            return PortBusyError(self.port, "it hung up at once", NETWORK_HOLDER)
        return PortGoneError(self.port)

    def _require_open(self) -> None:
        """Raise `PortGoneError` for a port that was closed; pyserial would trip over itself."""
        if not self._serial.is_open:
            raise PortGoneError(self.port)


def _port_error(wanted: str, device: str, error: Exception) -> DriverError:
    """Return the error that says why a port did not open."""
    code = getattr(error, "errno", None)
    text = str(error)
    if code in _FORBIDDEN:
        return PortPermissionError(wanted)
    if code in _ABSENT or "FileNotFoundError" in text:
        return PortNotFoundError(wanted)
    if "://" in device:
        return PortNotFoundError(wanted, f"cannot be reached ({text})")
    return PortBusyError(wanted, text, holder_of(device))


def _cycle_rts(opened: serial.Serial) -> None:
    """Drop and raise RTS, which wakes an FTDI adapter that was left in the middle of a message.

    A pseudo-terminal has no such line and says so.
    """
    try:
        opened.rts = False
        time.sleep(RTS_PAUSE_S)
        opened.reset_input_buffer()
        opened.reset_output_buffer()
        time.sleep(RTS_PAUSE_S)
        opened.rts = True
    except OSError as error:
        if error.errno not in (errno.ENOTTY, errno.EINVAL):
            raise PortGoneError(str(opened.port)) from error

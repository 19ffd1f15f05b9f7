"""USB transport: find, open and claim a device, and move bytes through its pipes in bounded time.

Everything goes through pyusb, so that a simulated bus is just another `backend`. Every fault that
pyusb raises comes out as a `DriverError`. Sources: USB 2.0 specification, 5.8 (bulk transfers end
with a short or a zero-length packet) and 9.6 (descriptors); pyusb, `usb.backend.libusb1`.
"""

from __future__ import annotations

import array
import errno
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import libusb_package
import usb.core
import usb.util

from emmc_rig.drivers.errors import (
    DriverError,
    UsbClaimedError,
    UsbGoneError,
    UsbNotFoundError,
    UsbPermissionError,
    UsbStalledError,
    UsbTimeoutError,
    UsbTransferError,
    UsbUnavailableError,
)
from emmc_rig.drivers.ports import PROC, pids_with_open_file

Kind = tuple[int, int, int]
"""Class, subclass and protocol of an interface."""

TRANSFER_BYTES = 1 << 22
"""Largest single transfer: the kernel's default memory for USB is 16 MiB for all devices."""

SILENCE_S = 0.05

BULK, INTERRUPT = usb.util.ENDPOINT_TYPE_BULK, usb.util.ENDPOINT_TYPE_INTR

_DESKTOP_ADVICE = (
    "eject the camera in the file manager, or run "
    "`systemctl --user stop gvfs-gphoto2-volume-monitor; pkill gvfsd-gphoto2`, then try again"
)
HOLDER_ADVICE = {
    "gvfs": _DESKTOP_ADVICE,
    "kiod": "eject the camera in the file manager, then try again",
    "gphoto2": "end gphoto2, then try again",
    "darktable": "end its tethering or close it, then try again",
}
"""By the beginning of a program's name: how to make it let go."""
CLOSE_IT = "close that program, then try again"
UNKNOWN_HOLDER = (
    "close the program that uses it (often the desktop's file manager: " + _DESKTOP_ADVICE + ")"
)


@dataclass(frozen=True)
class UsbListing:
    """A device that is plugged in; texts are empty where it could not be opened or has none."""

    vendor: int
    product: int
    bus: int
    address: int
    maker: str
    model: str
    serial: str
    accessible: bool

    @property
    def name(self) -> str:
        """How messages call it."""
        ids = f"{self.vendor:04x}:{self.product:04x}"
        return f"{self.model or 'device'} {ids} (bus {self.bus}, address {self.address})"


def list_devices(kind: Kind | None = None, backend: Any = None) -> list[UsbListing]:
    """Return the devices that have an interface of that kind; raises `UsbUnavailableError`."""
    return [_listing(device) for device in _find(kind, backend)]


def open_device(
    kind: Kind | None = None,
    *,
    serial: str = "",
    backend: Any = None,
    proc: Path = PROC,
    wanted: str = "device",
) -> UsbDevice:
    """Open the first device that matches; `wanted` is what the error calls it.

    A device that matches but for a serial number that may not be read raises
    `UsbPermissionError`; other errors: `UsbUnavailableError`, `UsbNotFoundError`.
    """
    others, refused = [], None
    for device in _find(kind, backend):
        listing = _listing(device)
        if not listing.accessible:
            refused = listing
        elif serial in ("", listing.serial):
            return UsbDevice(device, listing, proc)
        else:
            others.append(f"{listing.name} with serial {listing.serial or 'unknown'}")
    if refused is not None:
        raise UsbPermissionError(refused.name)
    raise UsbNotFoundError(f"{wanted} with serial {serial}" if serial else wanted, tuple(others))


class UsbDevice:
    """An open device, whose interfaces are claimed separately.

    Closing the device, as the end of a `with` block does, frees it for other programs.
    """

    def __init__(self, device: Any, listing: UsbListing, proc: Path = PROC) -> None:
        self.listing = listing
        self.name = listing.name
        self._device = device
        self._proc = proc
        self._closed = False
        self._detached: list[int] = []

    def __enter__(self) -> UsbDevice:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def claim(self, kind: Kind) -> UsbInterface:
        """Claim the interface of that kind, taking it from a driver of the kernel if need be.

        Raises `UsbNotFoundError` where the device has none, `UsbClaimedError`,
        `UsbPermissionError` or `UsbGoneError`.
        """
        self._require_open()
        with self._faults():
            found = next(
                (i for i in self._device.get_active_configuration() if _kind(i) == kind), None
            )
        if found is None:
            shown = "/".join(f"{part:02x}" for part in kind)
            raise UsbNotFoundError(f"interface of class {shown} on {self.name}")
        number = found.bInterfaceNumber
        with self._faults():
            # Not every system can query or detach; the claim below then decides.
            with suppress(NotImplementedError):
                if self._device.is_kernel_driver_active(number):
                    self._device.detach_kernel_driver(number)
                    self._detached.append(number)
            usb.util.claim_interface(self._device, number)
        pipes = [UsbPipe(self, endpoint) for endpoint in found]
        return UsbInterface(self, number, tuple(pipes))

    def control(
        self,
        request_type: int,
        request: int,
        value: int = 0,
        index: int = 0,
        data: bytes | int = b"",
        timeout_s: float = 1.0,
    ) -> bytes:
        """Make a control transfer: `data` is what to send, or how many bytes to ask for."""
        self._require_open()
        payload = data if isinstance(data, int) else array.array("B", data)
        with self._faults(timeout_s=timeout_s):
            answer = self._device.ctrl_transfer(
                request_type, request, value, index, payload, _milliseconds(timeout_s)
            )
        return answer.tobytes() if isinstance(answer, array.array) else b""

    def close(self) -> None:
        """Close the device, unplugged or not; closing twice is allowed."""
        if self._closed:
            return
        self._closed = True
        # Nothing to repair: the device is gone, so that its requests fail.
        for number in self._detached:
            with suppress(usb.core.USBError, NotImplementedError):
                usb.util.release_interface(self._device, number)
                self._device.attach_kernel_driver(number)
        with suppress(usb.core.USBError, NotImplementedError):
            usb.util.dispose_resources(self._device)

    def _require_open(self) -> None:
        if self._closed:
            raise UsbGoneError(self.name)

    @contextmanager
    def _faults(self, endpoint: int = 0, timeout_s: float = 0.0) -> Iterator[None]:
        try:
            yield
        except usb.core.USBTimeoutError as fault:
            raise UsbTimeoutError(self.name, timeout_s) from fault
        except (usb.core.USBError, NotImplementedError) as fault:
            raise self._error(fault, endpoint) from fault

    def _error(self, fault: Exception, endpoint: int) -> DriverError:
        code = getattr(fault, "errno", None)
        reason = str(getattr(fault, "strerror", None) or fault or type(fault).__name__)
        if code == errno.ETIMEDOUT:
            return UsbTimeoutError(self.name, 0.0)
        if code in (errno.EACCES, errno.EPERM):
            return UsbPermissionError(self.name)
        if code in (errno.ENODEV, errno.ENOENT, errno.ESHUTDOWN):
            return UsbGoneError(self.name)
        if code == errno.EPIPE:
            return UsbStalledError(self.name, endpoint)
        if code == errno.EBUSY:
            holders = find_holders(self.listing.bus, self.listing.address, self._proc)
            return UsbClaimedError(self.name, holders, _holder_advice(holders))
        return UsbTransferError(self.name, reason, ADVICE.get(code, CHECK_CABLE))


CHECK_CABLE = "check the cable, avoid hubs, then open the device again"
ADVICE: dict[int | None, str] = {
    errno.ENOMEM: "raise the kernel's memory for USB, for instance "
    "`echo 256 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb`",
    errno.EOVERFLOW: "the device sent more than was asked for; open the device again",
    errno.ENOSYS: "this system's driver for the device cannot do it; on Windows install WinUSB "
    "for it with Zadig",
}


@dataclass(frozen=True)
class UsbInterface:
    """A claimed interface and its pipes."""

    device: UsbDevice
    number: int
    pipes: tuple[UsbPipe, ...]

    def pipe(self, transfer: int, inward: bool) -> UsbPipe:
        """Return the first pipe of that transfer type (`BULK` or `INTERRUPT`) and direction.

        Raises `UsbNotFoundError` where the interface has none.
        """
        for pipe in self.pipes:
            if (pipe.transfer, pipe.inward) == (transfer, inward):
                return pipe
        name = f"{'bulk' if transfer == BULK else 'interrupt'} {'in' if inward else 'out'}"
        raise UsbNotFoundError(f"{name} endpoint on {self.device.name}")


class UsbPipe:
    """One endpoint of a claimed interface; one thread at a time uses it.

    A transfer that reads ends when a packet shorter than `packet_size` (or empty) arrives, when
    the buffer is full, or when time is up; pyusb reports the last as success when anything came.
    So a reader that knows how much is to come must count, as `read` does not.
    """

    def __init__(self, device: UsbDevice, endpoint: Any) -> None:
        self.address: int = endpoint.bEndpointAddress
        self.packet_size: int = max(1, endpoint.wMaxPacketSize & 0x7FF)
        self.transfer: int = usb.util.endpoint_type(endpoint.bmAttributes)
        self.inward: bool = usb.util.endpoint_direction(self.address) == usb.util.ENDPOINT_IN
        self._device = device

    def whole_packets(self, length: int) -> int:
        """Return `length` rounded up to whole packets, at least one."""
        return max(1, -(-length // self.packet_size)) * self.packet_size

    def read_into(self, buffer: array.array[int], timeout_s: float) -> int:
        """Make one transfer into the buffer and return how many bytes came; 0: an empty packet.

        The buffer is an `array("B")` of whole packets (`whole_packets`): with anything else the
        last packet may not fit. Raises `UsbTimeoutError` when nothing came, `UsbStalledError`,
        `UsbGoneError` or `UsbTransferError`.
        """
        if len(buffer) % self.packet_size or not buffer:
            raise ValueError(f"{len(buffer)} bytes are not whole packets of {self.packet_size}")
        device = self._device
        device._require_open()
        with device._faults(self.address, timeout_s):
            return device._device.read(self.address, buffer, _milliseconds(timeout_s))

    def read(self, length: int, timeout_s: float) -> bytes:
        """Return what one transfer of at most `length` bytes, rounded up, brings; see `read_into`.

        May be shorter or, by less than one packet, longer than `length`.
        """
        buffer = array.array("B", bytes(self.whole_packets(length)))
        count = self.read_into(buffer, timeout_s)
        return memoryview(buffer)[:count].tobytes()

    def write(self, data: bytes, timeout_s: float, end: bool = False) -> None:
        """Send all of `data`, going on after partial writes.

        `end`: mark the end by an empty packet where the last one is full. Raises as `read_into`;
        `UsbTimeoutError.done` is how much went out.
        """
        device = self._device
        device._require_open()
        deadline_s = time.monotonic() + timeout_s
        rest = memoryview(data)
        while rest:
            count = self._write_once(rest[:TRANSFER_BYTES], timeout_s, len(data) - len(rest))
            rest = rest[count:]
            if not count or (rest and time.monotonic() > deadline_s):
                raise UsbTimeoutError(device.name, timeout_s, len(data) - len(rest))
        if end and len(data) % self.packet_size == 0:
            self._write_once(memoryview(b""), timeout_s, len(data))

    def clear_halt(self) -> None:
        """Make the endpoint usable again after a stall; bytes in flight are lost."""
        self._device._require_open()
        with self._device._faults(self.address):
            self._device._device.clear_halt(self.address)

    def drain(self, most: int = 1 << 24) -> int:
        """Read and forget what is still under way, until silence; return how many bytes it was.

        Raises `UsbTransferError` when the device never falls silent.
        """
        buffer = array.array("B", bytes(self.whole_packets(1 << 16)))
        lost = 0
        for _ in range(1 + most // len(buffer)):
            try:
                lost += self.read_into(buffer, SILENCE_S)
            except UsbTimeoutError:
                return lost
        raise UsbTransferError(self._device.name, "it never falls silent", CHECK_CABLE)

    def _write_once(self, data: memoryview, timeout_s: float, done: int) -> int:
        device = self._device
        try:
            with device._faults(self.address, timeout_s):
                return device._device.write(
                    self.address, array.array("B", data), _milliseconds(timeout_s)
                )
        except UsbTimeoutError as error:
            raise UsbTimeoutError(device.name, timeout_s, done) from error


def find_holders(bus: int, address: int, proc: Path = PROC) -> tuple[str, ...]:
    """Return name and process id of the other programs that have a USB device open (Linux).

    Other users' programs cannot be seen without privileges.
    """
    file = f"/dev/bus/usb/{bus:03d}/{address:03d}"
    found = []
    for pid in pids_with_open_file(file, proc):
        if pid != os.getpid():
            with suppress(OSError):
                found.append(f"{(proc / str(pid) / 'comm').read_text().strip()} (process {pid})")
    return tuple(found)


def _holder_advice(holders: tuple[str, ...]) -> str:
    for holder in holders:
        for beginning, advice in HOLDER_ADVICE.items():
            if holder.startswith(beginning):
                return advice
    return CLOSE_IT if holders else UNKNOWN_HOLDER


def _find(kind: Kind | None, backend: Any) -> list[Any]:
    chosen = backend if backend is not None else libusb_package.get_libusb1_backend()
    if chosen is None:
        raise UsbUnavailableError("libusb did not start")

    def matches(device: Any) -> bool:
        if kind is None:
            return True
        # A device with hidden descriptors matches no kind.
        with suppress(usb.core.USBError, NotImplementedError):
            return any(_kind(i) == kind for configuration in device for i in configuration)
        return False

    try:
        return list(usb.core.find(find_all=True, backend=chosen, custom_match=matches) or ())
    except usb.core.USBError as fault:
        raise UsbUnavailableError(str(fault.strerror or fault)) from fault


def _listing(device: Any) -> UsbListing:
    """Return what the device says of itself, leaving it closed."""
    accessible = True
    try:
        _configure(device)
    except (usb.core.USBError, NotImplementedError) as fault:
        accessible = getattr(fault, "errno", None) not in (errno.EACCES, errno.EPERM)
    maker, model, serial = (
        _text(device, name) if accessible else ""
        for name in ("manufacturer", "product", "serial_number")
    )
    with suppress(usb.core.USBError, NotImplementedError):
        usb.util.dispose_resources(device)
    place = device.bus or 0, device.address or 0
    return UsbListing(device.idVendor, device.idProduct, *place, maker, model, serial, accessible)


def _configure(device: Any) -> None:
    """Open the device and choose its first configuration if none is chosen.

    A configuration that is set already is left alone: setting it again would disturb a program
    that uses another interface.
    """
    try:
        device.get_active_configuration()
    except usb.core.USBError as fault:
        if fault.errno is not None:
            raise
        device.set_configuration()


def _text(device: Any, name: str) -> str:
    """Return a string descriptor, "" where the device has no readable text of that name."""
    try:
        return (getattr(device, name) or "").strip("\x00 ")
    except (usb.core.USBError, NotImplementedError, ValueError, IndexError):
        return ""


def _kind(interface: Any) -> Kind:
    return interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol


def _milliseconds(timeout_s: float) -> int:
    """Return a time limit that libusb does not take for no limit at all (its 0)."""
    return max(1, round(timeout_s * 1000))

"""A USB bus in memory: a pyusb backend that hosts simulated devices, down to their packets.

Pass it wherever pyusb takes a backend: `open_device(kind, backend=bus)`. A device is any object
with the hooks of `UsbFunction`; its messages are cut into packets here, so that a read ends as on
a real bus. Waiting costs time on the injected clock only. Source: USB 2.0
specification, 5.8 and 9.4; return codes as `usb.backend.libusb1` gives them.
"""

from __future__ import annotations

import array
import errno
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace

import usb.backend
import usb.core
import usb.util

from emmc_rig.drivers.clock import Clock

HIGH_SPEED, SUPER_SPEED = 3, 4
ENGLISH = 0x0409
GET_STATUS, GET_DESCRIPTOR, STRING = 0, 6, 3
IN, ENDPOINT_IN = 0x80, 0x82


@dataclass(frozen=True)
class EndpointSpec:
    """An endpoint; `transfer` is `drivers.usb.BULK` or `INTERRUPT`, 0x80 in `address` means in."""

    address: int
    transfer: int = usb.util.ENDPOINT_TYPE_BULK
    packet_size: int = 512


@dataclass(frozen=True)
class InterfaceSpec:
    """An interface: class, subclass, protocol, and its endpoints."""

    kind: tuple[int, int, int]
    endpoints: tuple[EndpointSpec, ...]
    number: int = 0


@dataclass(frozen=True)
class DeviceSpec:
    """A device, described by its descriptors."""

    vendor: int
    product: int
    maker: str
    model: str
    serial: str
    interfaces: tuple[InterfaceSpec, ...]
    kind: tuple[int, int, int] = (0, 0, 0)
    speed: int = HIGH_SPEED


class StallError(Exception):
    """Raised by a hook: the endpoint halts until the host clears it."""


class UnpluggedError(Exception):
    """Raised by a hook: the cable comes out now."""


class UsbFunction:
    """What a simulated device does; override the hooks that it needs.

    A hook may take time by sleeping on its clock, and may raise `StallError` or
    `UnpluggedError`.
    """

    spec: DeviceSpec

    def plugged(self) -> None:
        """The device gets power: forget what a device forgets."""

    def bulk_out(self, endpoint: int, data: bytes) -> int:
        """Take what the host sends, b"" for an empty packet; return how much of it was taken."""
        raise StallError

    def bulk_in(self, endpoint: int, length: int, timeout_s: float) -> bytes | memoryview | None:
        """Return the next message of the device, None: nothing comes within `timeout_s`.

        The message goes out in full packets and a short last one; a message of whole packets,
        b"" too, is followed by an empty packet where `ends_with_empty_packet` says so. `length`
        is what the host has room for: a message may be longer, the rest waits for the next read.
        """
        return None

    def ends_with_empty_packet(self, endpoint: int) -> bool:
        """Whether a message of whole packets is ended by an empty one."""
        return True

    def interrupt(self, endpoint: int, length: int, timeout_s: float) -> bytes | None:
        """Return the next message of an interrupt endpoint, None: nothing comes."""
        return None

    def control(
        self, request_type: int, request: int, value: int, index: int, data: bytes
    ) -> bytes:
        """Answer a class or vendor request; for one inward `data` is as long as the room is."""
        raise StallError

    def cleared(self, endpoint: int) -> None:
        """The host cleared the endpoint's halt."""


@dataclass(eq=False)
class Plug:
    """A device on the bus: its address, its holders and the bytes on their way to the host.

    denied: opening it is refused, as without a udev rule. kernel_driver: a driver of the kernel
    holds it until it is detached. claims: who holds each interface, by its number.
    """

    function: UsbFunction
    address: int
    present: bool = True
    denied: bool = False
    kernel_driver: bool = False
    claims: dict[int, object] = field(default_factory=dict)
    halted: set[int] = field(default_factory=set)
    pending: dict[int, memoryview] = field(default_factory=dict)
    ends: set[int] = field(default_factory=set)


@dataclass(eq=False)
class Handle:
    """One program's open device."""

    plug: Plug


class SimulatedUsb(usb.backend.IBackend):
    """A bus with any number of devices on it, as a pyusb backend."""

    number = 1

    def __init__(self, clock: Clock, *functions: UsbFunction) -> None:
        self._clock = clock
        self._plugs: list[Plug] = []
        self._addresses = 0
        self._lock = threading.RLock()
        for function in functions:
            self.plug(function)

    def plug(self, function: UsbFunction) -> Plug:
        """Plug a device in: it gets a new address, and its `plugged` hook is called."""
        with self._lock:
            self._addresses += 1
            plug = Plug(function, self._addresses)
            self._plugs.append(plug)
        function.plugged()
        return plug

    def unplug(self, function: UsbFunction) -> None:
        """Pull the device's cable: a program that has it open gets errors."""
        with self._lock:
            self.plug_of(function).present = False
            self._plugs = [plug for plug in self._plugs if plug.function is not function]

    def plug_of(self, function: UsbFunction) -> Plug:
        """Return where a device is plugged in; raises `ValueError` where it is not."""
        for plug in self._plugs:
            if plug.function is function:
                return plug
        raise ValueError(f"{function.spec.model} is not plugged in")

    # What pyusb asks of a backend follows; the names are pyusb's.

    def enumerate_devices(self) -> Iterator[Plug]:
        """Return the devices plugged in."""
        return iter(tuple(self._plugs))

    def get_device_descriptor(self, dev: Plug) -> SimpleNamespace:
        """Return the fields of the device descriptor."""
        spec = dev.function.spec
        return SimpleNamespace(
            bLength=18,
            bDescriptorType=1,
            bcdUSB=0x0300 if spec.speed >= SUPER_SPEED else 0x0200,
            bDeviceClass=spec.kind[0],
            bDeviceSubClass=spec.kind[1],
            bDeviceProtocol=spec.kind[2],
            bMaxPacketSize0=64,
            idVendor=spec.vendor,
            idProduct=spec.product,
            bcdDevice=0x0100,
            iManufacturer=1 if spec.maker else 0,
            iProduct=2 if spec.model else 0,
            iSerialNumber=3 if spec.serial else 0,
            bNumConfigurations=1,
            address=dev.address,
            bus=self.number,
            port_number=dev.address,
            port_numbers=(dev.address,),
            speed=spec.speed,
        )

    def get_configuration_descriptor(self, dev: Plug, config: int) -> SimpleNamespace:
        """Return the fields of the only configuration."""
        if config:
            raise IndexError(f"no configuration {config}")
        interfaces = dev.function.spec.interfaces
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=2,
            wTotalLength=9 + sum(9 + 7 * len(i.endpoints) for i in interfaces),
            bNumInterfaces=len(interfaces),
            bConfigurationValue=1,
            iConfiguration=0,
            bmAttributes=0xC0,
            bMaxPower=1,
            extra_descriptors=[],
        )

    def get_interface_descriptor(
        self, dev: Plug, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Return the fields of an interface; there is one alternate setting."""
        interfaces = dev.function.spec.interfaces
        if alt or intf >= len(interfaces):
            raise IndexError(f"no interface {intf} with alternate setting {alt}")
        spec = interfaces[intf]
        return SimpleNamespace(
            bLength=9,
            bDescriptorType=4,
            bInterfaceNumber=spec.number,
            bAlternateSetting=0,
            bNumEndpoints=len(spec.endpoints),
            bInterfaceClass=spec.kind[0],
            bInterfaceSubClass=spec.kind[1],
            bInterfaceProtocol=spec.kind[2],
            iInterface=0,
            extra_descriptors=[],
        )

    def get_endpoint_descriptor(
        self, dev: Plug, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        """Return the fields of an endpoint."""
        spec = dev.function.spec.interfaces[intf].endpoints[ep]
        return SimpleNamespace(
            bLength=7,
            bDescriptorType=5,
            bEndpointAddress=spec.address,
            bmAttributes=spec.transfer,
            wMaxPacketSize=spec.packet_size,
            bInterval=4,
            bRefresh=0,
            bSynchAddress=0,
            extra_descriptors=[],
        )

    def open_device(self, dev: Plug) -> Handle:
        """Open the device for one program."""
        if not dev.present:
            raise _fault(errno.ENODEV)
        if dev.denied:
            raise _fault(errno.EACCES)
        return Handle(dev)

    def close_device(self, dev_handle: Handle) -> None:
        """Close it and drop its claims."""
        claims = dev_handle.plug.claims
        for number in [n for n, holder in claims.items() if holder is dev_handle]:
            del claims[number]

    def get_configuration(self, dev_handle: Handle) -> int:
        """Return the only configuration's value."""
        _plug(dev_handle)
        return 1

    def claim_interface(self, dev_handle: Handle, intf: int) -> None:
        """Claim an interface that neither a program nor the kernel holds."""
        plug = _plug(dev_handle)
        with self._lock:
            if plug.kernel_driver or plug.claims.get(intf, dev_handle) is not dev_handle:
                raise _fault(errno.EBUSY)
            plug.claims[intf] = dev_handle

    def release_interface(self, dev_handle: Handle, intf: int) -> None:
        """Give an interface back."""
        if _plug(dev_handle).claims.get(intf) is dev_handle:
            del dev_handle.plug.claims[intf]

    def is_kernel_driver_active(self, dev_handle: Handle, intf: int) -> bool:
        """Whether the kernel's driver holds the device."""
        return _plug(dev_handle).kernel_driver

    def detach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Take the device from the kernel's driver."""
        _plug(dev_handle).kernel_driver = False

    def attach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Give the device back to the kernel's driver."""
        _plug(dev_handle).kernel_driver = True

    def clear_halt(self, dev_handle: Handle, ep: int) -> None:
        """Make an endpoint usable again; pending bytes are lost."""
        plug = _plug(dev_handle)
        plug.halted.discard(ep)
        plug.pending.pop(ep, None)
        plug.ends.discard(ep)
        plug.function.cleared(ep)

    def ctrl_transfer(
        self,
        dev_handle: Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array.array[int],
        timeout: int,
    ) -> int:
        """Answer a request for a string or an endpoint's state, or let the device answer."""
        plug = _plug(dev_handle)
        with self._hook(plug, 0):
            if bmRequestType == IN and bRequest == GET_DESCRIPTOR:
                answer = _string_descriptor(plug.function.spec, wValue)
            elif bmRequestType == ENDPOINT_IN and bRequest == GET_STATUS:
                answer = bytes((wIndex in plug.halted, 0))
            else:
                answer = plug.function.control(
                    bmRequestType, bRequest, wValue, wIndex, data.tobytes()
                )
        if not bmRequestType & IN:
            return len(data)
        count = min(len(data), len(answer))
        memoryview(data)[:count] = answer[:count]
        return count

    def bulk_write(
        self, dev_handle: Handle, ep: int, intf: int, data: array.array[int], timeout: int
    ) -> int:
        """Send to the device; return how much of it was taken."""
        plug = self._ready(dev_handle, ep, intf)
        with self._hook(plug, ep):
            taken = plug.function.bulk_out(ep, data.tobytes())
        if not taken and len(data):
            self._clock.sleep(timeout / 1000)
            raise _fault(errno.ETIMEDOUT)
        return taken

    def bulk_read(
        self, dev_handle: Handle, ep: int, intf: int, buff: array.array[int], timeout: int
    ) -> int:
        """Fill the buffer with packets until one is short, it is full, or time is up."""
        plug = self._ready(dev_handle, ep, intf)
        room = memoryview(buff)
        endpoints = [e for i in plug.function.spec.interfaces for e in i.endpoints]
        packet_size = next(e.packet_size for e in endpoints if e.address == ep)
        deadline_s = self._clock.now_s() + timeout / 1000
        count = 0
        while count < len(room):
            left_s = max(0.0, deadline_s - self._clock.now_s())
            pending = self._next(plug, ep, len(room) - count, left_s)
            if pending is None:
                self._clock.sleep(max(0.0, deadline_s - self._clock.now_s()))
                if count:
                    return count
                raise _fault(errno.ETIMEDOUT)
            size = min(len(pending), len(room) - count)
            if size < len(pending):
                size -= size % packet_size
                if not size:
                    del plug.pending[ep]
                    raise _fault(errno.EOVERFLOW)
            room[count : count + size] = pending[:size]
            count += size
            if size < len(pending):
                plug.pending[ep] = pending[size:]
                continue
            del plug.pending[ep]
            if size % packet_size:
                return count
            if ep in plug.ends:
                if size and count == len(room):
                    plug.pending[ep] = memoryview(b"")
                else:
                    plug.ends.discard(ep)
                return count
        return count

    def intr_read(
        self, dev_handle: Handle, ep: int, intf: int, buff: array.array[int], timeout: int
    ) -> int:
        """Fill the buffer with one message of an interrupt endpoint."""
        plug = self._ready(dev_handle, ep, intf)
        with self._hook(plug, ep):
            message = plug.function.interrupt(ep, len(buff), timeout / 1000)
        if message is None:
            self._clock.sleep(timeout / 1000)
            raise _fault(errno.ETIMEDOUT)
        if len(message) > len(buff):
            raise _fault(errno.EOVERFLOW)
        memoryview(buff)[: len(message)] = message
        return len(message)

    def _next(self, plug: Plug, ep: int, room: int, timeout_s: float) -> memoryview | None:
        """Return what is on its way on an endpoint, asking the device when nothing is."""
        if ep not in plug.pending:
            with self._hook(plug, ep):
                message = plug.function.bulk_in(ep, room, timeout_s)
            if message is None:
                return None
            plug.pending[ep] = memoryview(message)
            if plug.function.ends_with_empty_packet(ep) or not len(message):
                plug.ends.add(ep)
        return plug.pending[ep]

    def _ready(self, handle: Handle, ep: int, intf: int) -> Plug:
        plug = _plug(handle)
        if plug.claims.get(intf) is not handle:
            raise _fault(errno.EBUSY)
        if ep in plug.halted:
            raise _fault(errno.EPIPE)
        return plug

    @contextmanager
    def _hook(self, plug: Plug, ep: int) -> Iterator[None]:
        """Turn what a device's hook raises into what the bus does."""
        try:
            yield
        except StallError as stall:
            # A stall of endpoint 0 lasts for one request only.
            if ep:
                plug.halted.add(ep)
            raise _fault(errno.EPIPE) from stall
        except UnpluggedError as pulled:
            if plug.present:
                self.unplug(plug.function)
            raise _fault(errno.ENODEV) from pulled
        if not plug.present:
            raise _fault(errno.ENODEV)


def _plug(handle: Handle) -> Plug:
    if not handle.plug.present:
        raise _fault(errno.ENODEV)
    return handle.plug


def _string_descriptor(spec: DeviceSpec, value: int) -> bytes:
    kind, index = value >> 8, value & 0xFF
    texts = (spec.maker, spec.model, spec.serial)
    if kind != STRING or index > len(texts):
        raise StallError
    body = texts[index - 1].encode("utf-16-le") if index else struct.pack("<H", ENGLISH)
    return bytes((2 + len(body), STRING)) + body


def _fault(code: int) -> usb.core.USBError:
    kind = usb.core.USBTimeoutError if code == errno.ETIMEDOUT else usb.core.USBError
    return kind(errno.errorcode[code], None, code)

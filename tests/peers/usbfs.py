# pyright: reportMissingImports=false
"""A simulated USB bus behind the kernel's usbfs, so that a real libusb talks to it (umockdev).

Run the program under `umockdev-wrapper`. Source: linux/usbdevice_fs.h (x86-64), umockdev's
documentation of `UMockdevIoctlBase`.
"""

import array
import errno
import struct
import time
from collections import deque

import gi
import usb.core

gi.require_version("UMockdev", "1.0")
from gi.repository import UMockdev  # noqa: E402

NODE = "/dev/bus/usb/001/002"
CONTROL, BULK = 0xC0185500, 0xC0185502
SUBMIT, DISCARD, REAP, REAP_NOW = 0x8038550A, 0x550B, 0x4008550C, 0x4008550D
CLAIM, RELEASE, CLEAR_HALT = 0x8004550F, 0x80045510, 0x80045515
DETACH_AND_CLAIM, TO_DRIVER = 0x8108551B, 0xC0105512
CAPABILITIES, GET_DRIVER, SET_CONFIGURATION = 0x8004551A, 0x41045508, 0x80045505
RESET, SPEED = 0x5514, 0x551F
URB_CONTROL, URB_BULK = 2, 3
WHOLE_TRANSFERS = 0x04
URB_SIZE = 56
POLL_S = 0.0005


def descriptors(bus, plug):
    """Return device and configuration descriptor as they go over the wire."""
    d = bus.get_device_descriptor(plug)
    device = struct.pack("<BBHBBBB", 18, 1, d.bcdUSB, *plug.function.spec.kind, 9)
    device += struct.pack("<HHH", d.idVendor, d.idProduct, d.bcdDevice)
    device += struct.pack("<4B", d.iManufacturer, d.iProduct, d.iSerialNumber, 1)
    body = b""
    interfaces = plug.function.spec.interfaces
    for n, interface in enumerate(interfaces):
        i = bus.get_interface_descriptor(plug, n, 0, 0)
        body += struct.pack(
            "<9B", 9, 4, i.bInterfaceNumber, 0, i.bNumEndpoints, i.bInterfaceClass,
            i.bInterfaceSubClass, i.bInterfaceProtocol, 0,
        )  # fmt: skip
        for m in range(len(interface.endpoints)):
            e = bus.get_endpoint_descriptor(plug, m, n, 0, 0)
            body += struct.pack(
                "<BBBBHB", 7, 5, e.bEndpointAddress, e.bmAttributes, e.wMaxPacketSize, e.bInterval
            )
    head = struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), len(interfaces), 1, 0, 0x80, 50)
    return device + head + body


class Urb:
    """A transfer that libusb has submitted."""

    def __init__(self, data, kind, endpoint, length, buffer):
        self.data, self.kind, self.endpoint, self.length = data, kind, endpoint, length
        self.buffer, self.came, self.actual, self.status = buffer, bytearray(), 0, None


class Usbfs(UMockdev.IoctlBase):
    """Answers a libusb's ioctls from a `SimulatedUsb` with one device."""

    def __init__(self, bus):
        super().__init__()
        self.bus = bus
        (self.plug,) = bus.enumerate_devices()
        self.handle = bus.open_device(self.plug)
        self.urbs = deque()
        self.interface_of = {
            e.address: i.number for i in self.plug.function.spec.interfaces for e in i.endpoints
        }
        self.faults = []

    def do_handle_ioctl(self, client):
        try:
            return self._handle(client, client.get_request() & 0xFFFFFFFF)
        except Exception as fault:
            self.faults.append(repr(fault))
            client.complete(-1, errno.EIO)
            return True

    def _handle(self, client, request):
        argument = client.get_arg()
        if request == SUBMIT:
            return self._submit(client, argument)
        if request in (REAP, REAP_NOW):
            return self._reap(client, argument, request == REAP)
        if request == DISCARD:
            return self._discard(client, argument)
        if request == CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("<I", WHOLE_TRANSFERS))
        elif request in (CLAIM, RELEASE, DETACH_AND_CLAIM):
            number = struct.unpack("<I", bytes(argument.resolve(0, 4).retrieve()))[0]
            act = self.bus.release_interface if request == RELEASE else self.bus.claim_interface
            act(self.handle, number)
        elif request == CLEAR_HALT:
            endpoint = struct.unpack("<I", bytes(argument.resolve(0, 4).retrieve()))[0]
            self.bus.clear_halt(self.handle, endpoint)
        elif request in (GET_DRIVER, TO_DRIVER):
            client.complete(-1, errno.ENODATA)
            return True
        elif request in (SET_CONFIGURATION, RESET):
            pass
        elif request == SPEED:
            client.complete(5, 0)
            return True
        else:
            client.complete(-1, errno.ENOTTY)
            return True
        client.complete(0, 0)
        return True

    def _submit(self, client, argument):
        data = argument.resolve(0, URB_SIZE)
        raw = bytes(data.retrieve())
        kind, endpoint = raw[0], raw[1]
        (length,) = struct.unpack_from("<i", raw, 24)
        buffer = data.resolve(16, length) if length else None
        self.urbs.append(Urb(data, kind, endpoint, length, buffer))
        client.complete(0, 0)
        return True

    def _discard(self, client, argument):
        address = argument.client_addr
        for urb in self.urbs:
            if urb.data.client_addr == address:
                urb.actual, urb.status = len(urb.came), -errno.ENOENT
                if urb.came:
                    urb.buffer.update(0, bytes(urb.came))
                client.complete(0, 0)
                return True
        client.complete(-1, errno.EINVAL)
        return True

    def _reap(self, client, argument, waits):
        urb = self._next_done()
        if urb is None:
            time.sleep(POLL_S)
            client.complete(-1, errno.EAGAIN)
            return True
        raw = bytearray(urb.data.retrieve())
        struct.pack_into("<i", raw, 4, urb.status)
        struct.pack_into("<i", raw, 28, urb.actual)
        urb.data.update(0, bytes(raw))
        argument.resolve(0, 8).set_ptr(0, urb.data)
        client.complete(0, 0)
        return True

    def _next_done(self):
        waiting = set()
        for urb in self.urbs:
            if urb.status is None and urb.endpoint not in waiting:
                self._progress(urb)
            if urb.status is not None:
                self.urbs.remove(urb)
                return urb
            waiting.add(urb.endpoint)
        return None

    def _progress(self, urb):
        try:
            if urb.kind == URB_CONTROL:
                self._control(urb)
            elif urb.endpoint & 0x80:
                self._inward(urb)
            else:
                data = (
                    array.array("B", bytes(urb.buffer.retrieve()))
                    if urb.length
                    else array.array("B")
                )
                interface = self.interface_of[urb.endpoint]
                done = self.bus.bulk_write(self.handle, urb.endpoint, interface, data, 100)
                urb.actual, urb.status = done, 0
        except usb.core.USBTimeoutError:
            return
        except usb.core.USBError as fault:
            urb.status = -(fault.errno or errno.EIO)

    def _inward(self, urb):
        room = array.array("B", bytes(urb.length - len(urb.came)))
        interface = self.interface_of[urb.endpoint]
        count = self.bus.bulk_read(self.handle, urb.endpoint, interface, room, 1)
        urb.came += room[:count].tobytes()
        packet = next(
            e.packet_size
            for i in self.plug.function.spec.interfaces
            for e in i.endpoints
            if e.address == urb.endpoint
        )
        if len(urb.came) == urb.length or count % packet or not count:
            if urb.came:
                urb.buffer.update(0, bytes(urb.came))
            urb.actual, urb.status = len(urb.came), 0

    def _control(self, urb):
        raw = bytes(urb.buffer.retrieve())
        kind, request, value, index, length = struct.unpack_from("<BBHHH", raw)
        data = array.array("B", raw[8 : 8 + length] if not kind & 0x80 else bytes(length))
        count = self.bus.ctrl_transfer(self.handle, kind, request, value, index, data, 1000)
        if kind & 0x80 and count:
            urb.buffer.update(8, data[:count].tobytes())
        urb.actual, urb.status = count, 0


def mock(bus):
    """Return a testbed with the bus's device in it, and the `Usbfs` that answers; keep both."""
    testbed = UMockdev.Testbed.new()
    usbfs = Usbfs(bus)
    raw = descriptors(bus, usbfs.plug)
    testbed.add_from_string(
        "P: /devices/pci0000:00/usb1/1-1\n"
        f"N: {NODE.removeprefix('/dev/')}\n"
        f"E: DEVNAME={NODE}\nE: DEVTYPE=usb_device\nE: SUBSYSTEM=usb\n"
        "E: BUSNUM=001\nE: DEVNUM=002\nE: MAJOR=189\nE: MINOR=1\n"
        "A: busnum=1\\n\nA: devnum=2\\n\nA: speed=5000\\n\nA: bConfigurationValue=1\\n\n"
        f"H: descriptors={raw.hex().upper()}\n"
    )
    testbed.attach_ioctl(NODE, usbfs)
    return testbed, usbfs

"""Serial ports of this computer: list, choice by name, holder of a port, and permissions.

A port is named in one of four ways: by its device (`/dev/ttyUSB0`), by a pattern
(`/dev/serial/by-id/*FTDI*`), by the serial number of its USB adapter (`usb:AB0JQ4XY`), or by a URL
that pyserial knows (`socket://192.168.0.9:4001`). Patterns and serial numbers find the port again
when it comes back under another name.
"""

import glob
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from emmc_rig.drivers.errors import PortNotFoundError

BY_SERIAL_NUMBER = "usb:"
PROTOCOLS_BY_USB_ID = {
    (0x0403, 0xFAF0): "apt",
    (0x2939, None): "zaber",
    (0x2341, None): "grbl",
    (0x2A03, None): "grbl",
    (0x1A86, None): "grbl",
}
"""What usually answers behind a USB vendor and product; other adapters may carry anything."""
COMMAND_LINE_SHOWN = 60
PROC = Path("/proc")


def guess_of(port: ListPortInfo) -> str:
    """Return the protocol that usually answers on a port, "" where anything may."""
    exact = PROTOCOLS_BY_USB_ID.get((port.vid, port.pid))
    return exact or PROTOCOLS_BY_USB_ID.get((port.vid, None), "")


def list_serial_ports() -> list[ListPortInfo]:
    """Return the serial ports of this computer, by name."""
    return sorted(list_ports.comports(), key=lambda port: port.device)


def find_port(wanted: str) -> str:
    """Return the device (or URL) that `wanted` means now; see the top of this module.

    Raises `PortNotFoundError` when nothing, or more than one port, answers to it.
    """
    if "://" in wanted:
        return wanted
    if wanted.startswith(BY_SERIAL_NUMBER):
        number = wanted.removeprefix(BY_SERIAL_NUMBER)
        found = [port.device for port in list_serial_ports() if port.serial_number == number]
    elif glob.has_magic(wanted):
        found = sorted(glob.glob(wanted))
    else:
        return wanted
    if not found:
        raise PortNotFoundError(wanted)
    if len(found) > 1:
        raise PortNotFoundError(wanted, f"means more than one: {', '.join(found)}")
    return found[0]


def usb_serial_number(device: str) -> str:
    """Return the serial number of the USB adapter behind a device, "" where it has none."""
    real = os.path.realpath(device)
    for port in list_serial_ports():
        if os.path.realpath(port.device) == real:
            return port.serial_number or ""
    return ""


def holder_of(device: str) -> str:
    """Return "program (pid N)" of a process that has the device open, "" where none is visible.

    Looks for a lock on the device in /proc/locks, which shows those of every user, then for the
    device among the open files of the processes that this user may inspect. Linux only.
    """
    pid = next(_pids_with_lock(device), None) or next(pids_with_open_file(device), None)
    return "" if pid is None else f"{_program(pid)} (pid {pid})"


def _pids_with_lock(device: str) -> Iterator[int]:
    """Lines of /proc/locks: `1: FLOCK ADVISORY WRITE pid major:minor:inode start end`."""
    if sys.platform != "linux":
        return
    try:
        status = os.stat(device)
        lines = Path("/proc/locks").read_text().splitlines()
    except OSError:
        return
    place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    for line in lines:
        fields = [field for field in line.split() if field != "->"]
        if len(fields) > 5 and fields[5] == place and fields[4].isdigit() and fields[4] != "0":
            yield int(fields[4])


def pids_with_open_file(path: str, proc: Path = PROC) -> Iterator[int]:
    """Yield the processes that have a file open, as far as this user may see; Linux only."""
    real = os.path.realpath(path)
    for process in sorted(proc.glob("[0-9]*")):
        with suppress(OSError):  # a process of another user, or one that has just ended
            if any(os.readlink(link) == real for link in (process / "fd").iterdir()):
                yield int(process.name)


def _program(pid: int) -> str:
    """Return the command line of a process, as far as it fits, or "a process"."""
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        command = b" ".join(words).decode("utf-8", "replace").strip()
        command = command or Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        command = ""
    printable = "".join(c if c.isprintable() else " " for c in command)
    if len(printable) > COMMAND_LINE_SHOWN:
        printable = printable[:COMMAND_LINE_SHOWN] + "..."
    return printable or "a process"

"""A lock on any disk, for one program at a time: the operating system's, or a file of that name.

The library `filelock` takes the system's lock, which ends with its program, also after a kill. Some
network disks cannot lock files. There the file itself is the lock, because only one program can
make it. After a kill it stays, and the error of the next program names the file to delete.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from emmc_rig.model.files import is_running
from emmc_rig.model.json_text import parse_json

TRIES, WAIT_S = 200, 0.01
"""A program that has just taken the lock needs a moment to write who it is."""


class TakenError(Exception):
    """Another program has the lock: `holder` is its name, `advice` the remedy."""

    def __init__(self, path: Path, holder: Mapping[str, Any], by_file: bool) -> None:
        self.holder = "another program"
        if holder:
            self.holder = "`{command}` (process {process} on {host}, since {since})".format(
                **{"since": "an unknown time", **holder}
            )
        self.advice = "wait until it ends, or stop it"
        if by_file:
            delete = f"delete {path}, for this disk cannot lock files"
            here, process = holder.get("host") == socket.gethostname(), holder.get("process")
            ours = process == os.getpid()
            can_tell = here and isinstance(process, int) and not ours
            ended = can_tell and not is_running(int(process or 0))
            self.advice = (
                f"it has ended: {delete}"
                if ended
                else f"{self.advice}; if it ended without a word, {delete}"
            )
        super().__init__(f"{self.holder}; {self.advice}")


def take_lock(path: Path) -> Callable[[], None]:
    """Make and lock a file; returns what unlocks and removes it. Raises `TakenError`, `OSError`."""
    from filelock import FileLock, Timeout

    by_file = False
    for _ in range(TRIES):
        is_ours = _make(path)
        claim = partial(_claim, path)
        lock = FileLock(path, thread_local=False, fallback_to_soft=False, on_acquired=claim)
        try:
            lock.acquire(blocking=False)
            return partial(_release, path, os.stat(path), lock.release)
        except Timeout:
            pass
        except OSError as fault:
            if fault.filename is not None:
                raise
            by_file = True  # the fault is of the lock, not of a file: this disk has none
            if is_ours:
                path.write_bytes(_own_name(by_file=True))
                return partial(_release, path, os.stat(path))
        if holder := _holder(path):
            raise TakenError(path, holder, by_file)
        time.sleep(WAIT_S)
    raise TakenError(path, {}, by_file)


def _make(path: Path) -> bool:
    """Return whether this program made the file; False where it is there. Raises `OSError`."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    try:
        os.close(os.open(path, flags, 0o666))
    except FileExistsError:
        return False
    return True


def _claim(path: Path, descriptor: int) -> None:
    """Write into the locked file who holds it; raises `TakenError` where the file is the lock."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    holder = _read(os.read(descriptor, 4096))
    if holder.get("by_file"):
        raise TakenError(path, holder, by_file=True)
    with suppress(OSError):  # on a full disk the lock holds without a name
        os.ftruncate(descriptor, 0)  # a killed program's name must not be read any more
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, _own_name(by_file=False))


def _release(path: Path, own: os.stat_result, unlock: Callable[[], None] = lambda: None) -> None:
    if sys.platform == "win32":
        unlock()  # an open file cannot be removed there
        with suppress(OSError):  # the next program has it open: it removes the file
            path.unlink()
        return
    try:
        with suppress(FileNotFoundError):
            if os.path.samestat(own, os.lstat(path)):
                path.unlink()
    finally:
        unlock()


def _own_name(by_file: bool) -> bytes:
    name = {
        "command": command_line(),
        "process": os.getpid(),
        "host": socket.gethostname(),
        "since": datetime.now(UTC).astimezone().isoformat(timespec="seconds"),
    }
    return json.dumps(name | ({"by_file": True} if by_file else {})).encode()


def command_line() -> str:
    """Return the command as it was typed."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])


def _holder(path: Path) -> dict[str, Any]:
    """Return who wrote a lock file; empty where it is not written yet, or gone.

    The first byte, a brace, is not read: on Windows it is what the holder has locked.
    """
    try:
        with open(path, "rb", buffering=0) as file:
            file.seek(1)
            return _read(b"{" + file.read(4096))
    except FileNotFoundError:
        return {}


def _read(data: bytes) -> dict[str, Any]:
    try:
        name = parse_json(data, "the lock", ValueError)
    except ValueError:
        return {}
    return name if isinstance(name, dict) and {*name} >= {"command", "process", "host"} else {}

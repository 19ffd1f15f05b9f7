"""A lock on any disk, for one program at a time: the operating system's, or a file of that name.

The system's lock goes with its program, however that ends. Where files cannot be locked (some
network disks, Windows) the file itself is the lock, for only one program can make it; it stays when
that program is killed, and whoever meets it is told which file to delete.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from emmc_rig.model.json_text import parse_json

TRIES, WAIT_S = 200, 0.01
"""A program that has just taken the lock needs a moment to write who it is."""


class TakenError(Exception):
    """Another program has the lock; `holder` says which one, `advice` what to do."""

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
            can_tell = here and isinstance(process, int) and not ours and os.name != "nt"
            ended = can_tell and not is_running(int(process or 0))
            self.advice = (
                f"it has ended: {delete}"
                if ended
                else f"{self.advice}; if it ended without a word, {delete}"
            )
        super().__init__(f"{self.holder}; {self.advice}")


def take_lock(path: Path) -> Callable[[], None]:
    """Make and lock a file; returns what unlocks and removes it. Raises `TakenError`, `OSError`."""
    by_file = False
    for _ in range(TRIES):
        try:
            descriptor, made = _opened(path)
        except FileNotFoundError:
            if not path.parent.is_dir():
                raise
            continue  # it went between two looks at it
        by_file, is_free = False, True
        try:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            is_free = False
        except (OSError, ImportError):
            by_file, is_free = True, made
        holder = _holder(os.read(descriptor, 4096))
        is_taken = not is_free or bool(holder.get("by_file"))
        if not is_taken and _is_named(descriptor, path):
            with suppress(OSError):  # on a full disk the lock holds without a name
                os.ftruncate(descriptor, 0)  # a killed program's name must not be read any more
                os.pwrite(descriptor, _own_name(by_file), 0)
            return partial(_release, descriptor, path)
        os.close(descriptor)
        if is_taken and holder:
            raise TakenError(path, holder, by_file or bool(holder.get("by_file")))
        if is_taken:
            time.sleep(WAIT_S)
    raise TakenError(path, {}, by_file)


def _opened(path: Path) -> tuple[int, bool]:
    """Return the file's descriptor, and whether this program made it."""
    flags = os.O_RDWR | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0)
    try:
        return os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666), True
    except FileExistsError:
        return os.open(path, flags), False


def _release(descriptor: int, path: Path) -> None:
    named, windows = _is_named(descriptor, path), os.name == "nt"
    try:
        if named and not windows:
            os.unlink(path)
    finally:
        os.close(descriptor)
    if named and windows:  # it removes no open file
        os.unlink(path)


def _is_named(descriptor: int, path: Path) -> bool:
    """Return whether the open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


def _own_name(by_file: bool) -> bytes:
    from emmc_rig.files.results import command_line

    name = {
        "command": command_line(),
        "process": os.getpid(),
        "host": socket.gethostname(),
        "since": datetime.now(UTC).astimezone().isoformat(timespec="seconds"),
    }
    return json.dumps(name | ({"by_file": True} if by_file else {})).encode()


def _holder(data: bytes) -> dict[str, Any]:
    """Return who wrote a lock file; empty where it is not written yet."""
    try:
        name = parse_json(data, "the lock", ValueError)
    except ValueError:
        return {}
    return name if isinstance(name, dict) and {*name} >= {"command", "process", "host"} else {}


def is_running(process: int) -> bool:
    """Return whether another process of that number runs; Windows is not asked."""
    if os.name == "nt":
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return process != os.getpid()

"""A lock for timed runs, one at a time on this machine; its file names the process that holds it.

The lock is the kernel's (flock), so that it ends with the processes that hold it, however they end.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

NAME = "emmc-rig-timing.lock"


def lock_path() -> Path:
    """Return the machine's lock file."""
    return Path(tempfile.gettempdir()) / NAME


@contextmanager
def timing_lock(
    purpose: str,
    path: Path | None = None,
    on_wait: Callable[[str], None] | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[int]:
    """Hold the lock while the block runs; yield its descriptor, for a child to hold as well.

    purpose: what is timed, in words, for those who wait. on_wait: called once, with who holds it.
    """
    path = path or lock_path()
    descriptor = _opened(path)
    try:
        announced = False
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if on_wait is not None and not announced:
                    on_wait(holder(path))
                announced = True
                sleep(0.2)
        _write(descriptor, f"process {os.getpid()}, {purpose}")
        yield descriptor
        # Emptied, not removed: another may already wait for this very file.
        _write(descriptor, "")
    finally:
        os.close(descriptor)


def holder(path: Path | None = None) -> str:
    """Return who holds the lock, in words."""
    try:
        return (path or lock_path()).read_text("utf-8", errors="replace").strip() or "somebody"
    except OSError:
        return "somebody"


def _opened(path: Path) -> int:
    """Open the file, to read only where it is another user's; flock takes either."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except PermissionError:
        return os.open(path, os.O_RDONLY)


def _write(descriptor: int, text: str) -> None:
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, text.encode(), 0)
    except OSError:
        return

"""The lock of a session: one program writes at a time, and a second one names it in its error.

A session is locked by `session.lock` in it; one that is yet to be made by `.NAME.lock` beside it.
The lock is the operating system's and goes with the program, however that ends; the file says who
holds it and is removed at the end. Where files cannot be locked (Windows, some network disks)
nothing is held.
"""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.folders import is_session
from emmc_rig.files.results import command_line
from emmc_rig.session.session import KNOWN, LOCK, wall_time
from emmc_rig.session.storage import PART

OURS = re.compile(r"\.?(\d{5}|amended-\d+)-")
"""How frames and amended files are called, parts of them too."""
TRIES, WAIT_S = 200, 0.01
"""A program that has just taken the lock needs a moment to write who it is."""


class HeldError(AppError):
    """Another program writes the session; `holder` says which one."""

    def __init__(self, folder: Path, holder: str) -> None:
        super().__init__(f"{folder}: held by {holder}; wait until it ends, or stop it")
        self.holder = holder


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold a session, or the name of one that may be made; what killed programs left is cleared.

    Take it before anything of the session is read, and again for one just made. Raises `HeldError`
    where another program holds it, AppError where no lock can be written.
    """
    folder = Path(os.path.realpath(folder))
    beside = folder.with_name(f".{folder.name}.lock")
    with ExitStack() as locks:
        while not is_session(folder):
            locks.enter_context(_made_above(folder))
            locks.enter_context(_locked(beside, folder))
            if not is_session(folder):
                _clear_unborn(folder)
                break
            # It was made between the two looks at it.
            locks.close()
        else:
            locks.enter_context(_locked(folder / LOCK, folder))
            # Nobody is needed to make it any more: what lies beside is of a killed program, or of
            # the one that holds both.
            if beside.exists() or _unborn(folder):
                with suppress(AppError), _locked(beside, folder):
                    _clear_unborn(folder)
        yield


@contextmanager
def _locked(path: Path, folder: Path) -> Iterator[None]:
    try:
        descriptor = _acquired(path, folder)
    except OSError as fault:
        made = "written" if is_session(folder) else "made"
        raise AppError(
            f"{folder}: cannot be {made} ({fault.strerror}); make that possible, or name another "
            "folder"
        ) from fault
    try:
        yield
    finally:
        if descriptor is not None:
            if _is_named(descriptor, path):
                os.unlink(path)
            os.close(descriptor)


def _acquired(path: Path, folder: Path) -> int | None:
    """Return the descriptor of a lock file that is held; None where files cannot be locked."""
    try:
        import fcntl
    except ImportError:
        return None
    for _ in range(TRIES):
        flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
        descriptor = os.open(path, flags, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = _holder(os.pread(descriptor, 4096, 0))
            os.close(descriptor)
            if holder:
                raise HeldError(folder, holder) from None
            time.sleep(WAIT_S)
            continue
        except OSError:
            os.unlink(path)
            os.close(descriptor)
            return None
        named = _is_named(descriptor, path)
        if named and os.fstat(descriptor).st_size == 0:
            # On a full disk the lock holds without a name.
            with suppress(OSError):
                os.write(descriptor, _own_name())
            return descriptor
        if named:
            # Left by a killed program: its name must not be read any more.
            os.unlink(path)
        os.close(descriptor)
    raise HeldError(folder, "another program")


def _is_named(descriptor: int, path: Path) -> bool:
    """Return whether the open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


def _own_name() -> bytes:
    name = {
        "command": command_line(),
        "process": os.getpid(),
        "host": socket.gethostname(),
        "since": wall_time(),
    }
    return json.dumps(name).encode()


def _holder(data: bytes) -> str:
    """Return who wrote a lock file; "" where it is not written yet."""
    try:
        name = json.loads(data)
        return "`{command}` (process {process} on {host}, since {since})".format(**name)
    except (ValueError, KeyError, TypeError, RecursionError):
        return ""


@contextmanager
def _made_above(folder: Path) -> Iterator[None]:
    """Make the folders above; those that are empty at the end go again."""
    made = [above for above in folder.parents if not above.exists()]
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise AppError(
            f"{folder}: cannot be made ({fault.strerror}); name another folder"
        ) from fault
    try:
        yield
    finally:
        for above in made:
            with suppress(OSError):
                above.rmdir()


def _unborn(folder: Path) -> list[Path]:
    """Return the folders in which a session of this name was begun, and never took its name."""
    name = re.compile(rf"\.{re.escape(folder.name)}\.(\d+-[0-9a-f]+\.)?{PART[1:]}")
    try:
        return [one for one in folder.parent.iterdir() if name.fullmatch(one.name) and one.is_dir()]
    except OSError:
        return []


def _clear_unborn(folder: Path) -> None:
    """Remove them; one that holds anything else stays."""
    for one in _unborn(folder):
        with suppress(OSError):
            for file in list(one.rglob("*")):
                if file.is_file() and (file.name in KNOWN or OURS.match(file.name)):
                    file.unlink()
            for inside in one.iterdir():
                inside.rmdir()
            one.rmdir()

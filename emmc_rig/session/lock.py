"""The lock of a session: one program writes at a time, and the error of a second names the first.

The lock of a session is `session.lock` in its folder; before the folder exists it is `.NAME.lock`
beside it. The file names the holder and is removed at the end. The file of a killed program blocks
nobody, except on disks that cannot lock files (see `emmc_rig.store.locks`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.model.files import PART
from emmc_rig.session.session import KNOWN, LOCK
from emmc_rig.store.folders import is_session, made_folder
from emmc_rig.store.locks import TakenError, take_lock

OURS = re.compile(r"\.?(\d{5}|amended-\d+)-")
"""How frames and amended files are called, parts of them too."""


class HeldError(AppError, BlockingIOError):
    """Another program writes the session; `holder` says which one."""

    def __init__(self, folder: Path, taken: TakenError) -> None:
        super().__init__(f"{folder}: held by {taken.holder}; {taken.advice}")
        self.holder = taken.holder


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
            try:
                locks.enter_context(made_folder(folder.parent))
            except OSError as fault:
                raise AppError(
                    f"{folder}: cannot be made ({fault.strerror}); name another folder"
                ) from fault
            locks.enter_context(_locked(beside, folder))
            if not is_session(folder):
                _remove_stale_temporaries(folder)
                break
            # It was made between the two looks at it.
            locks.close()
        else:
            locks.enter_context(_locked(folder / LOCK, folder))
            # Nobody is needed to make it any more: what lies beside is of a killed program, or of
            # the one that holds both.
            if beside.exists() or _stale_temporaries(folder):
                with suppress(AppError), _locked(beside, folder):
                    _remove_stale_temporaries(folder)
        yield


@contextmanager
def _locked(path: Path, folder: Path) -> Iterator[None]:
    try:
        release = take_lock(path)
    except TakenError as taken:
        raise HeldError(folder, taken) from None
    except OSError as fault:
        made = "written" if is_session(folder) else "made"
        raise AppError(
            f"{folder}: cannot be {made} ({fault.strerror}); make that possible, or name another "
            "folder"
        ) from fault
    try:
        yield
    finally:
        release()


def _stale_temporaries(folder: Path) -> list[Path]:
    """Return folders of sessions that a killed program left before they got their name."""
    name = re.compile(rf"\.{re.escape(folder.name)}\.(\d+-[0-9a-f]+\.)?{PART[1:]}")
    try:
        beside = list(folder.parent.iterdir())
    except OSError:
        return []
    return [part for part in beside if name.fullmatch(part.name) and part.is_dir()]


def _remove_stale_temporaries(folder: Path) -> None:
    """Remove these folders, except those with files of other programs."""
    for part in _stale_temporaries(folder):
        with suppress(OSError):
            for file in list(part.rglob("*")):
                if file.is_file() and (file.name in KNOWN or OURS.match(file.name)):
                    file.unlink()
            for inside in part.iterdir():
                inside.rmdir()
            part.rmdir()

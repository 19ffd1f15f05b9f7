"""Compiled kernels whose machine code is kept on the disk for as long as its sources are the same.

Numba keeps machine code until the kernel's own file changes. But helpers and constants of other
files are part of that code, so it is kept here per state of all files that the kernel's file
imports from its own package and from this project, directly or through others.

What one kernel calls of another must be compiled into it (`forceinline=True`, and no cache of its
own). Where a call is left, the caller's machine code brings a copy of what it calls, optimised once
more, and a process calls whichever copy it met first: one that compiles that of the helper itself,
one that loads from the disk that of the first caller. The two may round differently.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core import config

_PROJECT = Path(__file__).parents[2]
_PACKAGES = ("emmc_rig", "drivers", "calibration", "reconstruction", "simulators")
_IMPORT = re.compile(r"^from +([\w.]+) +import +(\([^)]*\)|.*)|^import +([\w.]+)", re.MULTILINE)
_UNUSED_DAYS = 30
"""Machine code that no process has loaded for so long is removed: its sources have changed."""
_numba: Any = config
_placing = threading.Lock()


def njit(*arguments: Any, cache: bool = False, **options: Any) -> Callable[..., Any]:
    """Compile as `numba.njit` does; cache: keep the machine code while its sources are the same.

    Where no folder can be written to, nothing is kept, and every process compiles anew.
    """
    if arguments and callable(arguments[0]):
        return njit(cache=cache, **options)(arguments[0])

    def compiled(kernel: Callable) -> Callable[..., Any]:
        folder = _folder(Path(kernel.__code__.co_filename), _user_folder()) if cache else None
        if folder is None:
            return numba.njit(*arguments, **options)(kernel)
        with _placing:  # Numba reads the folder once, here, and offers no other way to choose it
            before, _numba.CACHE_DIR = _numba.CACHE_DIR, str(folder)
            try:
                return numba.njit(*arguments, cache=True, **options)(kernel)
            finally:
                _numba.CACHE_DIR = before

    return compiled


def _user_folder() -> str:
    """Return the folder that NUMBA_CACHE_DIR names, or an empty text."""
    with _placing:
        return _numba.CACHE_DIR


@cache
def _folder(file: Path, user_folder: str) -> Path | None:
    """Return the folder of a file's kernels as its sources are now; None where none can be made."""
    try:
        name, state = _state(file)
    except OSError:  # no source at hand, as in a zip archive
        return None
    for place in _places(file, user_folder):
        folder = place / f"{name}-{state}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            os.utime(folder)
        except OSError:
            continue
        with suppress(OSError):  # another process does the same
            _remove_unused(place)
        return folder
    return None


def _places(file: Path, user_folder: str) -> Iterator[Path]:
    """Yield where machine code may be kept, the first choice first."""
    if user_folder:
        yield Path(user_folder) / "emmc-rig"
    yield file.parent / "__pycache__" / "kernels"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(home):
        yield Path(home) / "emmc-rig" / "kernels"


def _remove_unused(place: Path) -> None:
    oldest = time.time() - _UNUSED_DAYS * 86400
    for folder in place.iterdir():
        if folder.stat().st_mtime < oldest:
            shutil.rmtree(folder, ignore_errors=True)


def _state(file: Path) -> tuple[str, str]:
    """Return a file's dotted name, and a hash of its sources and of what compiles them."""
    root = file.parent
    while (root / "__init__.py").exists():
        root = root.parent
    name = ".".join(file.relative_to(root).with_suffix("").parts)
    found, to_read = {file: b""}, [file]
    while to_read:
        source = to_read.pop()
        content, imported = _read(source, root)
        found[source] = content
        to_read += imported - found.keys()
        found.update(dict.fromkeys(imported - found.keys(), b""))
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for source in sorted(found):
        digest.update(found[source])
    return name, digest.hexdigest()[:16]


@cache
def _read(source: Path, root: Path) -> tuple[bytes, frozenset[Path]]:
    """Return a file's hash, and what it imports from the package below root and this project."""
    content = source.read_bytes()
    found = set()
    for line in _IMPORT.finditer(content.decode()):
        module = line[1] or line[3]
        parts = module.lstrip(".").split(".")
        level = len(module) - len(module.lstrip("."))
        if level:
            bases = [source.parents[level - 1]]
        elif parts[0] in _PACKAGES:
            bases = [_PROJECT]
        else:
            bases = [root] if (root / parts[0]) in source.parents else []
        for base in bases:
            place = base.joinpath(*filter(None, parts))
            for named in (place, *(place / name for name in re.findall(r"\w+", line[2] or ""))):
                files = named.with_name(f"{named.name}.py"), named / "__init__.py"
                found |= {file for file in files if file.is_file()}
    return hashlib.sha256(content).digest(), frozenset(found)

"""Compiled kernels whose machine code is kept on the disk for as long as its sources are the same.

Numba keeps machine code until the kernel's own file changes. But helpers and constants of imported
files are part of that code. It is therefore kept by a hash of all files of this project and of the
kernel's own package that the kernel's file imports, directly or indirectly.

A helper that a kernel calls must be compiled into the kernel (`forceinline=True`, and no cache of
its own). If a call remains, the kernel's machine code brings its own copy of the helper, optimised
again, and a process calls the copy that it met first: after compiling, the helper's own copy; after
loading from the disk, the copy of the first kernel. The two copies may round differently.

Of several processes that need a kernel, the first compiles it; the others wait and load its code.
The clock `running_s` stands still meanwhile: the seconds of a method are those of its work.
"""

from __future__ import annotations

import gc
import hashlib
import os
import re
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from filelock import FileLock
from numba.core import config
from numba.core.compiler import Flags
from numba.core.registry import CPUDispatcher
from numba.core.targetconfig import TargetConfig

_PROJECT = Path(__file__).parents[2]
_IMPORT = re.compile(r"^from +([\w.]+) +import +(\([^)]*\)|.*)|^import +([\w.]+)", re.MULTILINE)
_UNUSED_DAYS = 30
"""Machine code that no process has loaded for so long is removed: its sources have changed."""
WAIT_S, LOOK_S = 120.0, 0.02
"""For a kernel that another process compiles, ten times as long as the slowest takes: one that was
suspended holds up nobody for ever. How often to look."""
_numba: Any = config
_placing = threading.Lock()
_within = threading.local()
"""Set in a thread that compiles or loads a kernel."""


def _same_flags(self: Flags, other: Any) -> bool:
    """Return whether all options are equal; at once where the same are set to the same values."""
    if type(self) is type(other) and getattr(self, "_values", 0) == getattr(other, "_values", 1):
        return True
    return TargetConfig.__eq__(self, other)


_FLAGS_HASH = hash(Flags())
"""Numba's hash of flags is the hash of their names."""
# Numba compares flags at each call that it types, option by option: a quarter of all compiling.
setattr(Flags, "__eq__", _same_flags)  # noqa: B010
setattr(Flags, "__hash__", lambda _: _FLAGS_HASH)  # noqa: B010


class _Inlined(CPUDispatcher):
    """What is compiled into kernels alone: machine code that Python could call is not made."""

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        raise TypeError(f"{self.__name__} is compiled into kernels: here call its `py_func`")


def njit(*arguments: Any, cache: bool = False, **options: Any) -> Callable[..., Any]:
    """Compile as `numba.njit` does; cache: keep the machine code while its sources are the same.

    Where no folder can be written to, nothing is kept, and every process compiles anew. What makes
    a function callable from C is left out, and of a helper (`forceinline=True`,
    `inline="always"`) what makes it callable from Python, too: a fifth of the time to compile.
    """
    if arguments and callable(arguments[0]):
        return njit(cache=cache, **options)(arguments[0])
    options["no_cfunc_wrapper"] = True
    is_helper = options.get("forceinline") or options.get("inline") == "always"
    if is_helper:
        options["no_cpython_wrapper"] = True

    def compiled(kernel: Callable) -> Callable[..., Any]:
        if is_helper:
            helper = numba.njit(*arguments, **options)(kernel)
            helper.__class__ = _Inlined
            return helper
        folder = _folder(Path(kernel.__code__.co_filename), _user_folder()) if cache else None
        if folder is None:
            return _metered(numba.njit(*arguments, **options)(kernel))
        with _placing:  # Numba reads the folder once, here, and offers no other way to choose it
            before, _numba.CACHE_DIR = _numba.CACHE_DIR, str(folder)
            try:
                made = numba.njit(*arguments, cache=True, **options)(kernel)
            finally:
                _numba.CACHE_DIR = before
        lock = folder / f"{kernel.__qualname__}-{kernel.__code__.co_firstlineno}.lock"
        compile_or_load = made.compile

        def one_compiles(sig: Any) -> Any:
            with _locked(lock), _uncollected():
                return compile_or_load(sig)

        made.compile = one_compiles
        return _metered(made)

    return compiled


class _Meter:
    """Seconds in which any thread compiled or loaded a kernel, or waited for one."""

    def __init__(self) -> None:
        self.lock, self.at_once, self.since, self.total_s = threading.Lock(), 0, 0.0, 0.0

    @contextmanager
    def __call__(self) -> Iterator[None]:
        with self.lock:
            self.since = self.since if self.at_once else time.perf_counter()
            self.at_once += 1
        try:
            yield
        finally:
            with self.lock:
                self.at_once -= 1
                if not self.at_once:
                    self.total_s += time.perf_counter() - self.since

    def read(self) -> tuple[float, float]:
        """Return the time now, by `time.perf_counter`, and the seconds until then."""
        with self.lock:
            now = time.perf_counter()
            return now, self.total_s + (now - self.since if self.at_once else 0.0)


_meter = _Meter()
if sys.platform != "win32":
    os.register_at_fork(after_in_child=_meter.__init__)  # the thread that compiled is not there


def compiling_s() -> float:
    """Return the seconds in which this process compiled or loaded kernels so far."""
    return _meter.read()[1]


def running_s() -> float:
    """Return the time of a clock that stands still while a kernel is compiled or loaded.

    It does for all threads: Numba holds Python's lock meanwhile.
    """
    now, compiling = _meter.read()
    return now - compiling


def _metered(kernel: Any) -> Any:
    """Return a kernel that adds to `compiling_s` what its machine code takes."""
    compile_or_load = kernel.compile

    def compiled(sig: Any) -> Any:
        with _meter():
            return compile_or_load(sig)

    kernel.compile = compiled
    return kernel


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock on a file, against threads and processes, unless it cannot be had in WAIT_S.

    What a kernel compiles within itself takes no lock of its own: only who has a lock waits for
    Numba's, so that nobody who has Numba's waits for a lock.
    """
    if getattr(_within, "kernel", False):
        yield
        return
    _within.kernel = True
    try:
        with ExitStack() as held:
            with suppress(OSError):  # the folder is gone, its disk cannot lock, or WAIT_S are over
                held.enter_context(
                    FileLock(path, WAIT_S, poll_interval=LOOK_S, fallback_to_soft=False)
                )
            yield
    finally:
        _within.kernel = False


@contextmanager
def _uncollected() -> Iterator[None]:
    """Collect no garbage meanwhile: a tenth of the time, for Numba makes millions of objects."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def is_kept(file: str) -> bool:
    """Return whether the machine code of this file's kernels is kept for later processes."""
    return _folder(Path(file), _user_folder()) is not None


def _user_folder() -> str:
    """Return the folder that NUMBA_CACHE_DIR names, or an empty text."""
    with _placing:
        return _numba.CACHE_DIR


@cache
def _folder(file: Path, user_folder: str) -> Path | None:
    """Return the folder for kernels of a file in its present state; None where no disk takes it."""
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
        elif parts[0] == "emmc_rig":
            bases = [_PROJECT]
        else:
            bases = [root] if (root / parts[0]) in source.parents else []
        for base in bases:
            place = base.joinpath(*filter(None, parts))
            for named in (place, *(place / name for name in re.findall(r"\w+", line[2] or ""))):
                files = named.with_name(f"{named.name}.py"), named / "__init__.py"
                found |= {file for file in files if file.is_file()}
    return hashlib.sha256(content).digest(), frozenset(found)

"""Rules of Windows for `emmc_rig`, in every Python process that has this folder on PYTHONPATH.

Modules of `emmc_rig` import an `os`, `sys`, `signal` and `psutil` as Windows has them, and no POSIX
module. The standard library and other packages import those of this computer, because they chose
their code by `sys.platform`; `sys.platform` is "win32" in `emmc_rig` alone. Rules of Windows' file
systems hold for paths below the folder in EMMC_WINDOWS, for every library: names, open files that
can be neither removed nor renamed, line ends of text files.
"""

import builtins
import errno
import importlib
import os
import re
import signal
import socket
import sys
import types
import warnings
from pathlib import Path, PurePosixPath

POSIX_MODULES = {
    "crypt", "fcntl", "grp", "nis", "posix", "pty", "pwd", "readline", "resource", "spwd", "syslog",
    "termios", "tty",
}  # fmt: skip
POSIX_OS = re.compile(
    r"chown|chroot|confstr|ctermid|fork|forkpty|get(e?[ug]id|groups|loadavg|pgid|pgrp|priority|sid)"
    r"|set(e?[ug]id|groups|pgid|pgrp|priority|sid)|f?statvfs|fd(open)?datasync|killpg|lchown|lockf|"
    r"major|makedev|minor|mkfifo|mknod|nice|openpty|f?pathconf|pidfd_open|pipe2|posix_.*|p(read|wri"
    r"te)v?|register_at_fork|sched_.*|sendfile|sync|sysconf|tc[gs]etpgrp|ttyname|uname|wait(3|4|id)?"
    r"|W[A-Z]+|memfd_create|O_(CLOEXEC|DIRECT|DIRECTORY|NOFOLLOW|NOCTTY|NONBLOCK|D?SYNC)|set_blocki"
    r"ng"
)
POSIX_SIGNALS = re.compile(
    r"SIG(?!(INT|TERM|ABRT|FPE|ILL|SEGV|_DFL|_IGN)$)[A-Z]+\d?|alarm|pause|[gs]etitimer|pthread_.*|si"
    r"g(wait|pending|interrupt).*"
)
FORBIDDEN_NAME = re.compile(r'[<>:"|?*\\\0-\x1f]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.I)
O_BINARY = 0o100000  # Linux' O_LARGEFILE, which changes nothing
ROOT = os.path.realpath(os.environ["EMMC_WINDOWS"])
as_text = set()
"""Descriptors of files in which Windows would change line ends."""


class WindowsModule(types.ModuleType):
    """A module with some names gone and others replaced; all else is the module's own."""

    def __init__(self, module, gone, **replaced):
        super().__init__(module.__name__)
        self.__dict__.update(_module=module, _gone=gone, _replaced=replaced)

    def __getattr__(self, name):
        if name in self._replaced:
            return self._replaced[name]
        if self._gone.fullmatch(name):
            raise AttributeError(f"module {self.__name__} has no attribute {name} on Windows")
        return getattr(self._module, name)

    def __setattr__(self, name, value):
        setattr(self._module, name, value)


def windows_open(path, flags, mode=0o777):
    if os.path.isdir(path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
    descriptor = os.open(path, flags, mode)
    (as_text.discard if flags & O_BINARY else as_text.add)(descriptor)
    return descriptor


def windows_write(descriptor, data):
    if descriptor in as_text and b"\n" in bytes(data):
        raise AssertionError("Windows would write other line ends: O_BINARY is missing")
    return os.write(descriptor, data)


def windows_fsync(descriptor):
    import fcntl

    if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    os.fsync(descriptor)


def windows_rename(source, target):
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), os.fspath(target))
    os.rename(source, target)


def windows_kill(process, number):
    raise AssertionError("Windows ends the process, whatever the signal")


def windows_psutil():
    import psutil

    class Process(psutil.Process):
        def memory_info(self):
            return types.SimpleNamespace(rss=super().memory_info().rss, peak_wset=2**30)

    return WindowsModule(psutil, re.compile("RLIM.*"), Process=Process)


SIGNALS = {"SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM, "SIGBREAK": signal.SIGUSR2}
NEVER = re.compile(r"(?!)")
WINDOWS = {
    "msvcrt": lambda: types.SimpleNamespace(kbhit=lambda: False),
    "os": lambda: WindowsModule(
        os, POSIX_OS, name="nt", O_BINARY=O_BINARY, open=windows_open, write=windows_write,
        fsync=windows_fsync, rename=windows_rename, kill=windows_kill,
    ),
    "psutil": windows_psutil,
    "signal": lambda: WindowsModule(signal, POSIX_SIGNALS, Signals=SIGNALS),
    "socket": lambda: WindowsModule(socket, re.compile("AF_UNIX|SO_REUSEPORT|TCP_USER_TIMEOUT")),
    "sys": lambda: WindowsModule(sys, re.compile("abiflags"), platform="win32"),
}  # fmt: skip
made = {}
posix_import = builtins.__import__


def windows_import(name, globals=None, locals=None, fromlist=(), level=0):
    importer = (globals or {}).get("__package__") or ""
    if level == 0 and importer.split(".")[0] == "emmc_rig":
        if name in POSIX_MODULES:
            raise ModuleNotFoundError(f"Windows has no module {name!r}", name=name)
        if name in WINDOWS:
            made[name] = made.get(name) or WINDOWS[name]()
            return made[name]
    return posix_import(name, globals, locals, fromlist, level)


def check_file(event, arguments):
    """Refuse, below ROOT, what a Windows file system does not allow."""
    writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    if writes or event == "os.mkdir":
        check_name(arguments[0])
    elif event == "os.rename":
        source, target = (absolute(path, -1) for path in arguments[:2])
        check_name(target)
        check_closed(source)
        check_closed(target)
        if source.startswith(ROOT) and os.path.isdir(target):
            raise PermissionError(errno.EACCES, "a folder cannot be replaced", target)
    elif event == "os.remove":
        check_closed(absolute(*arguments))


def absolute(path, folder):
    where = os.getcwd() if folder == -1 else os.readlink(f"/proc/self/fd/{folder}")
    return os.path.normpath(os.path.join(where, os.fsdecode(path)))


def check_name(path):
    if isinstance(path, int):
        return
    path = absolute(path, -1)
    if path.startswith(ROOT + "/"):
        for part in PurePosixPath(path).relative_to(ROOT).parts:
            if FORBIDDEN_NAME.search(part):
                raise OSError(errno.EINVAL, os.strerror(errno.EINVAL), path)


def check_closed(path):
    """Raise PermissionError where this process holds the file, or one in the folder."""
    if not path.startswith(ROOT + "/"):
        return
    held = [line.partition("/")[2] for line in Path("/proc/self/maps").read_text().splitlines()]
    used = {f"/{name}" for name in held}
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            link = os.readlink(f"/proc/self/fd/{descriptor}")
        except OSError:
            continue
        if not os.path.isdir(link):
            used.add(link)
    for name in used:
        if name == path or name.startswith(path + "/"):
            raise PermissionError(errno.EACCES, f"the program uses {name}", path)


# Loaded first: they look at the computer when they are imported.
for library in ("multiprocessing.spawn", "serial", "subprocess"):
    importlib.import_module(library)
builtins.__import__ = windows_import
sys.addaudithook(check_file)
# Windows decodes files without a stated encoding by its code page.
warnings.filterwarnings("ignore", category=EncodingWarning)
warnings.filterwarnings("error", category=EncodingWarning, module=r"emmc_rig\b")

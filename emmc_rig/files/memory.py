"""Peak memory of this process, since its start or since `forget_peak`."""

from __future__ import annotations

import ctypes
import gc
import re
import resource
import sys
from pathlib import Path


def peak_memory_mib() -> float:
    """Return the peak of resident memory, in MiB.

    On Linux from /proc: there getrusage starts a new program with the peak of the one that
    started it, and would count the parent's memory as the child's.
    """
    try:
        status = Path("/proc/self/status").read_text("ascii", errors="replace")
    except OSError:
        status = ""
    if match := re.search(r"^VmHWM:\s+(\d+) kB", status, re.MULTILINE):
        return int(match[1]) / 1024
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def forget_peak() -> bool:
    """Give back what is not used, and count the peak from here on; return whether that is possible.

    Linux resets it where 5 is written to /proc/self/clear_refs, see proc_pid_clear_refs(5).
    """
    gc.collect()
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "malloc_trim"):
        library.malloc_trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5", "ascii")
    except OSError:
        return False
    return True

"""A limit of this process's memory: on Linux the kernel's RLIMIT_DATA, elsewhere a thread.

Windows cannot limit the memory of a process by a call of that kind; macOS ignores RLIMIT_DATA.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

WATCH_S = 0.02
"""Between two checks by the thread, in which a process that fills 4 GB/s takes 80 MB."""


def held_bytes() -> int:
    """Return the memory that `limit_memory` counts: on Linux data, elsewhere what is resident."""
    if sys.platform == "linux":
        import resource

        pages = int(Path("/proc/self/statm").read_text("ascii").split()[5])
        return pages * resource.getpagesize()
    import psutil

    return psutil.Process().memory_info().rss


def limit_memory(most_bytes: int, complaint: str) -> None:
    """Let this process hold no more memory.

    Beyond it, allocating raises MemoryError on Linux. Elsewhere the process ends with exit code 1,
    and the complaint on standard error.
    """
    if sys.platform == "linux":
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (most_bytes, hard))
        return

    def watch() -> None:
        while held_bytes() <= most_bytes:
            time.sleep(WATCH_S)
        print(complaint, file=sys.stderr, flush=True)
        os._exit(1)

    threading.Thread(target=watch, name="memory limit", daemon=True).start()

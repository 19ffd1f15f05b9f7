"""How long a call takes: after a first one, the median of several."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def median_s(call: Callable[[], object], repeats: int) -> float:
    """Return the median seconds of `repeats` calls, after one that warms caches and compiles."""
    call()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)

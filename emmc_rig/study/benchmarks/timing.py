"""How long a call takes, the median of several after a first one; and rows of such figures."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, cast


def median_s(call: Callable[[], object], repeats: int) -> float:
    """Return the median seconds of `repeats` calls, after one that warms caches and compiles."""
    call()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


class Figures:
    """Base of dataclasses of figures; what a property works out is a figure too."""

    def as_dict(self) -> dict[str, Any]:
        """Return the figures by name, as they are written to metrics.json."""
        derived = [name for name, one in vars(type(self)).items() if isinstance(one, property)]
        return {**asdict(cast(Any, self)), **{name: getattr(self, name) for name in derived}}

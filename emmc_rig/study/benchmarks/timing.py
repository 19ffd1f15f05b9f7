"""How long a call or a new process takes, the median of several; and rows of such figures."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
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


_MAIN = "import sys; from emmc_rig.cli import main"
STARTS = {
    "python": ("-c", "pass"),
    "import numpy": ("-c", "import numpy"),
    "import emmc_rig": ("-c", "import emmc_rig"),
    "emmc-rig --help": ("-c", f"{_MAIN}; sys.argv[1:] = ['--help']; main()"),
}


@dataclass(frozen=True)
class Start(Figures):
    """seconds: median of starting a new process, by the clock, Python's own start included."""

    name: str
    seconds: float


def start_timings(repeats: int) -> list[Start]:
    """Return the median start of each of STARTS, measured in turn so that load affects all."""
    taken: dict[str, list[float]] = {name: [] for name in STARTS}
    for _ in range(repeats):
        for name, arguments in STARTS.items():
            began = time.perf_counter()
            subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
            taken[name].append(time.perf_counter() - began)
    return [Start(name, statistics.median(seconds)) for name, seconds in taken.items()]

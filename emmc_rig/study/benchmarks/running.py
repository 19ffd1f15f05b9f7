"""One runner of every benchmark: it measures, shows lines and tables, and returns its metrics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from emmc_rig.files.cameras import find_camera
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.camera import Camera
from emmc_rig.progress import Watcher
from emmc_rig.study.sweep import sweep_folder

ONE_SHOT, CFA = "rgbw-bayer-1shot", "scenario-ii-cfa"


class Show(Watcher, Protocol):
    """Where a benchmark shows what it measures, beside its progress."""

    def line(self, text: str) -> None:
        """Print a result in words."""

    def note(self, label: str, text: object) -> None:
        """Print what is missing, apart from the results."""

    def table(self, heads: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
        """Print a table."""


@dataclass(frozen=True)
class Asked:
    """What to measure; None and empty take the benchmark's own. camera: the name of `described`.

    targets_db: PSNRs at which a session may stop.
    """

    camera: str
    described: Camera
    scenes: Sequence[str] = ()
    size: tuple[int, int] | None = None
    repeats: int | None = None
    seed: int = 0
    dictionary: str | None = None
    targets_db: Sequence[float] = ()


Measure = Callable[[Asked, Show, Path], dict[str, Any]]
"""A module's `benchmark`: measures into a folder, returns what metrics.json says."""


@dataclass(frozen=True)
class Benchmark:
    """A module of the study with a `benchmark`. journal: of rows that the folder keeps, if any."""

    module: str
    camera: str = ONE_SHOT
    journal: str = ""


BENCHMARKS = {
    "kernels": Benchmark("benchmarks.kernels"),
    "solvers": Benchmark("benchmarks.sparse"),
    "peers": Benchmark("benchmarks.variational"),
    "live": Benchmark("benchmarks.live"),
    "pages": Benchmark("benchmarks.pages"),
    "guard": Benchmark("guard", CFA),
    "stated": Benchmark("stated", CFA),
    "ablation": Benchmark("ablation", journal="ablation.jsonl"),
    "constants": Benchmark("constants", journal="constants.jsonl"),
    "trends": Benchmark("trends", CFA, "trends.jsonl"),
    "next-shot": Benchmark("next_shot", journal="next_shots.jsonl"),
}


def run_benchmark(
    name: str, out: Path, show: Show, camera: str | None = None, **asked: Any
) -> dict[str, Any]:
    """Measure, write metrics.json, and return it; asked: fields of `Asked`.

    Raises what folders, cameras, scenes and methods do; rows of a journal are kept in each case.
    """
    one, command = BENCHMARKS[name], f"chart --{name}"
    camera = camera or one.camera
    wanted = Asked(camera, find_camera(camera), **asked)
    measure: Measure = import_module(f"emmc_rig.study.{one.module}").benchmark
    show.begin(name, None)
    if one.journal:
        with sweep_folder(out, one.journal, command) as folder:
            metrics = measure(wanted, show, folder)
            with result_folder(folder, command, adds=True) as new:
                write_metrics(new, metrics)
    else:
        with result_folder(out, command) as folder:
            metrics = measure(wanted, show, folder)
            write_metrics(folder, metrics)
    return metrics

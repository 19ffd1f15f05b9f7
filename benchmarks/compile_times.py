"""The first run compiles few kernels, none twice, all in little time: what Numba compiles for it.

A row for each kernel of the program: by how many signatures it was compiled, and the CPU seconds of
that, of the whole and without what it calls; none for a kernel that the demo does not call. What is
Numba's own (array constructors, reductions) is one row. All is compiled anew, by one process.
"""

from __future__ import annotations

import ast
import os
import re
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PACKAGES = ("emmc_rig", "drivers", "calibration", "reconstruction", "simulators")
COMPILED = re.compile(r"(numba\.)?njit|row_kernel|_kernel\b|_helper\b")
NUMBAS = "(numba)"


@dataclass
class Cost:
    """Of a kernel: its signatures, CPU seconds with and without what it calls."""

    signatures: set[str] = field(default_factory=set)
    seconds: float = 0.0
    own_seconds: float = 0.0


def compiled_by_demo(camera: str, size: tuple[int, int], method: str) -> dict[str, Cost]:
    """Return what a demo of this method compiles, by `module.kernel`."""
    from numba.core import event

    costs: dict[str, Cost] = defaultdict(Cost)
    open_ones: list[tuple[float, list[float]]] = []

    class Timer(event.Listener):
        """Numba compiles in one thread at a time, and what a kernel calls within the kernel."""

        def on_start(self, event: event.Event) -> None:
            open_ones.append((time.thread_time(), []))

        def on_end(self, event: event.Event) -> None:
            started, inner = open_ones.pop()
            seconds = time.thread_time() - started
            details: Any = event.data
            function = details["dispatcher"].py_func
            name = f"{function.__module__}.{function.__qualname__}"
            cost = costs[NUMBAS if name.startswith("numba.") else name]
            cost.signatures.add(f"{name}{details['args']}")
            cost.own_seconds += seconds - sum(inner)
            if open_ones:
                open_ones[-1][1].append(seconds)
            else:
                cost.seconds += seconds

    with event.install_listener("numba:compile", Timer()), tempfile.TemporaryDirectory() as folder:
        from emmc_rig.demo import DemoSettings, run_demo
        from emmc_rig.files.cameras import find_camera
        from reconstruction.adaptive.settings import AdaptiveSettings
        from reconstruction.methods import MethodSettings

        solver = MethodSettings(adaptive=AdaptiveSettings(patches=None))
        settings = DemoSettings(
            "deep-occlusions", camera, find_camera(camera), size, method=method, solver=solver
        )
        run_demo(settings, Path(folder))
    return costs


def kernels() -> list[str]:
    """Return every function of the program that is compiled, as `module.kernel`."""
    names = []
    for package in PACKAGES:
        for file in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            names += [
                f"{module}.{node.name}"
                for node in ast.walk(ast.parse(file.read_text("utf-8")))
                if isinstance(node, ast.FunctionDef)
                and any(COMPILED.match(ast.unparse(one)) for one in node.decorator_list)
            ]
    return names


def main() -> None:
    """Compile, and show what took longest."""
    with tempfile.TemporaryDirectory() as empty:
        os.environ["NUMBA_CACHE_DIR"] = empty  # before Numba is imported
        import lab
        import pandas as pd

        parser = lab.arguments(__doc__, camera="rgbw-bayer-3shots", size="96x128")
        parser.add_argument("--method", default="adaptive")
        args = lab.parsed(parser)
        costs = compiled_by_demo(args.camera, args.size, "tv" if args.smallest else args.method)
        names = dict.fromkeys([*kernels(), *costs])
        table = [
            (name, len(cost.signatures), cost.seconds, cost.own_seconds)
            for name in names
            for cost in [costs.get(name, Cost())]
        ]
    rows = pd.DataFrame(table, columns=["kernel", "signatures", "seconds", "own_seconds"])
    rows = rows.sort_values("own_seconds", ascending=False, ignore_index=True)
    rows.to_csv(args.out / "compile_times.csv", index=False, float_format="%.3f")
    longest = rows[rows.own_seconds > 0].head(25).set_index("kernel").own_seconds
    lab.finished(rows, longest.plot.barh(xlabel="CPU s"), "compile_times", args)
    print(f"{rows.own_seconds.sum():.1f} CPU s for {(rows.signatures > 0).sum()} kernels")


if __name__ == "__main__":
    main()

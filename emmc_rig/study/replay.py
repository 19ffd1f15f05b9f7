"""Replay measured blocks through Dask's own scheduler, with workers that sleep.

What a cluster of so many workers would take is not known from one machine; what its scheduler
costs is. The tasks are as many and as large as those of a capture's blocks, and the scheduler, its
workers and their messages are Dask's, in one process. Computing is sleeping, `speed_up` times
shorter. What the replay takes beyond the best schedule of the sleeps is the scheduler's, in its own
seconds: it has more to do at a time than with tasks of full length, so that it is an upper bound.

    python -m emmc_rig.study.replay RESULT/metrics.json --blocks 352 --captures 4
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from emmc_rig.reconstruct.pool import Cluster

WORKERS = (4, 8, 16, 32, 64)
TASK_BYTES = 5_000
"""Of a pickled task, see tests/test_cluster.py."""


@dataclass(frozen=True)
class Replayed:
    """workers, tasks: how many. ideal_s: tasks' sum over workers; best_s: where each worker takes
    the next task at once; took_s: that, and what the scheduler was measured to need beyond."""

    workers: int
    tasks: int
    ideal_s: float
    best_s: float
    took_s: float

    @property
    def efficiency(self) -> float:
        """Share of the workers' time that is computing."""
        return self.ideal_s / self.took_s

    @property
    def scheduler_share(self) -> float:
        """Share of the time beyond that of the best schedule."""
        return max(1 - self.best_s / self.took_s, 0.0)


def drawn_seconds(measured: Sequence[float], tasks: int, seed: int = 0) -> list[float]:
    """Return the seconds of so many tasks, drawn from those measured."""
    return np.random.default_rng(seed).choice(np.asarray(measured), tasks).tolist()


def greedy_s(seconds: Sequence[float], workers: int) -> float:
    """Return how long workers take that take the next task as soon as they are free."""
    free = np.zeros(workers)
    for one in seconds:
        free[free.argmin()] += one
    return float(free.max())


def _sleep(task: tuple[float, bytes]) -> float:
    time.sleep(task[0])
    return task[0]


def replayed(seconds: Sequence[float], workers: int, speed_up: float) -> Replayed:
    """Return how long a cluster of so many workers takes for tasks of these seconds."""
    from distributed import Client, LocalCluster

    rng = np.random.default_rng(0)
    tasks = [(one / speed_up, rng.bytes(TASK_BYTES)) for one in seconds]
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=False, dashboard_address=""
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        pool = Cluster(client, "of sleeping workers")
        list(pool.run(_sleep, [(0.0, b"")] * workers))
        started = time.perf_counter()
        done = sum(1 for _ in pool.run(_sleep, tasks))
        took = time.perf_counter() - started
    assert done == len(tasks)
    ideal, best = sum(seconds) / workers, greedy_s(seconds, workers)
    return Replayed(workers, done, ideal, best, best + max(took - best / speed_up, 0))


def main(
    metrics: Annotated[Path, typer.Argument(help="metrics.json of a reconstruction in blocks")],
    blocks: Annotated[int, typer.Option(help="of a capture")] = 352,
    captures: Annotated[int, typer.Option(help="in one call")] = 1,
    workers: Annotated[list[int] | None, typer.Option(help="how many; may repeat")] = None,
    seconds: Annotated[float, typer.Option(help="that the shortest replay takes")] = 4.0,
) -> None:
    """Print efficiency and the scheduler's share on 4 to 64 workers that sleep."""
    measured = json.loads(metrics.read_text())["block_seconds"]
    each = drawn_seconds(measured, blocks * captures)
    for count in workers or WORKERS:
        found = replayed(each, count, sum(each) / max(WORKERS) / seconds)
        typer.echo(
            f"{count} workers: {found.tasks} blocks of {np.mean(each):.0f} s in "
            f"{found.took_s / 3600:.2f} h, efficiency {found.efficiency:.3f}, scheduler "
            f"{found.scheduler_share:.1%}"
        )


if __name__ == "__main__":
    typer.run(main)

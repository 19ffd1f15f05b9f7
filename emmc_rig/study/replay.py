"""Replay measured blocks through Dask's own scheduler, with workers that sleep.

The tasks take as long (`speed_up` times less) and are as large as a capture's blocks were measured
to be. Scheduler, client, workers and messages are Dask's, all in one process. The CPU seconds that
they spend beyond idling are what the scheduler is reckoned to cost: they do not depend on what else
the machine does. They are counted in full, not `speed_up` times, and as if no worker computed
meanwhile: an upper bound.

    python -m emmc_rig.study.replay RESULT/metrics.json --blocks 352
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import typer

from emmc_rig.model.json_text import parse_json
from emmc_rig.processing.pool import Cluster

Result = TypeVar("Result")
WORKERS = (4, 16, 64)
IDLE_S = 1.0


@dataclass(frozen=True)
class Replayed:
    """computed_s: seconds of all tasks. best_s: until the last is done where a worker that is free
    takes the next at once. scheduler_s: CPU of Dask. replay_s: what the replay took."""

    workers: int
    tasks: int
    computed_s: float
    best_s: float
    scheduler_s: float
    replay_s: float

    @property
    def total_s(self) -> float:
        """Until the last task is done."""
        return self.best_s + self.scheduler_s

    @property
    def efficiency(self) -> float:
        """Share of the workers' time that is computing; the rest is the two below."""
        return self.computed_s / self.workers / self.total_s

    @property
    def idle_share(self) -> float:
        """Share of the workers' time in which the last tasks leave some without any."""
        return (self.best_s - self.computed_s / self.workers) / self.total_s

    @property
    def scheduler_share(self) -> float:
        """Share of the workers' time that goes to the scheduler."""
        return self.scheduler_s / self.total_s


def drawn_seconds(measured: Sequence[float], tasks: int, seed: int = 0) -> list[float]:
    """Return the seconds of so many tasks, drawn from those measured."""
    return np.random.default_rng(seed).choice(np.asarray(measured), tasks).tolist()


def best_schedule_s(seconds: Sequence[float], workers: int) -> float:
    """Return how long workers take that take the next task as soon as they are free."""
    free = np.zeros(workers)
    for one in seconds:
        free[free.argmin()] += one
    return float(free.max())


def _spent(what: Callable[[], Result]) -> tuple[float, float, Result]:
    """Return what a call takes, seconds by the clock and of the processor, and what it returns."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = what()
    return time.perf_counter() - wall, time.process_time() - cpu, result


def _sleep(task: tuple[float, bytes]) -> None:
    time.sleep(task[0])


def replayed(seconds: Sequence[float], task_bytes: int, workers: int, speed_up: float) -> Replayed:
    """Return what so many workers take for tasks of these seconds and of so many bytes each."""
    from distributed import Client, LocalCluster

    rng = np.random.default_rng(0)
    tasks = [(one / speed_up, rng.bytes(task_bytes)) for one in seconds]
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=False, dashboard_address=""
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        pool = Cluster(client, "of sleeping workers")
        for _ in pool.run(_sleep, [(0.0, b"")] * workers):
            pass
        idle_s, idle_cpu_s, _ = _spent(lambda: time.sleep(IDLE_S))
        wall_s, cpu_s, done = _spent(lambda: sum(1 for _ in pool.run(_sleep, tasks)))
    scheduler_s = max(cpu_s - idle_cpu_s / idle_s * wall_s, 0)
    best = best_schedule_s(seconds, workers)
    return Replayed(workers, done, sum(seconds), best, scheduler_s, wall_s)


def main(
    metrics: Annotated[Path, typer.Argument(help="metrics.json of a reconstruction in blocks")],
    blocks: Annotated[int, typer.Option(help="of all captures", min=1)] = 352,
    workers: Annotated[list[int] | None, typer.Option(help="how many; may repeat")] = None,
    seconds: Annotated[float, typer.Option(help="that each replay sleeps at least", min=0.1)] = 4.0,
) -> None:
    """Print what 4, 16 and 64 workers would take, and what of it is Dask's scheduler."""
    found = parse_json(metrics.read_bytes(), str(metrics), typer.BadParameter)
    if "block_cpu_seconds" not in found:
        typer.echo(f"{metrics}: states no blocks; reconstruct with --workers", err=True)
        raise typer.Exit(1)
    each = drawn_seconds(found["block_cpu_seconds"], blocks)
    typer.echo(
        f"{blocks} blocks of {np.mean(each):.1f} s (from {min(each):.1f} to {max(each):.1f}), "
        f"{found['task_bytes']} bytes each"
    )
    for count in workers or WORKERS:
        speed_up = max(best_schedule_s(each, count) / seconds, 1.0)
        one = replayed(each, found["task_bytes"], count, speed_up)
        typer.echo(
            f"{count} workers: {one.total_s / 60:.1f} min, efficiency {one.efficiency:.3f}; idle "
            f"at the end {one.idle_share:.3f}, scheduler {one.scheduler_share:.3f} "
            f"({1000 * one.scheduler_s / one.tasks:.1f} ms a block); replay {one.replay_s:.0f} s"
        )


if __name__ == "__main__":
    typer.run(main)

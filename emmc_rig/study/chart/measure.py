"""A process that measures points one at a time: PSNR, seconds and memory of a reconstruction.

Order matters: frames, dictionary, a warm-up on a small window (which compiles and loads), the timed
runs, the peak of memory; only then the light field is compared with the truth.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import statistics
import time
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from calibration.errors import CalibrationError
from drivers.errors import DriverError
from emmc_rig.errors import AppError
from emmc_rig.model.errors import ModelError
from emmc_rig.processing.memory import forget_peak, peak_memory_mib
from emmc_rig.study.chart.chart_points import Point
from emmc_rig.study.pictured import save_pair
from emmc_rig.study.rows import available_cores, plain
from emmc_rig.study.scores import scored
from emmc_rig.study.trial import Trial, trial_of
from reconstruction.errors import ReconstructionError

WARM_UP_PX = 27
"""Side of the window of the warm-up: large enough for patches, small enough to take no time."""
EXPECTED_ERRORS = (AppError, ModelError, ReconstructionError, CalibrationError, DriverError)


@dataclass(frozen=True)
class Job:
    """A point to measure. picture, truth_picture: thumbnails to write.

    dictionary: see `open_dictionary`. repeats: timed runs at most, until `enough_s` are spent.
    """

    point: Point
    picture: Path
    truth_picture: Path
    dictionary: str | None
    repeats: int
    enough_s: float


def measured(job: Job) -> dict:
    """Return the figures of a job, as plain data.

    seconds: median of the repeats. cpu_seconds: likewise, of all cores together. peak_mib: memory
    that the timed runs take at most, beyond the process with Psi, frames and dictionary.
    """
    trial, method = trial_of(job.point.capture), job.point.configuration.method
    settings = job.point.configuration.settings
    trial.dictionary(method, job.dictionary)
    _window(trial).solved(method, settings, job.dictionary)
    load = os.getloadavg()[0]
    forget_peak()
    held_mib = peak_memory_mib()
    wall, cpu, result = [], [], None
    while len(wall) < job.repeats and (not wall or sum(wall) < job.enough_s):
        result = None
        cpu_started, started = time.process_time(), time.perf_counter()
        result = trial.solved(method, settings, job.dictionary)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - cpu_started)
    assert result is not None
    peak_mib = peak_memory_mib() - held_mib
    scores = scored(
        result.light_field, trial.truth, trial.disparity_px, result.maps.get("disparity")
    )
    save_pair(job.picture, job.truth_picture, result.light_field, trial.truth)
    return plain(
        {
            **asdict(scores),
            "seconds": statistics.median(wall),
            "fastest_s": min(wall),
            "slowest_s": max(wall),
            "cpu_seconds": statistics.median(cpu),
            "repeats": len(wall),
            "peak_mib": peak_mib,
            "cores": available_cores(),
            "load": load,
            "steps": result.steps,
            "status": result.status,
            "advice": result.advice,
            "shots": trial.psi.shots,
            "views": "x".join(map(str, trial.psi.light_field_shape[:2])),
            "rows": trial.psi.size[0],
            "columns": trial.psi.size[1],
        }
    )


def _window(trial: Trial) -> Trial:
    """Return a corner of a trial; it has no truth."""
    k = trial.psi.binning
    side = WARM_UP_PX // k * k
    rows, columns = (slice(0, min(side, length)) for length in trial.psi.size)
    seen = (slice(None), slice(0, rows.stop // k), slice(0, columns.stop // k))
    return replace(
        trial,
        psi=trial.psi.window(rows, columns),
        readings=trial.readings[seen].copy(),
        usable=trial.usable[seen].copy(),
    )


def _serve(jobs: Connection) -> None:
    """Answer jobs until the other end is closed; the program that started this hears Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            job = jobs.recv()
        except EOFError:
            return
        try:
            result = measured(job)
        except EXPECTED_ERRORS as fault:
            result = {"failed": str(fault), "keep": False}
        except MemoryError:
            result = {"failed": "not enough memory", "keep": False}
        jobs.send(result)


class Worker:
    """A process that measures jobs; a context, whose end is the process's.

    limit_s: after which a job is given up.
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._started: tuple[BaseProcess, Connection] | None = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def measure(self, job: Job) -> dict:
        """Return the figures of a job; `failed` says why there are none.

        A result that may differ the next time has `keep` False.
        """
        process, jobs = self._started = self._started or self._start()
        try:
            jobs.send(job)
            if jobs.poll(self.limit_s):
                return jobs.recv()
        except (EOFError, ConnectionError):
            process.join()
            self._end()
            ended = f"ended with code {process.exitcode}"
            return {"failed": f"the measuring process {ended}: too little memory?", "keep": False}
        self._end()
        return {"failed": f"not done after {self.limit_s:.0f} s"}

    @staticmethod
    def _start() -> tuple[BaseProcess, Connection]:
        context = multiprocessing.get_context("spawn")
        mine, its = context.Pipe()
        process = context.Process(target=_serve, args=(its,), daemon=True)
        process.start()
        its.close()
        return process, mine

    def _end(self) -> None:
        if self._started is not None:
            process, jobs = self._started
            self._started = None
            process.kill()
            process.join()
            jobs.close()

"""The points of a chart, measured one at a time, each configuration in a process of its own.

A lock lets only one such process run on this machine at a time. It is the kernel's (flock), so that
it ends with the processes that hold it; its file names who does.
"""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

from emmc_rig.errors import AppError
from emmc_rig.files.memory import forget_peak
from emmc_rig.model.json_text import parse_json
from emmc_rig.progress import Watcher
from emmc_rig.study.chart.captures import kept_capture
from emmc_rig.study.chart.points import Point
from emmc_rig.study.sweep import Results, Sweep, available_cores, dictionary_identity, machine
from emmc_rig.study.trial import Capture

NAME = "emmc-rig-timing.lock"


def lock_path() -> Path:
    """Return the machine's lock file."""
    return Path(tempfile.gettempdir()) / NAME


@contextmanager
def timing_lock(
    purpose: str,
    path: Path | None = None,
    on_wait: Callable[[str], None] | None = None,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[int]:
    """Hold the lock while the block runs; yield its descriptor, for a child to hold as well.

    purpose: what is timed, in words, for those who wait. on_wait: called once, with who holds it.
    """
    path = path or lock_path()
    descriptor = _opened(path)
    try:
        announced = False
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if on_wait is not None and not announced:
                    on_wait(holder(path))
                announced = True
                sleep(0.2)
        _write(descriptor, f"process {os.getpid()}, {purpose}")
        yield descriptor
        # Emptied, not removed: another may already wait for this very file.
        _write(descriptor, "")
    finally:
        os.close(descriptor)


def holder(path: Path | None = None) -> str:
    """Return who holds the lock, in words."""
    try:
        return (path or lock_path()).read_text("utf-8", errors="replace").strip() or "somebody"
    except OSError:
        return "somebody"


def _opened(path: Path) -> int:
    """Open the file, to read only where it is another user's; flock takes either."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except PermissionError:
        return os.open(path, os.O_RDONLY)


def _write(descriptor: int, text: str) -> None:
    try:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, text.encode(), 0)
    except OSError:
        return


MODULE = "emmc_rig.study.chart.measure"


@contextmanager
def working(environment: Mapping[str, str], limit_s: float, lock: int) -> Iterator[Worker]:
    """Yield a worker, which ends with the block."""
    with TemporaryFile("w+") as errors:
        worker = Worker(environment, limit_s, lock, errors, forget_peak())
        try:
            yield worker
        finally:
            worker.end()


@dataclass
class Worker:
    """Measures jobs.

    environment: added to this process's. limit_s: after which a job is given up. lock: a
    descriptor that the process holds as well, should this one be killed. errors: gets its messages.
    lasting: whether it measures more than one.
    """

    environment: Mapping[str, str]
    limit_s: float
    lock: int
    errors: IO[str]
    lasting: bool
    _process: subprocess.Popen[str] | None = None

    def measure(self, job: dict) -> dict:
        """Return the figures of a job; `failed` says why there are none.

        A result that may differ the next time has `keep` False. Raises AppError for a process
        that failed by itself.
        """
        process = self._process = self._process or self._started()
        assert process.stdin is not None
        assert process.stdout is not None
        late = threading.Event()

        def give_up() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(self.limit_s, give_up)
        timer.start()
        try:
            print(json.dumps(job), file=process.stdin, flush=True)
            line = process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            timer.cancel()
        if line:
            if not self.lasting:
                self.end()
            return parse_json(line, "the measuring process", AppError)
        code = process.wait()
        self.end()
        if late.is_set():
            return {"failed": f"not done after {self.limit_s:.0f} s"}
        if code < 0:
            return {"failed": f"killed by signal {-code}: memory?", "keep": False}
        self.errors.seek(0)
        lines = self.errors.read().strip().splitlines() or ["no message"]
        raise AppError(f"{job['method']}: the measuring process failed: {lines[-1]}")

    def _started(self) -> subprocess.Popen[str]:
        """Return a new process, which Ctrl-C reaches through us only."""
        return subprocess.Popen(
            [sys.executable, "-m", MODULE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
            text=True,
            env={**os.environ, **self.environment},
            pass_fds=(self.lock,),
            start_new_session=True,
        )

    def end(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


CAPTURES, PICTURES = "captures", "pictures"
THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass
class ChartSweep(Sweep[Point]):
    """The points of a chart; settings: ChartSettings."""

    _captures: dict[Capture, tuple[Path, str]] = field(default_factory=dict, init=False)
    revision = 2

    def capture(self, capture: Capture) -> tuple[Path, str]:
        """Return the file of a capture and its digest; made where missing."""
        if capture not in self._captures:
            folder = self.folder / CAPTURES
            self._captures[capture] = kept_capture(capture, folder)
        return self._captures[capture]

    def picture(self, point: Point) -> Path:
        """Return where the picture of a point is kept."""
        return (
            self.folder / PICTURES / f"{self.capture(point.capture)[1]}-{self.digest(point)}.webp"
        )

    def truth_picture(self, capture: Capture) -> Path:
        """Return where the picture of a capture's truth is kept."""
        return self.folder / PICTURES / f"{self.capture(capture)[1]}-truth.webp"

    def make_frames(self, points: Sequence[Point], watcher: Watcher) -> None:
        """Make the frames of all points, so that wrong input is reported before hours are spent.

        Raises what the layers below do.
        """
        captures = dict.fromkeys(point.capture for point in points)
        watcher.begin("make the frames", len(captures))
        for capture in captures:
            self.capture(capture)
            watcher.step(f"{capture.scene_name}, {capture.camera_name}")

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        one, settings = point.configuration, self.settings
        dictionary = dictionary_identity(settings.dictionary) if one.needs_dictionary else None
        return {
            "machine": machine(),
            "capture": self.capture(point.capture)[1],
            "method": one.method,
            "settings": one.settings.model_dump(mode="json"),
            "dictionary": dictionary,
            "cores": point.cores or available_cores(),
            "repeats": settings.repeats,
            "enough_s": settings.enough_s,
            "limit_s": settings.limit_s,
        }

    def is_whole(self, point: Point, result: dict) -> bool:
        """Return whether a point that has figures has its picture."""
        return "failed" in result or self.picture(point).is_file()

    def group(self, point: Point) -> Hashable:
        """Return what one process measures: a configuration on a number of cores."""
        return point.configuration, point.cores

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the points' figures from one process, while nothing else is timed."""

        def wait(who: str) -> None:
            watcher.begin(f"{self.stage} (after {who})", len(points))

        (self.folder / PICTURES).mkdir(exist_ok=True)
        cores = str(points[0].cores or available_cores())
        environment: dict[str, str] = dict.fromkeys(THREADS, cores)
        with (
            timing_lock(f"emmc-rig chart in {self.folder}", on_wait=wait) as lock,
            working(environment, self.settings.limit_s, lock) as worker,
        ):
            for point in points:
                path = self.capture(point.capture)[0]
                yield self._measured(point, path, self.picture(point), worker)

    def _measured(self, point: Point, capture: Path, picture: Path, worker: Worker) -> dict:
        job = {
            "capture": str(capture),
            "picture": str(picture),
            "method": point.configuration.method,
            "settings": point.configuration.settings.model_dump(mode="json"),
            "needs_dictionary": point.configuration.needs_dictionary,
            "dictionary": self.settings.dictionary,
            "repeats": self.settings.repeats,
            "enough_s": self.settings.enough_s,
        }
        return worker.measure(job)

    def words(self, point: Point, result: dict) -> str:
        """Return a measured point in words."""
        took = f" (in {result['seconds']:.2f} s)" if "seconds" in result else ""
        return super().words(point, result) + took

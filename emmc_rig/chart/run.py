"""Measure the points of a chart, each kept as it is done, and go on where a run stopped.

One at a time: every point runs in a fresh process, under the machine's timing lock.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from emmc_rig import __version__
from emmc_rig.chart.captures import Capture, kept_capture
from emmc_rig.chart.lock import timing_lock
from emmc_rig.chart.measure import FAILED
from emmc_rig.chart.plan import ChartSettings, Point
from emmc_rig.demo import Watcher
from emmc_rig.errors import AppError
from emmc_rig.journal import Journal, digest_of

POINTS, CAPTURES, PICTURES = "points.jsonl", "captures", "pictures"
REVISION = 1
"""Of what a point's figures are; raised with them, so that older points are measured again."""
STAGE = "measure the points"
THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class ChartStopped(KeyboardInterrupt):
    """Ctrl-C; the points done are kept."""


@dataclass
class ChartRun:
    """What to measure, and where. results: by point; a result with `failed` says why there is none.

    pictures: by point, files; those of the truth are called after their capture.
    """

    settings: ChartSettings
    folder: Path
    results: dict[Point, dict] = field(default_factory=dict)
    pictures: dict[Point, Path] = field(default_factory=dict)
    _captures: dict[Capture, tuple[Path, str]] = field(default_factory=dict)

    def capture(self, capture: Capture) -> tuple[Path, str]:
        """Return the file of a capture and its digest; made where missing."""
        if capture not in self._captures:
            folder = self.folder / CAPTURES
            self._captures[capture] = kept_capture(capture, self.settings.seed, folder)
        return self._captures[capture]

    def truth_picture(self, capture: Capture) -> Path:
        """Return where the picture of a capture's truth is kept."""
        return self.folder / PICTURES / f"{self.capture(capture)[1]}-truth.webp"

    def prepare(self, points: Sequence[Point], watcher: Watcher) -> None:
        """Make the frames of all points, so that wrong input is told before hours are spent.

        Raises what the layers below do.
        """
        captures = dict.fromkeys(point.capture for point in points)
        watcher.begin("make the frames", len(captures))
        for capture in captures:
            self.capture(capture)
            watcher.step(f"{capture.scene_name}, {capture.camera_name}")

    def measure_all(self, points: Sequence[Point], watcher: Watcher) -> None:
        """Measure every point that the folder does not hold, and fill `results`.

        Raises ChartStopped at Ctrl-C and AppError when the folder cannot be written; what is done
        is kept in each case.
        """
        points = list(dict.fromkeys(points))
        journal = Journal(self.folder / POINTS)
        (self.folder / PICTURES).mkdir(exist_ok=True)
        try:
            self._measure(points, journal, watcher)
        except KeyboardInterrupt as stop:
            raise ChartStopped(
                f"stopped by Ctrl-C; {len(self.results)} of {len(points)} points are kept in "
                f"{self.folder}: run the same command again to go on"
            ) from stop
        except OSError as fault:
            raise AppError(
                f"--out {self.folder}: cannot be written ({fault.strerror or fault}); the points "
                "done are kept: make room and run the same command again to go on"
            ) from fault

    def _measure(self, points: Sequence[Point], journal: Journal, watcher: Watcher) -> None:
        watcher.begin(STAGE, len(points))
        for done, point in enumerate(points):

            def wait(who: str, left: int = len(points) - done) -> None:
                watcher.begin(f"{STAGE} (after {who})", left)

            path, capture_digest = self.capture(point.capture)
            inputs = self._inputs(point, capture_digest)
            digest = digest_of(inputs)
            picture = self.folder / PICTURES / f"{capture_digest}-{digest}.webp"
            result = journal.get(digest)
            if result is None or ("failed" not in result and not picture.is_file()):
                result = self._measured(point, path, picture, wait)
                if result.get("keep", True):
                    journal.add(digest, inputs, result)
            self.results[point] = result
            self.pictures[point] = picture
            watcher.step(told(point, result))

    def _inputs(self, point: Point, capture: str) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        one, settings = point.configuration, self.settings
        return {
            "version": __version__,
            "revision": REVISION,
            "machine": machine(),
            "capture": capture,
            "method": one.method,
            "settings": one.settings.model_dump(mode="json"),
            "dictionary": dictionary_identity(settings.dictionary)
            if one.needs_dictionary
            else None,
            "cores": point.cores or available_cores(),
            "repeats": settings.repeats,
            "enough_s": settings.enough_s,
            "limit_s": settings.limit_s,
        }

    def _measured(
        self, point: Point, capture: Path, picture: Path, on_wait: Callable[[str], None]
    ) -> dict:
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
        cores = str(point.cores or available_cores())
        purpose = f"emmc-rig chart in {self.folder}"
        with timing_lock(purpose, on_wait=on_wait) as lock:
            return run_job(job, dict.fromkeys(THREADS, cores), self.settings.limit_s, lock)


def run_job(job: dict, environment: dict[str, str], limit_s: float, lock: int) -> dict:
    """Return the figures of a job done by a fresh process; `failed` says why there are none.

    lock: a descriptor that the process holds as well, should this one be killed. A result that
    may differ the next time has `keep` False.
    """
    command = [sys.executable, "-m", "emmc_rig.chart.measure"]
    with _process(command, environment, lock) as process:
        try:
            out, err = process.communicate(json.dumps(job), timeout=limit_s)
        except subprocess.TimeoutExpired:
            return {"failed": f"not done after {limit_s:.0f} s"}
    if process.returncode == 0:
        return json.loads(out.strip().splitlines()[-1])
    if process.returncode == FAILED:
        return {"failed": err.strip().splitlines()[-1], "keep": False}
    if process.returncode < 0:
        return {"failed": f"killed by signal {-process.returncode}: memory?", "keep": False}
    lines = err.strip().splitlines() or ["no message"]
    raise AppError(f"{job['method']}: the measuring process failed: {lines[-1]}")


@contextmanager
def _process(
    command: list[str], environment: dict[str, str], lock: int
) -> Iterator[subprocess.Popen[str]]:
    """Yield a process that Ctrl-C reaches through us only; kill it at the end."""
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
        pass_fds=(lock,),
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def told(point: Point, result: dict) -> str:
    """Return a measured point in words."""
    if "failed" in result:
        return f"{point.label}: {result['failed']}"
    return f"{result['psnr_db']:.2f} dB in {result['seconds']:.2f} s, {point.label}"


def available_cores() -> int:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine() -> str:
    """Return the processor's name and the number of cores."""
    name = platform.processor() or platform.machine()
    try:
        cpu = Path("/proc/cpuinfo").read_text("utf-8", errors="replace")
    except OSError:
        cpu = ""
    if found := re.search(r"^model name\s*:\s*(.+)$", cpu, re.MULTILINE):
        name = found[1].strip()
    return f"{name}, {available_cores()} cores"


def dictionary_identity(dictionary: str | None) -> str:
    """Return what tells a dictionary from another: its name, and of a file its size and time."""
    if dictionary is None or not Path(dictionary).is_file():
        return dictionary or "lambertian"
    seen = Path(dictionary).stat()
    return f"{dictionary} {seen.st_size} {seen.st_mtime_ns}"

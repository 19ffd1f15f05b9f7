"""Measure the points of a chart, each kept as it is done, and go on where a run stopped.

One at a time, under the machine's timing lock; the points of a configuration share a process.
"""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from emmc_rig.progress import Watcher
from emmc_rig.study.chart.captures import Capture, kept_capture
from emmc_rig.study.chart.lock import timing_lock
from emmc_rig.study.chart.plan import ChartSettings, Point
from emmc_rig.study.chart.worker import Worker, working
from emmc_rig.study.points import Journal, digest_of, kept_when_stopped
from emmc_rig.version import __version__

POINTS, CAPTURES, PICTURES = "points.jsonl", "captures", "pictures"
REVISION = 2
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

        def kept() -> str:
            return f"{len(self.results)} of {len(points)} points are"

        with kept_when_stopped(self.folder, self.folder, ChartStopped, kept):
            self._measure(points, journal, watcher)
        self.results = {point: self.results[point] for point in points}

    def _measure(self, points: Sequence[Point], journal: Journal, watcher: Watcher) -> None:
        watcher.begin(STAGE, len(points))
        for group in alike(points):

            def wait(who: str, left: int = len(points) - len(self.results)) -> None:
                watcher.begin(f"{STAGE} (after {who})", left)

            with ExitStack() as open_worker:
                worker = None
                for point in group:
                    path, capture_digest = self.capture(point.capture)
                    inputs = self._inputs(point, capture_digest)
                    digest = digest_of(inputs)
                    picture = self.folder / PICTURES / f"{capture_digest}-{digest}.webp"
                    result = journal.get(digest)
                    if result is None or ("failed" not in result and not picture.is_file()):
                        worker = worker or open_worker.enter_context(self._worker(point, wait))
                        result = self._measured(point, path, picture, worker)
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

    @contextmanager
    def _worker(self, point: Point, on_wait: Callable[[str], None]) -> Iterator[Worker]:
        """Yield what measures a point, and others alike, while nothing else is timed."""
        cores = str(point.cores or available_cores())
        with (
            timing_lock(f"emmc-rig chart in {self.folder}", on_wait=on_wait) as lock,
            working(dict.fromkeys(THREADS, cores), self.settings.limit_s, lock) as worker,
        ):
            yield worker

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


def alike(points: Sequence[Point]) -> list[list[Point]]:
    """Return the points of each configuration on so many cores together."""
    groups: dict[object, list[Point]] = {}
    for point in points:
        groups.setdefault((point.configuration, point.cores), []).append(point)
    return list(groups.values())


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

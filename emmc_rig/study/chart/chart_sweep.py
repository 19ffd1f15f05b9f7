"""The points of a chart, measured one at a time under the machine's timing lock.

Those of a configuration share a process.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from emmc_rig.progress import Watcher
from emmc_rig.study.chart.captures import Capture, kept_capture
from emmc_rig.study.chart.lock import timing_lock
from emmc_rig.study.chart.points import Point
from emmc_rig.study.chart.worker import Worker, working
from emmc_rig.study.sweep import Results, Sweep, available_cores, dictionary_identity, machine

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
            self._captures[capture] = kept_capture(capture, self.settings.seed, folder)
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
        if "failed" in result:
            return f"{point.label}: {result['failed']}"
        return f"{result['psnr_db']:.2f} dB in {result['seconds']:.2f} s, {point.label}"

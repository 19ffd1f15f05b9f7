"""The points of a chart, measured one at a time by a process of their own."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.progress import Watcher
from emmc_rig.study.chart.chart_points import Point
from emmc_rig.study.chart.measure import Job, Worker
from emmc_rig.study.points import NotApplicableError, Results, Study
from emmc_rig.study.rows import available_cores, dictionary_identity, digest_of, machine
from reconstruction.methods import METHODS

PICTURES = "pictures"


@dataclass
class ChartStudy(Study[Point]):
    """The points of a chart; settings: ChartSettings."""

    revision = 3

    def picture(self, point: Point) -> Path:
        """Return where the picture of a point is kept."""
        return self.folder / PICTURES / f"{self.digest(point)}.webp"

    def truth_picture(self, point: Point) -> Path:
        """Return where the picture of a point's truth is kept."""
        digest = digest_of(point.capture.identity())
        return self.folder / PICTURES / f"{digest}-truth.webp"

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        configuration, settings = point.configuration, self.settings
        method = METHODS[configuration.method]
        if not method.installed:
            raise NotApplicableError(f"{method.name} needs {method.package}: not installed")
        return {
            "machine": machine(),
            "capture": point.capture.identity(),
            "method": method.name,
            "settings": configuration.settings.model_dump(mode="json"),
            "dictionary": (
                dictionary_identity(settings.dictionary) if method.needs_dictionary else None
            ),
            "cores": available_cores(),
            "repeats": settings.repeats,
            "enough_s": settings.enough_s,
            "limit_s": settings.limit_s,
        }

    def is_whole(self, point: Point, result: dict) -> bool:
        """Return whether a point that has figures has its picture."""
        return "failed" in result or self.picture(point).is_file()

    def group(self, point: Point) -> Hashable:
        """All points are measured by the same process."""
        return None

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the points' figures, those of one capture after the other."""
        (self.folder / PICTURES).mkdir(exist_ok=True)
        settings = self.settings
        with Worker(settings.limit_s) as worker:
            for point in points:
                yield worker.measure(
                    Job(
                        point,
                        self.picture(point),
                        self.truth_picture(point),
                        settings.dictionary,
                        settings.repeats,
                        settings.enough_s,
                    )
                )

    def words(self, point: Point, result: dict) -> str:
        """Return a measured point in words."""
        took = f" (in {result['seconds']:.2f} s)" if "seconds" in result else ""
        return super().words(point, result) + took

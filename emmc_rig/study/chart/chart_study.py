"""The points of a chart, measured one at a time by a process of their own."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from emmc_rig.progress import Watcher
from emmc_rig.study.chart.chart_points import Point
from emmc_rig.study.chart.measure import Job, Worker
from emmc_rig.study.pictured import PicturedStudy
from emmc_rig.study.points import Results
from emmc_rig.study.rows import available_cores


@dataclass
class ChartStudy(PicturedStudy[Point]):
    """The points of a chart; settings: ChartSettings."""

    revision = 4

    def trial_inputs(self, point: Point) -> dict[str, object]:
        """Return what a point's truth depends on, as plain data."""
        return point.capture.identity()

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        settings = self.settings
        return {
            **self.method_inputs(point.configuration.method),
            "capture": point.capture.identity(),
            "settings": point.configuration.settings.model_dump(mode="json"),
            "cores": available_cores(),
            "repeats": settings.repeats,
            "enough_s": settings.enough_s,
            "limit_s": settings.limit_s,
        }

    def group(self, point: Point) -> Hashable:
        """All points are measured by the same process."""
        return None

    def measured(self, points: Sequence[Point], watcher: Watcher) -> Results:
        """Yield the points' figures, those of one capture after the other."""
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

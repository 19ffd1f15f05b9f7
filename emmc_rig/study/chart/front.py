"""Charts of measured points, and which of these nothing else beats."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from emmc_rig.study.chart.chart_points import Configuration, Point

POOLED = "all scenes"


@dataclass(frozen=True)
class Mark:
    """A place in a chart: seconds and dB, for which configuration, from which points."""

    configuration: Configuration
    seconds: float
    psnr_db: float
    points: tuple[Point, ...]


@dataclass(frozen=True)
class Chart:
    """Speed against accuracy of one scene, or pooled, through one camera.

    replicate_db: of the true centre view in place of every view.
    """

    scene: str
    camera: str
    marks: tuple[Mark, ...]
    replicate_db: float

    @property
    def key(self) -> str:
        """A name that is fit for a file."""
        return f"{self.camera}-{self.scene}".replace(" ", "-")

    @property
    def title(self) -> str:
        """In words."""
        return f"{self.scene}, {self.camera}"

    def front(self) -> list[Mark]:
        """Return the marks that none beats, from quick to accurate."""
        return pareto_front(self.marks)


def pareto_front(marks: Sequence[Mark]) -> list[Mark]:
    """Return the marks for which no other is as quick and more accurate, or the reverse."""
    found: list[Mark] = []
    for mark in sorted(marks, key=lambda mark: (mark.seconds, -mark.psnr_db)):
        if not found or mark.psnr_db > found[-1].psnr_db:
            found.append(mark)
    return found


def charts(results: Mapping[Point, dict]) -> list[Chart]:
    """Return for each camera the chart over all its scenes, then that of each scene.

    Pooled are the configurations measured in every scene: the geometric mean of seconds, as
    scenes of different sizes count alike, and the mean PSNR. Points that failed are left out.
    """
    done = {point: result for point, result in results.items() if "failed" not in result}
    cameras: dict[str, dict[str, list[Point]]] = defaultdict(lambda: defaultdict(list))
    for point in done:
        cameras[point.capture.camera_name][point.capture.scene_name].append(point)
    found = []
    for camera, scenes in cameras.items():
        singles = [_single(camera, scene, points, done) for scene, points in scenes.items()]
        if len(singles) > 1:
            found.append(_pooled(camera, singles))
        found += singles
    return found


def _single(
    camera: str, scene: str, points: Sequence[Point], results: Mapping[Point, dict]
) -> Chart:
    marks = [
        Mark(point.configuration, results[point]["seconds"], results[point]["psnr_db"], (point,))
        for point in points
    ]
    return Chart(scene, camera, tuple(marks), results[points[0]]["replicate_psnr_db"])


def _pooled(camera: str, singles: Sequence[Chart]) -> Chart:
    found: dict[Configuration, list[Mark]] = defaultdict(list)
    for chart in singles:
        for mark in chart.marks:
            found[mark.configuration].append(mark)
    marks = [
        Mark(
            configuration,
            float(np.exp(np.mean([np.log(mark.seconds) for mark in some]))),
            float(np.mean([mark.psnr_db for mark in some])),
            tuple(point for mark in some for point in mark.points),
        )
        for configuration, some in found.items()
        if len(some) == len(singles)
    ]
    replicate = float(np.mean([chart.replicate_db for chart in singles]))
    return Chart(POOLED, camera, tuple(marks), replicate)

"""Which points nothing else beats, and how time and memory grow with the size of the problem."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from emmc_rig.study.chart.points import Configuration, Point, Scaling

POOLED = "all scenes"


@dataclass(frozen=True)
class Mark:
    """A place in a chart: seconds and dB, for which configuration, from which points."""

    configuration: Configuration
    seconds: float
    psnr_db: float
    points: tuple[Point, ...]

    @property
    def key(self) -> str:
        """A name that is fit for an anchor, the same in every chart for one configuration."""
        return "".join(c if c.isalnum() else "-" for c in self.configuration.label)


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

    def mark_name(self, mark: Mark) -> str:
        """Return the name of a mark in the drawing, unique on the page."""
        return f"mark-{self.key}-{mark.key}"

    def front(self) -> list[Mark]:
        """Return the marks that none beats, from quick to accurate."""
        return pareto_front(self.marks)


def pareto_front(marks: Sequence[Mark]) -> list[Mark]:
    """Return the marks for which no other is as quick and more accurate, or the reverse."""
    found: list[Mark] = []
    for mark in sorted(marks, key=lambda one: (one.seconds, -one.psnr_db)):
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


PATCH_VALUES = 81 * 3
NOISE_MIB = 8


@dataclass(frozen=True)
class Growth:
    """What was varied, measured. seconds, peak_mib: at each value of `at`.

    Seconds are those of all cores together, the work, as this is what methods count; against cores
    by the clock. Memory is that of the whole process; its exponent is fitted to what the runs
    added to what was there before, where that exceeds NOISE_MIB.
    exponent: of seconds ~ at^exponent, by least squares of logarithms; expected_exponent: of the
    operations or bytes that the method counts, between the ends; None where they are not counted.
    """

    axis: str
    label: str
    at: tuple[float, ...]
    seconds: tuple[float, ...]
    peak_mib: tuple[float, ...]
    exponent: float
    expected: float | None
    memory_exponent: float | None
    expected_memory: float | None


def growths(scalings: Sequence[Scaling], results: Mapping[Point, dict]) -> list[Growth]:
    """Return those of which two points or more were measured."""
    found = []
    for scaling in scalings:
        done = [
            (at, results[point])
            for at, point in zip(scaling.at, scaling.points, strict=True)
            if point in results and "failed" not in results[point]
        ]
        if len(done) < 2:
            continue
        at = tuple(at for at, _ in done)
        rows = [row for _, row in done]
        clock = "seconds" if scaling.axis == "cores" else "cpu_seconds"
        seconds = tuple(row[clock] for row in rows)
        found.append(
            Growth(
                scaling.axis,
                scaling.configuration.label,
                at,
                seconds,
                tuple(row["peak_mib"] for row in rows),
                fitted_exponent(at, seconds),
                expected_exponent(scaling, at, rows),
                _memory_exponent(at, rows),
                expected_memory_exponent(scaling, at, rows),
            )
        )
    return found


def fitted_exponent(at: Sequence[float], values: Sequence[float]) -> float:
    """Return the slope of log values against log at."""
    return float(np.polyfit(np.log(at), np.log(values), 1)[0])


def _memory_exponent(at: Sequence[float], rows: Sequence[dict]) -> float | None:
    added = [(x, row["peak_mib"] - row["base_mib"]) for x, row in zip(at, rows, strict=True)]
    clear = [(x, mib) for x, mib in added if mib > NOISE_MIB]
    return fitted_exponent(*zip(*clear, strict=True)) if len(clear) > 1 else None


def expected_exponent(scaling: Scaling, at: Sequence[float], rows: Sequence[dict]) -> float | None:
    """Return the exponent of what is counted; -1 for cores, of which all work may be shared."""
    if scaling.axis == "cores":
        return -1.0
    counted = COUNTED.get(scaling.configuration.method)
    return None if counted is None else _between(at, [counted(row) for row in rows])


def expected_memory_exponent(
    scaling: Scaling, at: Sequence[float], rows: Sequence[dict]
) -> float | None:
    """Return the exponent of the bytes that total variation holds; None for other methods."""
    if scaling.configuration.method != "tv":
        return None
    return 0.0 if scaling.axis == "cores" else _between(at, [_tv_memory(row) for row in rows])


def _between(at: Sequence[float], counts: Sequence[float]) -> float:
    return float(np.log(counts[-1] / counts[0]) / np.log(at[-1] / at[0]))


def _values(row: dict) -> float:
    """Return the values of the light field."""
    return float(np.prod(row["views"]) * np.prod(row["size"]) * 3)


def _tv_bytes(row: dict) -> float:
    """Return the bytes that the steps of total variation move, see `reconstruction.tv`."""
    weights = row["shots"] * 4 / 3 * row["colours_stored"]
    return row["steps"] * _values(row) * (2 * 4 + 2 * 16 + weights)


def _tv_memory(row: dict) -> float:
    """Return the bytes that total variation adds to Psi: light fields and the dual variable."""
    return _values(row) * (2 * 4 + 16)


def _building(row: dict) -> float:
    """Return the operations of Psi D for all patches; see `reconstruction.methods.COSTS`."""
    values = np.prod(row["views"]) * PATCH_VALUES
    each = 2 / 3 if row["colours_stored"] == 1 else 2
    return each * row["patches"] * row["dictionary_atoms"] * values * row["shots"]


def _readings(row: dict) -> float:
    return row["shots"] * 81 / row["binning"] ** 2


def _omp(row: dict) -> float:
    atoms, length = row["dictionary_atoms"], _readings(row)
    return _building(row) + row["patches"] * 2 * atoms * length * row["steps"]


def _admm(row: dict) -> float:
    atoms, length = row["dictionary_atoms"], _readings(row)
    passes = atoms * length**2 + 4 * atoms * length * row["steps"]
    return _building(row) + row["patches"] * passes


COUNTED = {"tv": _tv_bytes, "dict-omp": _omp, "dict-admm": _admm}

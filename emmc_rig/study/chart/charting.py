"""`emmc-rig chart`: which configurations nothing beats, their drawings, table, page and metrics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import ClassVar

import numpy as np
from matplotlib.axes import Axes

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.drivers.errors import DriverError
from emmc_rig.errors import AppError
from emmc_rig.model.errors import ModelError
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.report.drawing import (
    FAINT,
    INK,
    LEGEND,
    LINE,
    colours_of,
    plain_log_ticks,
    save_drawing,
    sheet,
    titled,
)
from emmc_rig.report.page import Head, Section, embedded, fragment, number
from emmc_rig.study.chart.chart_points import Configuration, Point, charted_points, measured
from emmc_rig.study.points import Report, Results, Study, Table
from emmc_rig.study.rows import available_cores, check_scene_names, check_size, machine
from emmc_rig.study.trial import method_inputs

CSV, DRAWN = "chart.csv", "charts"
POOLED = "all scenes"
LINE_POINTS, LETTER_POINTS = 10.0, 4.6
"""Height of a line, and width of a letter, of the names at the front."""
EXPECTED_ERRORS = (AppError, ModelError, ReconstructionError, CalibrationError, DriverError)
MEANS = {
    "ssim": ".3f", "angular_db": ".2f", "disparity_mae_px": ".2f", "floor_mae_px": ".2f",
    "own_disparity_mae_px": ".2f", "cpu_seconds": ".3g", "peak_mib": ".0f", "steps": ".0f",
}  # fmt: skip
"""Figures of a point that the table shows as means over the scenes, and their formats."""


@dataclass(frozen=True)
class Mark:
    """A place in a chart: seconds and dB of a configuration, from its points."""

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

    Points that failed are left out.
    """
    singles: dict[str, dict[str, Chart]] = defaultdict(dict)
    marks: dict[tuple[str, str], list[Mark]] = defaultdict(list)
    for point, result in results.items():
        if "failed" in result:
            continue
        camera, scene = point.capture.camera_name, point.capture.scene_name
        mark = Mark(point.configuration, result["seconds"], result["psnr_db"], (point,))
        marks[camera, scene].append(mark)
        first = results[marks[camera, scene][0].points[0]]
        singles[camera][scene] = Chart(
            scene, camera, tuple(marks[camera, scene]), first["replicate_psnr_db"]
        )
    found: list[Chart] = []
    for camera, scenes in singles.items():
        pooled = _pooled(camera, list(scenes.values()))
        found += [pooled] if len(scenes) > 1 and pooled.marks else []
        found += scenes.values()
    return found


def _pooled(camera: str, singles: Sequence[Chart]) -> Chart:
    """Return the chart of the configurations measured in every scene.

    Seconds are their geometric mean, so that scenes of different sizes count alike; PSNR is the
    mean.
    """
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
    replicate_db = float(np.mean([chart.replicate_db for chart in singles]))
    return Chart(POOLED, camera, tuple(marks), replicate_db)


@dataclass
class ChartStudy(Study[Point]):
    """Speed against accuracy of every method; settings: ChartSettings."""

    revision = 4
    command, title, page = "chart", "Speed against accuracy", "chart.html"
    style_sheets = ("chart.css",)
    caveats = (
        "Frames are simulated by the same Psi that reconstructs them, which favours all methods "
        "alike.",
        "Angular SNR: 0 dB is the baseline, the centre view in all places; below 0 dB parallax is "
        "worse than none. Disparity error: mean, of a plane sweep on the estimate; in brackets, on "
        "the truth.",
        "Seconds: median of repeats after a warm-up, one run at a time, without making the "
        "dictionary. Memory: what a run takes besides Psi, frames and dictionary.",
    )
    columns: ClassVar[Mapping[str, Sequence[str]]] = {
        CSV: (
            "scene", "camera", "method", "level", "settings", "psnr_db", "ssim", "angular_db",
            "replicate_psnr_db", "disparity_mae_px", "floor_mae_px", "bad_share",
            "own_disparity_mae_px", "seconds", "fastest_s", "slowest_s", "cpu_seconds", "repeats",
            "peak_mib", "cores", "load", "shots", "views", "rows", "columns", "steps", "status",
            "advice", "failed",
        )
    }  # fmt: skip

    def planned(self) -> list[Point]:
        """Return the points; raises for wrong input before anything is measured."""
        check_scene_names(self.settings.scenes)
        check_scene_names(self.settings.cameras, "cameras")
        check_size(self.settings.size)
        points = charted_points(self.settings)
        for capture in dict.fromkeys(point.capture for point in points):
            capture.scene_seen()
        return points

    def inputs(self, point: Point) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        settings = self.settings
        return {
            **method_inputs(point.configuration.method, settings.dictionary),
            "capture": point.capture.identity(),
            "settings": point.configuration.settings.model_dump(mode="json"),
            "cores": available_cores(),
            "repeats": settings.repeats,
            "enough_s": settings.enough_s,
        }

    def group(self, point: Point) -> Hashable:
        """All points are measured one after the other."""
        return None

    def measured(self, points: Sequence[Point]) -> Results:
        """Yield the points' figures, those of one capture after the other."""
        for point in points:
            try:
                yield measured(point, self.settings)
            except EXPECTED_ERRORS as fault:
                yield {"failed": str(fault), "keep": False}
            except MemoryError:
                yield {"failed": "not enough memory", "keep": False}

    def words(self, point: Point, result: dict) -> str:
        """Return a measured point in words."""
        took = f" (in {result['seconds']:.2f} s)" if "seconds" in result else ""
        return super().words(point, result) + took

    @property
    def charts(self) -> list[Chart]:
        """Charts of the measured points, pooled ones first."""
        return charts(self.results)

    def shown(self) -> Iterable[Table]:
        """Return the fronts for a terminal: pooled over scenes where there are several."""
        every = self.charts
        for chart in [chart for chart in every if chart.scene == POOLED] or every:
            rows = [
                (mark.configuration.label, f"{mark.seconds:.3g}", f"{mark.psnr_db:.2f}")
                for mark in chart.front()
            ]
            yield Table(chart.title, ("method", "s", "dB"), rows)

    def report(self, new: Path) -> Report:
        """Return the content of the files; raises AppError where nothing could be measured."""
        drawn, every = new / DRAWN, self.charts
        if not every:
            raise AppError(f"nothing could be measured: {self.excluded()[0]}")
        drawn.mkdir()
        colours = colours_of(mark.configuration.method for chart in every for mark in chart.marks)
        done = [result for result in self.results.values() if "failed" not in result]
        loads = sorted(result["load"] for result in done)
        load = f"{loads[0]:.1f} to {loads[-1]:.1f}, median {loads[len(loads) // 2]:.1f}"
        fronts = {
            f"{chart.camera}, {chart.scene}": [
                {"method": m.configuration.label, "seconds": m.seconds, "psnr_db": m.psnr_db}
                for m in chart.front()
            ]
            for chart in every
        }
        return Report(
            _head(every[0]),
            self._about(load, loads[-1] > available_cores() + 0.5, len(done)),
            [self._section(chart, draw_chart(chart, colours, drawn)) for chart in every],
            {CSV: [_row(*pair) for pair in self.results.items()]},
            {
                "points": len(self.results),
                "seconds": self.seconds,
                "machine": machine(),
                "load": load,
                "fronts": fronts,
                "left_out": self.excluded(),
                "settings": self.settings.model_dump(mode="json"),
            },
            {"Machine": machine(), "Load": load},
        )

    def _about(self, load: str, busy: bool, done: int) -> list[str]:
        scenes, cameras = (
            ", ".join(Path(name).stem for name in names)
            for names in (self.settings.scenes, self.settings.cameras)
        )
        return [
            f"{done} points on {scenes}, through {cameras}.",
            f"{machine()}; load average while measuring {load}. "
            + (
                "The machine was busy: seconds are too long, CPU seconds less so."
                if busy
                else "The machine was quiet."
            ),
        ]

    def _section(self, chart: Chart, path: Path) -> Section:
        """Return a chart of the page, with a table of its marks, quick ones first."""
        front = chart.front()
        rows = [
            {
                "mark": mark,
                "in_front": mark in front,
                **_means([self.results[point] for point in mark.points]),
            }
            for mark in sorted(chart.marks, key=lambda mark: mark.seconds)
        ]
        body = fragment(
            "chart_front.html", drawing=embedded(path), title=chart.title, rows=rows,
            key=chart.key, answer=answer(chart),
        )  # fmt: skip
        return Section(chart.key, chart.title, body)


def _row(point: Point, result: dict) -> dict[str, object]:
    """Return a point as a row of chart.csv."""
    configuration = point.configuration
    return {
        **result,
        "scene": point.capture.scene_name,
        "camera": point.capture.camera_name,
        "method": configuration.method,
        "level": configuration.level,
        "settings": configuration.settings.model_dump_json(exclude_defaults=True),
    }


def _means(results: Sequence[dict]) -> dict[str, str]:
    """Return the means over scenes, a dash where none is known."""
    means = {}
    for key, form in MEANS.items():
        known = [result[key] for result in results if result[key] is not None]
        means[key] = number(mean(known) if known else None, form)
    return means


def _head(chart: Chart) -> Head:
    """Return the most accurate configuration and the quicker ones that none beats."""
    *quicker, best = chart.front()
    return Head(
        f"{best.configuration.label} is the most accurate",
        f"{chart.title}: {_accuracy(chart, best)}",
        [
            f"in {mark.seconds:.3g} s: {mark.configuration.label}, "
            f"{best.psnr_db - mark.psnr_db:.2f} dB less"
            for mark in reversed(quicker)
        ]
        + [f"use it: `emmc-rig reconstruct FRAMES --method {best.configuration.method}`"],
    )


def _accuracy(chart: Chart, mark: Mark) -> str:
    gain_db = mark.psnr_db - chart.replicate_db
    return (
        f"{mark.psnr_db:.2f} dB in {mark.seconds:.3g} s, {gain_db:+.2f} dB against the baseline "
        "(centre view in all places)"
    )


def answer(chart: Chart) -> str:
    """Return in words which configuration is the most accurate, and what the quickest loses."""
    quickest, best = chart.front()[0], chart.front()[-1]
    words = f"{best.configuration.label} is the most accurate: {_accuracy(chart, best)}."
    if quickest is best:
        return words + " Nothing is quicker."
    return (
        f"{words} The quickest, {quickest.configuration.label}, takes {quickest.seconds:.3g} s and "
        f"loses {best.psnr_db - quickest.psnr_db:.2f} dB."
    )


def draw_chart(chart: Chart, colours: Mapping[str, str], folder: Path) -> Path:
    """Write one chart; return the SVG."""
    figure, (axes,) = sheet(1, 7.6, 4.6)
    axes.set_xscale("log")
    axes.grid(axis="x", color=LINE, linewidth=0.7)
    front = chart.front()
    shown = {}
    for mark in chart.marks:
        method = mark.configuration.method
        (dot,) = axes.plot(
            mark.seconds, mark.psnr_db,
            "o", markersize=8 if mark in front else 7, color=colours[method],
            markeredgewidth=1.6, alpha=1 if mark in front else 0.55,
            zorder=3,
        )  # fmt: skip
        shown.setdefault(method, dot)
    axes.step(
        [mark.seconds for mark in front], [mark.psnr_db for mark in front],
        where="post", color=INK, linewidth=1.1, alpha=0.55, zorder=2, label="_front",
    )  # fmt: skip
    axes.axhline(chart.replicate_db, color=FAINT, linestyle=":", linewidth=1)
    axes.text(
        0.995, chart.replicate_db, "baseline: true centre view in all places", fontsize=8,
        color=FAINT, ha="right", va="bottom", transform=axes.get_yaxis_transform(),
    )  # fmt: skip
    axes.margins(x=0.14, y=0.16)
    plain_log_ticks(axes)
    titled(axes, chart.title, "seconds")
    axes.legend(
        list(shown.values()), list(shown), loc="center left", bbox_to_anchor=(1.0, 0.5), **LEGEND
    )
    # Places on the paper are known only when everything else has taken its own.
    figure.draw_without_rendering()
    _name(axes, front, colours)
    return save_drawing(figure, folder / f"chart-{chart.key}.svg")


def _name(axes: Axes, front: Sequence[Mark], colours: Mapping[str, str]) -> None:
    """Write the names of the front's marks above and left of it, without overlaps."""
    assert axes.figure is not None
    placed: list[tuple[float, float, float]] = []
    for mark in front:
        label = mark.configuration.label
        x, y = axes.transData.transform((mark.seconds, mark.psnr_db)) / axes.figure.dpi * 72
        right, above = x + 3, y + 7
        left = right - LETTER_POINTS * len(label)
        below = [top for start, end, top in placed if left < end and start < right]
        height = max([above, *below])
        placed.append((left, right, height + LINE_POINTS))
        axes.annotate(
            label, (mark.seconds, mark.psnr_db), (3, 7 + height - above),
            textcoords="offset points", fontsize=8, ha="right",
            color=colours[mark.configuration.method],
        )  # fmt: skip

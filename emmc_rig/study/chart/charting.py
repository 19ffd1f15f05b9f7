"""`emmc-rig chart`: measure the points, and write table, page, charts and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.pages.drawing import colours_of
from emmc_rig.progress import Watcher
from emmc_rig.study.chart.chart_drawing import draw_chart, draw_growths
from emmc_rig.study.chart.chart_page import chart_page
from emmc_rig.study.chart.chart_sweep import ChartSweep
from emmc_rig.study.chart.front import POOLED, Chart, charts
from emmc_rig.study.chart.peers import PEERS
from emmc_rig.study.chart.points import ChartSettings, Point, charted_points, scalings
from emmc_rig.study.chart.scaling import Growth, growths
from emmc_rig.study.sweep import (
    available_cores,
    check_scene_names,
    csv_text,
    machine,
    provenance,
    sweep_folder,
)

CSV, PAGE, DRAWN = "chart.csv", "chart.html", "charts"
COLUMNS = (
    "scene", "camera", "method", "level", "settings", "psnr_db", "ssim", "angular_db",
    "replicate_psnr_db", "disparity_mae_px", "floor_mae_px", "bad_share", "own_disparity_mae_px",
    "seconds", "fastest_s", "slowest_s", "cpu_seconds", "repeats", "reference_s",
    "reference_cpu_s", "dictionary_s", "peak_mib", "base_mib", "cores", "load", "shots", "views",
    "rows", "columns", "disparity_range_px", "steps", "status", "advice", "failed",
)  # fmt: skip
"""Of chart.csv. An empty field is infinite, not known or not applicable."""


@dataclass(frozen=True)
class ChartOutcome:
    """What was measured, and the page that shows it. left_out: in words, what is missing and why.

    growths: with the size of the problem.
    """

    charts: list[Chart]
    growths: list[Growth]
    left_out: list[str]
    page: Path
    seconds: float

    def shown(self) -> list[Chart]:
        """Return the charts that a terminal shows: pooled where there are such."""
        return [chart for chart in self.charts if chart.scene == POOLED] or self.charts


def run_chart(
    settings: ChartSettings,
    out: Path,
    watcher: Watcher,
    clock: Callable[[], float] = time.perf_counter,
) -> ChartOutcome:
    """Measure into a folder that outlives interruptions, and write everything.

    Raises SweepStopped at Ctrl-C, AppError for wrong input and a folder that cannot be written,
    and the errors of the layers below; what is done is kept in each case.
    """
    started = clock()
    check_scene_names(settings.scenes)
    check_scene_names(settings.cameras, "--camera")
    points = charted_points(settings)
    varied = scalings(settings, available_cores())
    missing, left_out = _missing_peers(points)
    points = [point for point in points if point.configuration.method not in missing]
    if not points:
        raise AppError(f"nothing to chart: {'; '.join(left_out)}")
    for capture in dict.fromkeys(point.capture for point in points):
        capture.described()
    with sweep_folder(out, ChartSweep.journal, "chart") as folder:
        sweep = ChartSweep(settings, folder)
        sweep.make_frames(points, watcher)
        sweep.run([*points, *(point for one in varied for point in one.points)], watcher)
        watcher.begin("draw", None)
        results = {point: sweep.results[point] for point in points}
        left_out += sweep.failures()
        if all("failed" in result for result in results.values()):
            raise AppError(f"nothing could be measured: {left_out[0]}")
        found, grown = charts(results), growths(varied, sweep.results)
        outcome = ChartOutcome(found, grown, left_out, folder / PAGE, clock() - started)
        with result_folder(folder, "chart", adds=True) as new:
            _write(sweep, results, outcome, new)
    return outcome


def _write(sweep: ChartSweep, results: dict[Point, dict], outcome: ChartOutcome, new: Path) -> None:
    """Write the charts, chart.csv, the page and metrics.json."""
    settings, folder = sweep.settings, new / DRAWN
    folder.mkdir()
    marks = [mark for chart in outcome.charts for mark in chart.marks]
    colours = colours_of(mark.configuration.method for mark in marks)
    drawn = {chart: draw_chart(chart, colours, folder) for chart in outcome.charts}
    drawn_growths = draw_growths(outcome.growths, folder)
    load = _load(list(sweep.results.values()))
    sources = provenance(settings, outcome.seconds, Machine=machine(), Load=load)
    text = chart_page(
        sweep, _about(settings, results, outcome.left_out), drawn, outcome.growths, drawn_growths,
        sources,
    )  # fmt: skip
    fronts = {
        f"{chart.camera}, {chart.scene}": [
            {"method": one.configuration.label, "seconds": one.seconds, "psnr_db": one.psnr_db}
            for one in chart.front()
        ]
        for chart in outcome.charts
    }
    write_text(new / CSV, csv_text([_row(*one) for one in sweep.results.items()], COLUMNS))
    write_text(new / PAGE, text)
    metrics = {
        "points": len(sweep.results),
        "seconds": outcome.seconds,
        "machine": machine(),
        "load": load,
        "fronts": fronts,
        "growth": [asdict(growth) for growth in outcome.growths],
        "left_out": outcome.left_out,
        "settings": settings.model_dump(mode="json"),
    }
    write_metrics(new, metrics)


def _row(point: Point, result: dict) -> dict[str, object]:
    """Return a point as a row of chart.csv."""
    one = point.configuration
    row = {
        **result,
        "scene": point.capture.scene_name,
        "camera": point.capture.camera_name,
        "method": one.method,
        "level": one.level,
        "settings": one.settings.model_dump_json(exclude_defaults=True),
    }
    if "failed" not in result:
        row["views"] = "x".join(map(str, result["views"]))
        row["rows"], row["columns"] = result["size"]
    return row


def _missing_peers(points: Sequence[Point]) -> tuple[set[str], list[str]]:
    """Return the rivals that are not installed, and a line about each."""
    missing = {}
    for name in dict.fromkeys(p.configuration.method for p in points if p.configuration.is_peer):
        try:
            PEERS[name].check()
        except AppError as fault:
            missing[name] = f"{name}: {fault}"
    return set(missing), list(missing.values())


def _load(results: Sequence[dict]) -> str:
    """Return how busy the machine was, in words."""
    loads = sorted(result["load"] for result in results if "failed" not in result)
    if not loads:
        return "not measured"
    return f"{loads[0]:.1f} to {loads[-1]:.1f}, median {loads[len(loads) // 2]:.1f}"


def _about(
    settings: ChartSettings, results: dict[Point, dict], left_out: Sequence[str]
) -> list[str]:
    done = [result for result in results.values() if "failed" not in result]
    busy = any(result["load"] > available_cores() + 0.5 for result in done)
    lines = [
        f"{len(done)} points on {', '.join(Path(s).stem for s in settings.scenes)}, through "
        f"{', '.join(Path(c).stem for c in settings.cameras)}.",
        f"{machine()}; load while measuring (processes that wanted a core) {_load(done)}. "
        + (
            "The machine was busy: seconds by the clock are too long, CPU seconds less so."
            if busy
            else "The machine was quiet."
        ),
    ]
    return [*lines, *([f"Left out: {'; '.join(left_out)}."] if left_out else [])]

"""`emmc-rig chart`: plan, measure, and write table, page, charts, advice and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.advice.recommend import ADVICE, saved
from emmc_rig.errors import AppError
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
from emmc_rig.study.chart.advice_rows import advice_rows
from emmc_rig.study.chart.draw import colours_of, draw_chart, draw_growths
from emmc_rig.study.chart.front import POOLED, Chart, charts
from emmc_rig.study.chart.page import page
from emmc_rig.study.chart.peers import PEERS
from emmc_rig.study.chart.plan import ChartSettings, Point, charted_points, sweeps
from emmc_rig.study.chart.rows import csv_text
from emmc_rig.study.chart.run import POINTS, ChartRun, ChartStopped, available_cores, machine
from emmc_rig.study.chart.scaling import Growth, growths
from emmc_rig.study.points import kept_when_stopped, open_folder
from simulators.scenes import SCENES

CSV, PAGE, DRAWN = "chart.csv", "chart.html", "charts"
FAST_SCENES = ("near-planar", "deep-occlusions", "wide-disparity")
FAST_CAMERAS = ("rgbw-bayer-1shot", "rgbw-bayer-3shots")
CAMERAS = ("rgbw-bayer-1shot", "rgbw-bayer-2shots", "rgbw-bayer-3shots", "rgbw-mono")
FAST = {"size": (64, 80), "zoom": 3, "repeats": 3, "enough_s": 1.0, "limit_s": 300.0}


@dataclass(frozen=True)
class Outcome:
    """What was measured, and the page that shows it. left_out: in words, what is missing and why.

    growths: of the sweeps.
    """

    charts: list[Chart]
    growths: list[Growth]
    left_out: list[str]
    page: Path
    seconds: float


def chart_settings(
    fast: bool,
    scenes: Sequence[str],
    cameras: Sequence[str],
    size: tuple[int, int] | None,
    repeats: int | None,
    **others: object,
) -> ChartSettings:
    """Return the settings of a chart; what is not given is that of --fast or of the full one."""
    given = {"size": size, "repeats": repeats}
    chosen = {
        "fast": fast,
        "scenes": tuple(scenes) or (FAST_SCENES if fast else tuple(SCENES)),
        "cameras": tuple(cameras) or (FAST_CAMERAS if fast else CAMERAS),
        **(FAST if fast else {}),
        **{key: value for key, value in given.items() if value is not None},
        **others,
    }
    return ChartSettings.model_validate(chosen)


def run_chart(
    settings: ChartSettings,
    out: Path,
    watcher: Watcher,
    clock: Callable[[], float] = time.perf_counter,
) -> Outcome:
    """Measure into a folder that outlives interruptions, and write everything.

    Raises ChartStopped at Ctrl-C, AppError for wrong input and a folder that cannot be written,
    and the errors of the layers below; what is done is kept in each case.
    """
    started = clock()
    _check_names(settings)
    points = charted_points(settings)
    swept = sweeps(settings, available_cores())
    missing, left_out = _missing_peers(points)
    points = [point for point in points if point.configuration.method not in missing]
    if not points:
        raise AppError(f"nothing to chart: {'; '.join(left_out)}")
    for capture in dict.fromkeys(point.capture for point in points):
        capture.described()
    folder = open_folder(out, POINTS, "an earlier chart")
    run = ChartRun(settings, folder)
    with kept_when_stopped(out, folder, ChartStopped):
        run.prepare(points, watcher)
        run.measure_all([*points, *(point for sweep in swept for point in sweep.points)], watcher)
        watcher.begin("draw", None)
        results = {point: run.results[point] for point in points}
        left_out += [
            f"{point.label}: {result['failed']}"
            for point, result in run.results.items()
            if "failed" in result
        ]
        if all("failed" in result for result in results.values()):
            raise AppError(f"nothing could be measured: {left_out[0]}")
        found, grown = charts(results), growths(swept, run.results)
        (folder / DRAWN).mkdir(exist_ok=True)
        colours = colours_of(found)
        drawn = {chart: draw_chart(chart, colours, folder / DRAWN) for chart in found}
        drawn_growths = draw_growths(grown, folder / DRAWN)
        seconds = clock() - started
        provenance = _provenance(run, seconds)
        text = page(run, _about(run, results, left_out), drawn, grown, drawn_growths, provenance)
        write_text(folder / CSV, csv_text(run.results))
        write_text(folder / ADVICE, saved(advice_rows(results), provenance))
        write_text(folder / PAGE, text)
        write_metrics(folder, _metrics(run, found, grown, left_out, seconds))
    return Outcome(found, grown, left_out, folder / PAGE, seconds)


def _check_names(settings: ChartSettings) -> None:
    for option, specs in (("--scene", settings.scenes), ("--camera", settings.cameras)):
        names = [Path(spec).stem for spec in specs]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise AppError(f"{option}: two are called '{twice}'; name each once, or rename one")


def _missing_peers(points: Sequence[Point]) -> tuple[set[str], list[str]]:
    """Return the rivals that are not installed, and a line about each."""
    missing, told = set(), []
    for name in dict.fromkeys(p.configuration.method for p in points if p.configuration.is_peer):
        try:
            PEERS[name].check()
        except AppError as fault:
            missing.add(name)
            told.append(f"{name}: {fault}")
    return missing, told


def _load(results: Sequence[dict]) -> str:
    """Return how busy the machine was, in words."""
    loads = sorted(result["load"] for result in results if "failed" not in result)
    if not loads:
        return "not measured"
    return f"{loads[0]:.1f} to {loads[-1]:.1f}, median {loads[len(loads) // 2]:.1f}"


def _about(run: ChartRun, results: dict[Point, dict], left_out: Sequence[str]) -> list[str]:
    done = [result for result in results.values() if "failed" not in result]
    settings = run.settings
    cores, load = available_cores(), _load(done)
    told = [
        f"{len(done)} points on {', '.join(Path(s).stem for s in settings.scenes)}, through "
        f"{', '.join(Path(c).stem for c in settings.cameras)}.",
        f"{machine()}; load while measuring (processes that wanted a core) {load}. "
        + (
            "The machine was busy: seconds by the clock are too long, CPU seconds less so."
            if any(result["load"] > cores + 0.5 for result in done)
            else "The machine was quiet."
        ),
    ]
    if left_out:
        told.append("Left out: " + "; ".join(left_out) + ".")
    return told


def _provenance(run: ChartRun, seconds: float) -> dict[str, str]:
    return {
        "Command line": command_line(),
        "Seconds of this run": f"{seconds:.0f}",
        "Machine": machine(),
        "Load": _load(list(run.results.values())),
        "Settings": run.settings.model_dump_json(),
        **{f"Version of {name}": version for name, version in versions().items()},
    }


def _metrics(
    run: ChartRun,
    found: Sequence[Chart],
    grown: Sequence[Growth],
    left_out: Sequence[str],
    seconds: float,
) -> dict:
    return {
        "points": len(run.results),
        "seconds": seconds,
        "machine": machine(),
        "load": _load(list(run.results.values())),
        "fronts": {
            f"{chart.camera}, {chart.scene}": [
                {
                    "method": mark.configuration.label,
                    "seconds": mark.seconds,
                    "psnr_db": mark.psnr_db,
                }
                for mark in chart.front()
            ]
            for chart in found
        },
        "growth": [growth.as_dict() for growth in grown],
        "left_out": list(left_out),
        "settings": run.settings.model_dump(mode="json"),
        "command": command_line(),
        "versions": versions(),
    }


def shown_charts(found: Sequence[Chart]) -> list[Chart]:
    """Return the charts that a terminal shows: pooled where there are such."""
    pooled = [chart for chart in found if chart.scene == POOLED]
    return pooled or list(found)

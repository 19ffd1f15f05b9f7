"""`emmc-rig chart`: measure the points, and write table, page, charts and metrics."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

from matplotlib.axes import Axes

from emmc_rig.errors import AppError
from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
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
from emmc_rig.report.page import (
    Head,
    Section,
    embedded,
    fragment,
    framed,
    number,
    provenance_section,
)
from emmc_rig.store.folders import result_folder
from emmc_rig.store.results import write_metrics
from emmc_rig.study.chart.chart_points import ChartSettings, Point, charted_points
from emmc_rig.study.chart.front import POOLED, Chart, Mark, charts
from emmc_rig.study.chart.measure import ChartStudy
from emmc_rig.study.points import study_folder
from emmc_rig.study.rows import (
    available_cores,
    check_scene_names,
    check_size,
    csv_text,
    machine,
    provenance,
)

LINE_POINTS, LETTER_POINTS = 10.0, 4.6
"""Height of a line, and width of a letter, of the names at the front."""


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


CAVEATS = (
    "Frames are simulated by the same Psi that reconstructs them, which favours all methods alike.",
    "Angular SNR: 0 dB is the baseline, the centre view in all places; below 0 dB parallax is "
    "worse than none. Disparity error: mean, of a plane sweep on the estimate; in brackets, on the "
    "truth.",
    "Seconds: median of repeats after a warm-up, one run at a time, without making the dictionary. "
    "Memory: what a run takes besides Psi, frames and dictionary.",
)
MEANS = {
    "ssim": ".3f", "angular_db": ".2f", "disparity_mae_px": ".2f", "floor_mae_px": ".2f",
    "own_disparity_mae_px": ".2f", "cpu_seconds": ".3g", "peak_mib": ".0f", "steps": ".0f",
}  # fmt: skip
"""Figures of a point that the table shows as means over the scenes, and how."""


def chart_page(
    study: ChartStudy,
    about: Sequence[str],
    charts: Mapping[Chart, Path],
    provenance: Mapping[str, str],
) -> str:
    """Return the page. about: sentences under the title. charts: their SVG files."""
    sections = [_chart_section(study, chart, path) for chart, path in charts.items()]
    sections.append(provenance_section(provenance))
    head = _head(next(iter(charts), None))
    return framed("Speed against accuracy", about, CAVEATS, sections, ["chart.css"], head=head)


def _head(chart: Chart | None) -> Head:
    """Return the most accurate configuration and the quicker ones that none beats."""
    if chart is None or not chart.marks:
        why = "none of these methods could be measured"
        return Head("nothing measured", why, ["list the methods: `emmc-rig reconstruct --list`"])
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


def _chart_section(study: ChartStudy, chart: Chart, path: Path) -> Section:
    front = chart.front()
    rows = [
        {
            "mark": mark,
            "in_front": mark in front,
            **_means([study.results[point] for point in mark.points]),
        }
        for mark in sorted(chart.marks, key=lambda mark: mark.seconds)
    ]
    body = fragment(
        "chart_front.html", drawing=embedded(path), title=chart.title, rows=rows, key=chart.key,
        answer=answer(chart),
    )  # fmt: skip
    return Section(chart.key, chart.title, body)


def _means(results: Sequence[dict]) -> dict[str, str]:
    """Return the means over scenes, a dash where none is known."""
    means = {}
    for key, form in MEANS.items():
        known = [result[key] for result in results if result[key] is not None]
        means[key] = number(mean(known) if known else None, form)
    return means


CSV, PAGE, DRAWN = "chart.csv", "chart.html", "charts"
COLUMNS = (
    "scene", "camera", "method", "level", "settings", "psnr_db", "ssim", "angular_db",
    "replicate_psnr_db", "disparity_mae_px", "floor_mae_px", "bad_share", "own_disparity_mae_px",
    "seconds", "fastest_s", "slowest_s", "cpu_seconds", "repeats", "peak_mib", "cores", "load",
    "shots", "views", "rows", "columns", "steps", "status", "advice", "failed",
)  # fmt: skip
"""Of chart.csv. An empty field is infinite, not known or not applicable."""


@dataclass(frozen=True)
class ChartOutcome:
    """Charts and their page. left_out: points that are missing and why, in words."""

    charts: list[Chart]
    left_out: list[str]
    page: Path
    seconds: float

    def shown(self) -> list[Chart]:
        """Return the charts that a terminal shows: pooled where there are such."""
        return [chart for chart in self.charts if chart.scene == POOLED] or self.charts


def run_chart(settings: ChartSettings, out: Path, watcher: Watcher) -> ChartOutcome:
    """Measure into a folder that outlives interruptions, and write everything.

    Raises StoppedError at Ctrl-C, AppError for wrong input and a folder that cannot be written,
    and the errors of the layers below; measured points are kept in each case.
    """
    started = time.perf_counter()
    check_scene_names(settings.scenes)
    check_scene_names(settings.cameras, "cameras")
    check_size(settings.size)
    points = charted_points(settings)
    for capture in dict.fromkeys(point.capture for point in points):
        capture.scene_seen()  # raises for wrong input before anything is measured
    with study_folder(out, ChartStudy.journal, "chart") as folder:
        study = ChartStudy(settings, folder)
        results = study.run(points, watcher)
        watcher.begin("draw", None)
        left_out = [*dict.fromkeys(study.left_out.values()), *study.failures()]
        if all("failed" in result for result in results.values()):
            raise AppError(f"nothing could be measured: {left_out[0]}")
        seconds = time.perf_counter() - started
        outcome = ChartOutcome(charts(results), left_out, folder / PAGE, seconds)
        with result_folder(folder, "chart", adds=True) as new:
            _write(study, outcome, new)
    return outcome


def _write(study: ChartStudy, outcome: ChartOutcome, new: Path) -> None:
    """Write the charts, chart.csv, the page and metrics.json."""
    settings, drawn = study.settings, new / DRAWN
    drawn.mkdir()
    marks = [mark for chart in outcome.charts for mark in chart.marks]
    colours = colours_of(mark.configuration.method for mark in marks)
    load = _load(list(study.results.values()))
    text = chart_page(
        study, _about(study, load, outcome.left_out),
        {chart: draw_chart(chart, colours, drawn) for chart in outcome.charts},
        provenance(settings, outcome.seconds, Machine=machine(), Load=load),
    )  # fmt: skip
    write_text(new / CSV, csv_text([_row(*pair) for pair in study.results.items()], COLUMNS))
    write_text(new / PAGE, text)
    metrics = {
        "points": len(study.results),
        "seconds": outcome.seconds,
        "machine": machine(),
        "load": load,
        "fronts": {
            f"{chart.camera}, {chart.scene}": [
                {"method": m.configuration.label, "seconds": m.seconds, "psnr_db": m.psnr_db}
                for m in chart.front()
            ]
            for chart in outcome.charts
        },
        "left_out": outcome.left_out,
        "settings": settings.model_dump(mode="json"),
    }
    write_metrics(new, metrics)


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


def _load(results: Sequence[dict]) -> str:
    """Return how busy the machine was, in words."""
    loads = sorted(result["load"] for result in results if "failed" not in result)
    if not loads:
        return "not measured"
    return f"{loads[0]:.1f} to {loads[-1]:.1f}, median {loads[len(loads) // 2]:.1f}"


def _about(study: ChartStudy, load: str, left_out: Sequence[str]) -> list[str]:
    settings = study.settings
    done = [result for result in study.results.values() if "failed" not in result]
    busy = any(result["load"] > available_cores() + 0.5 for result in done)
    return [
        f"{len(done)} points on {', '.join(Path(s).stem for s in settings.scenes)}, through "
        f"{', '.join(Path(c).stem for c in settings.cameras)}.",
        f"{machine()}; load average while measuring {load}. "
        + (
            "The machine was busy: seconds are too long, CPU seconds less so."
            if busy
            else "The machine was quiet."
        ),
        *([f"Excluded: {'; '.join(left_out)}."] if left_out else []),
    ]

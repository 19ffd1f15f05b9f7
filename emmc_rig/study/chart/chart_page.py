"""The charts as one HTML file that opens offline, in which every point shows its picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean

from emmc_rig.pages.marks import ShownMark, ShownPair, marks_data
from emmc_rig.pages.page import (
    Section,
    embedded,
    fragment,
    framed,
    inline_svg,
    number,
    provenance_section,
)
from emmc_rig.study.chart.chart_sweep import ChartSweep
from emmc_rig.study.chart.front import Chart, Mark
from emmc_rig.study.chart.scaling import Growth

CAVEATS = (
    "Frames are made with the very Psi that reconstructs them; all methods have this advantage.",
    "Angular: 0 dB is what one picture copied to every view scores; below, parallax is worse than "
    "none. Disparity: mean error of one plane sweep on the estimate; in brackets on the truth.",
    "Seconds are the median of repeats after a warm-up, in a fresh process each, one at a time; "
    "the dictionary is made beforehand. Memory is that of the whole process.",
)
MEANS = {
    "ssim": ".3f", "angular_db": ".2f", "disparity_mae_px": ".2f", "floor_mae_px": ".2f",
    "own_disparity_mae_px": ".2f", "cpu_seconds": ".3g", "peak_mib": ".0f", "steps": ".0f",
}  # fmt: skip
"""Figures of a point that the table shows as means over the scenes, and how."""


def chart_page(
    sweep: ChartSweep,
    about: Sequence[str],
    charts: Mapping[Chart, Path],
    growths: Sequence[Growth],
    drawn_growths: Mapping[str, Path],
    provenance: Mapping[str, str],
) -> str:
    """Return the page. about: sentences under the title. charts, drawn_growths: their SVG files."""
    sections = [_chart_section(sweep, chart, path) for chart, path in charts.items()]
    if growths:
        pictures = {axis: embedded(path) for axis, path in drawn_growths.items()}
        body = fragment("chart_growth.html", growths=growths, pictures=pictures)
        sections.append(Section("growth", "Growth with the size of the problem", body, "Growth"))
    sections.append(provenance_section(provenance))
    marks = {chart.mark_name(mark): _shown(sweep, mark) for chart in charts for mark in chart.marks}
    return framed(
        "Speed against accuracy", about, CAVEATS, sections, ["chart.css"], ["chart.js"],
        marks_data(marks),
    )  # fmt: skip


def _chart_section(sweep: ChartSweep, chart: Chart, path: Path) -> Section:
    front = chart.front()
    rows = [
        {
            "name": chart.mark_name(mark),
            "mark": mark,
            "in_front": mark in front,
            **_means([sweep.results[point] for point in mark.points]),
        }
        for mark in sorted(chart.marks, key=lambda mark: mark.seconds)
    ]
    first = chart.mark_name(front[-1]) if front else None
    drawing = inline_svg(path, chart.key)
    body = fragment("chart_front.html", drawing=drawing, first=first, rows=rows)
    return Section(chart.key, chart.title, body)


def _means(results: Sequence[dict]) -> dict[str, str]:
    """Return the means over scenes, a dash where none is known."""
    means = {}
    for key, form in MEANS.items():
        known = [result[key] for result in results if result[key] is not None]
        means[key] = number(mean(known) if known else None, form)
    return means


def _shown(sweep: ChartSweep, mark: Mark) -> ShownMark:
    pairs = [
        ShownPair(
            f"{point.capture.scene_name}: {sweep.results[point]['psnr_db']:.2f} dB",
            sweep.picture(point),
            sweep.truth_picture(point.capture),
        )
        for point in mark.points
    ]
    words = f"{mark.psnr_db:.2f} dB, {mark.seconds:.3g} s"
    return ShownMark(mark.configuration.label, words, pairs)

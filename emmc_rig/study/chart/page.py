"""The charts as one HTML file that opens offline, in which every point shows its picture."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

from emmc_rig.pages.page import Section, embedded, framed, provenance_table, table_head, text
from emmc_rig.study.chart.draw import gid_of
from emmc_rig.study.chart.front import Chart, Mark
from emmc_rig.study.chart.run import ChartRun
from emmc_rig.study.chart.scaling import Growth

CAVEATS = (
    "Frames are made with the very Psi that reconstructs them; all methods have this advantage.",
    "Angular: 0 dB is what one picture copied to every view scores; below, parallax is worse than "
    "none. Disparity: mean error of one plane sweep on the estimate; in brackets on the truth.",
    "Seconds are the median of repeats after a warm-up, in a fresh process each, one at a time; "
    "the dictionary is made beforehand. Memory is that of the whole process.",
)
HEADS = (
    "Method", "PSNR dB", "SSIM", "Angular dB", "Disparity px", "Seconds", "CPU s", "MiB", "Steps",
)  # fmt: skip


def page(
    run: ChartRun,
    about: Sequence[str],
    charts: Mapping[Chart, Path],
    growths: Sequence[Growth],
    drawn_growths: Mapping[str, Path],
    provenance: Mapping[str, str],
) -> str:
    """Return the page. about: sentences under the title. charts, drawn_growths: their SVG files."""
    files = resources.files("emmc_rig.study.chart")
    sections = [_chart_section(run, chart, path) for chart, path in charts.items()]
    if growths:
        sections.append(_growth_section(growths, drawn_growths))
    told = provenance_table(dict(provenance))
    sections.append(Section("provenance", "Provenance", "Provenance", told))
    points = {gid_of(chart, mark): _told(run, mark) for chart in charts for mark in chart.marks}
    data = _script("points", points) + _script("pictures", _pictures(run, charts))
    last = sections[-1]
    sections[-1] = Section(last.key, last.short, last.title, last.body + data)
    return framed(
        "Speed against accuracy",
        about,
        CAVEATS,
        sections,
        files.joinpath("page.css").read_text("utf-8"),
        files.joinpath("page.js").read_text("utf-8"),
    )


def _script(name: str, data: object) -> str:
    content = json.dumps(data, ensure_ascii=True).replace("</", "<\\/")
    return f'<script type="application/json" id="{name}">{content}</script>'


def _chart_section(run: ChartRun, chart: Chart, path: Path) -> Section:
    front = chart.front()
    svg = path.read_text("utf-8")
    svg = svg[svg.index("<svg") :]
    # Several charts on one page: what one refers to must not be found in another.
    svg = re.sub(r'(id="|href="#|url\(#)(?!mark-)', rf"\g<1>{chart.key}-", svg)
    rows = "".join(_row(run, chart, mark, mark in front) for mark in _by_seconds(chart.marks))
    first = f' data-first="{gid_of(chart, front[-1])}"' if front else ""
    body = (
        '<p class="lead">The line is the front: nothing is as quick and more accurate. Point at a '
        "mark, or choose a row, to see its picture.</p>"
        f'<div class="chart"><div>{svg}</div><div class="shown-point"{first} aria-live="polite">'
        "</div></div>"
        f'<div class="scroll"><table class="points">{table_head(HEADS)}<tbody>{rows}</tbody>'
        "</table></div>"
    )
    return Section(chart.key, chart.title, chart.title, body)


def _by_seconds(marks: Sequence[Mark]) -> list[Mark]:
    return sorted(marks, key=lambda mark: mark.seconds)


def _row(run: ChartRun, chart: Chart, mark: Mark, in_front: bool) -> str:
    results = [run.results[point] for point in mark.points]
    cells = [
        f"{mark.psnr_db:.2f}",
        _mean(results, "ssim", "{:.3f}"),
        _mean(results, "angular_db", "{:.2f}"),
        _disparity(results),
        f"{mark.seconds:.3g}",
        _mean(results, "cpu_seconds", "{:.3g}"),
        _mean(results, "peak_mib", "{:.0f}"),
        _mean(results, "steps", "{:.0f}"),
    ]
    label = text(mark.configuration.label) + (" (front)" if in_front else "")
    return (
        f'<tr data-mark="{gid_of(chart, mark)}" class="{"front" if in_front else ""}">'
        f'<th scope="row">{label}</th>' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    )


def _mean(results: Sequence[dict], key: str, shown: str) -> str:
    values = [result[key] for result in results if result[key] is not None]
    return shown.format(sum(values) / len(values)) if values else "–"


def _disparity(results: Sequence[dict]) -> str:
    found = _mean(results, "disparity_mae_px", "{:.2f}")
    if found == "–":
        return found
    own = _mean(results, "own_disparity_mae_px", "{:.2f}")
    told = "" if own == "–" else f", own map {own}"
    return f"{found} ({_mean(results, 'floor_mae_px', '{:.2f}')}){told}"


def _told(run: ChartRun, mark: Mark) -> dict[str, object]:
    """Return what the page shows of a mark."""
    return {
        "label": mark.configuration.label,
        "told": f"{mark.psnr_db:.2f} dB, {mark.seconds:.3g} s",
        "pictures": [
            {
                "told": f"{point.capture.scene_name}: {run.results[point]['psnr_db']:.2f} dB",
                "estimate": run.pictures[point].name,
                "truth": run.truth_picture(point.capture).name,
            }
            for point in mark.points
        ],
    }


def _pictures(run: ChartRun, charts: Mapping[Chart, Path]) -> dict[str, str]:
    """Return every picture once, by name."""
    points = dict.fromkeys(point for c in charts for mark in c.marks for point in mark.points)
    paths = [run.pictures[point] for point in points]
    paths += [run.truth_picture(point.capture) for point in points]
    return {path.name: embedded(path) for path in dict.fromkeys(paths)}


def _growth_section(growths: Sequence[Growth], drawn: Mapping[str, Path]) -> Section:
    rows = "".join(
        f'<tr><th scope="row">{text(growth.label)}</th><td>{text(growth.axis)}</td>'
        f"<td>{', '.join(f'{at:g}' for at in growth.at)}</td>"
        f"<td>{', '.join(f'{s:.3g}' for s in growth.seconds)}</td>"
        f"<td>{growth.exponent:.2f}</td><td>{_maybe(growth.expected)}</td>"
        f"<td>{_maybe(growth.memory_exponent)}</td><td>{_maybe(growth.expected_memory)}</td></tr>"
        for growth in growths
    )
    heads = (
        "Method", "Against", "At", "Seconds", "Exponent", "Expected", "Of memory", "Expected",
    )  # fmt: skip
    figures = "".join(
        f'<figure><img src="{embedded(path)}" alt="Time and memory against {text(axis)}"></figure>'
        for axis, path in drawn.items()
    )
    body = (
        '<p class="lead">Time and memory against one size of the problem, all else equal; time is '
        "that of all cores together, against cores by the clock. Dashed: the operations, or for "
        "total variation the bytes, that the method counts. The exponent of memory is "
        "that of what a run adds, and missing where that is too little to tell. In small pictures "
        "what does not grow weighs most: --fast shows it, the full chart goes further.</p>"
        f'<div class="charts">{figures}</div>'
        f'<div class="scroll"><table class="points">{table_head(heads)}<tbody>{rows}</tbody>'
        "</table></div>"
    )
    return Section("growth", "Growth", "Growth with the size of the problem", body)


def _maybe(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"

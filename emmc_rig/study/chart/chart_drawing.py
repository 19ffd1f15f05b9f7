"""The charts as SVG and PNG: speed against accuracy with its front, and growth with size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from emmc_rig.pages.drawing import (
    COLOURS,
    FAINT,
    INK,
    LEGEND,
    LINE,
    plain_log_ticks,
    save_drawing,
    sheet,
    titled,
)
from emmc_rig.study.chart.front import Chart, Mark
from emmc_rig.study.chart.scaling import Growth

LINE_POINTS, LETTER_POINTS = 10.0, 4.6
"""Height of a line, and width of a letter, of the names at the front."""


def draw_chart(chart: Chart, colours: Mapping[str, str], folder: Path) -> Path:
    """Write one chart; return the SVG. Every mark has the name of `Chart.mark_name`."""
    figure, (axes,) = sheet(1, 7.6, 4.6)
    axes.set_xscale("log")
    axes.grid(axis="x", color=LINE, linewidth=0.7)
    front = chart.front()
    shown = {}
    for mark in chart.marks:
        one = mark.configuration
        (dot,) = axes.plot(
            mark.seconds, mark.psnr_db,
            "D" if one.is_peer else "o",
            markersize=8 if mark in front else 7,
            markerfacecolor="white" if one.is_peer else colours[one.method],
            markeredgecolor=colours[one.method],
            markeredgewidth=1.6,
            alpha=1 if mark in front or one.is_peer else 0.55,
            zorder=3,
        )  # fmt: skip
        dot.set_gid(chart.mark_name(mark))
        shown.setdefault(one.method, dot)
    axes.step(
        [mark.seconds for mark in front], [mark.psnr_db for mark in front],
        where="post", color=INK, linewidth=1.1, alpha=0.55, zorder=2, label="_front",
    )  # fmt: skip
    axes.axhline(chart.replicate_db, color=FAINT, linestyle=":", linewidth=1)
    axes.text(
        0.995, chart.replicate_db, "copied true centre view", fontsize=8, color=FAINT,
        ha="right", va="bottom", transform=axes.get_yaxis_transform(),
    )  # fmt: skip
    axes.margins(x=0.14, y=0.16)
    plain_log_ticks(axes, "x")
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


def draw_growths(growths: Sequence[Growth], folder: Path) -> dict[str, Path]:
    """Write a chart for each axis that was varied, time beside memory; return them by axis."""
    return {
        axis: _draw_growth([growth for growth in growths if growth.axis == axis], axis, folder)
        for axis in dict.fromkeys(growth.axis for growth in growths)
    }


def _draw_growth(growths: Sequence[Growth], axis: str, folder: Path) -> Path:
    figure, (time, memory) = sheet(2, 4.4, 3.3, "seconds")
    for growth, colour in zip(growths, COLOURS * len(growths), strict=False):
        label = f"{growth.label}: {growth.exponent:.2f}"
        if growth.expected is not None:
            label += f" ({growth.expected:.2f} expected)"
            first, start = growth.seconds[0], growth.at[0]
            line = [first * (at / start) ** growth.expected for at in growth.at]
            time.plot(growth.at, line, "--", color=colour, alpha=0.45, linewidth=1)
        time.plot(growth.at, growth.seconds, "-o", color=colour, markersize=5, label=label)
        memory.plot(growth.at, growth.peak_mib, "-o", color=colour, markersize=5)
    for axes, title in ((time, "Time"), (memory, "Peak memory")):
        axes.set_xscale("log")
        axes.set_xticks(growths[0].at, [f"{at:g}" for at in growths[0].at])
        axes.xaxis.set_minor_formatter(NullFormatter())
        titled(axes, title, axis)
    time.set_yscale("log")
    plain_log_ticks(time, "y")
    low, high = time.get_ylim()
    if high / low < 4:  # what hardly moves should look as if it hardly moved
        middle = (low * high) ** 0.5
        time.set_ylim(middle / 2, middle * 2)
    memory.set_ylim(0, 1.15 * max(max(growth.peak_mib) for growth in growths))
    memory.set_ylabel("MiB", color=FAINT, fontsize=9)
    time.legend(**LEGEND)
    return save_drawing(figure, folder / f"growth-{axis.replace(' ', '-')}.svg")

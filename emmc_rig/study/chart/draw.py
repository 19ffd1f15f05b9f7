"""The charts as SVG and PNG: speed against accuracy with its front, and growth with size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from emmc_rig.pages.drawing import FAINT, INK, LINE, save_svg, sheet, titled
from emmc_rig.study.chart.front import Chart, Mark
from emmc_rig.study.chart.scaling import Growth

COLOURS = (
    "#1d5a9e", "#c2410c", "#18794e", "#7c3aed", "#b45309", "#0e7490", "#be185d", "#4d7c0f",
    "#475569", "#9f1239",
)  # fmt: skip
PNG_DPI = 200


def colours_of(charts: Sequence[Chart]) -> dict[str, str]:
    """Return a colour for each method of any chart, the same in all of them."""
    methods = dict.fromkeys(mark.configuration.method for c in charts for mark in c.marks)
    return {method: COLOURS[i % len(COLOURS)] for i, method in enumerate(methods)}


def draw_chart(chart: Chart, colours: dict[str, str], folder: Path) -> Path:
    """Write one chart as SVG and PNG; return the SVG. Every mark has the gid of `gid_of`."""
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
        dot.set_gid(gid_of(chart, mark))
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
    _plain_seconds(axes)
    axes.set_xlabel("seconds", color=FAINT, fontsize=9)
    titled(axes, chart.title)
    axes.legend(
        list(shown.values()), list(shown), fontsize=8.5, frameon=False, labelcolor=INK,
        loc="center left", bbox_to_anchor=(1.0, 0.5),
    )  # fmt: skip
    # Places on the paper are known only when everything else has taken its own.
    figure.draw_without_rendering()
    _name(axes, front, colours)
    return _saved(figure, folder / f"chart-{chart.key}.svg")


def _name(axes: Axes, front: Sequence[Mark], colours: dict[str, str]) -> None:
    """Write the names of the front above and left of it, where nothing is, clear of each other."""
    points_per_inch, line, letter = 72, 10.0, 4.6
    assert axes.figure is not None
    placed: list[tuple[float, float, float]] = []
    for mark in front:
        label = mark.configuration.label
        x, y = axes.transData.transform((mark.seconds, mark.psnr_db)) / axes.figure.dpi
        right, above = x * points_per_inch + 3, y * points_per_inch + 7
        left = right - letter * len(label)
        below = [top for start, end, top in placed if left < end and start < right]
        height = max([above, *below])
        placed.append((left, right, height + line))
        axes.annotate(
            label, (mark.seconds, mark.psnr_db), (3, 7 + height - above),
            textcoords="offset points", fontsize=8, ha="right",
            color=colours[mark.configuration.method],
        )  # fmt: skip


def gid_of(chart: Chart, mark: Mark) -> str:
    """Return the name of a mark in the SVG, unique on the page."""
    return f"mark-{chart.key}-{mark.key}"


def _plain_seconds(axes: Axes) -> None:
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def draw_growths(growths: Sequence[Growth], folder: Path) -> dict[str, Path]:
    """Write a chart for each axis that was swept, time beside memory; return them by axis."""
    written = {}
    for axis in dict.fromkeys(growth.axis for growth in growths):
        some = [growth for growth in growths if growth.axis == axis]
        figure, panels = sheet(2, 4.4, 3.3, "seconds")
        for place, growth in enumerate(some):
            colour = COLOURS[place % len(COLOURS)]
            told = f"{growth.label}: {growth.exponent:.2f}"
            if growth.expected is not None:
                told += f" ({growth.expected:.2f} expected)"
                first, start = growth.seconds[0], growth.at[0]
                line = [first * (at / start) ** growth.expected for at in growth.at]
                panels[0].plot(growth.at, line, "--", color=colour, alpha=0.45, linewidth=1)
            panels[0].plot(growth.at, growth.seconds, "-o", color=colour, markersize=5, label=told)
            panels[1].plot(growth.at, growth.peak_mib, "-o", color=colour, markersize=5)
        for axes, title in zip(panels, ("Time", "Peak memory"), strict=True):
            axes.set_xscale("log")
            axes.set_xlabel(axis, color=FAINT, fontsize=9)
            axes.set_xticks(some[0].at, [f"{at:g}" for at in some[0].at])
            axes.xaxis.set_minor_formatter(NullFormatter())
            titled(axes, title)
        panels[0].set_yscale("log")
        panels[0].yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panels[0].yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panels[0].yaxis.set_minor_formatter(NullFormatter())
        _no_narrower(panels[0])
        panels[1].set_ylim(0, 1.15 * max(max(growth.peak_mib) for growth in some))
        panels[0].legend(fontsize=8, frameon=False, labelcolor=INK)
        panels[1].set_ylabel("MiB", color=FAINT, fontsize=9)
        written[axis] = _saved(figure, folder / f"growth-{axis.replace(' ', '-')}.svg")
    return written


def _no_narrower(axes: Axes) -> None:
    """Widen a log axis to a factor of 4: what hardly moves should look as if it hardly moved."""
    low, high = axes.get_ylim()
    if high / low < 4:
        middle = (low * high) ** 0.5
        axes.set_ylim(middle / 2, middle * 2)


def _saved(figure: Figure, path: Path) -> Path:
    figure.savefig(path.with_suffix(".png"), dpi=PNG_DPI)
    return save_svg(figure, path)

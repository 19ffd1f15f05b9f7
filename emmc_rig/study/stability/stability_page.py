"""The sweeps as one HTML file that opens offline: tables of breaking points, and curves."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from emmc_rig.pages.drawing import FAINT, INK, legend_below, save_drawing, sheet, titled
from emmc_rig.pages.page import Head, Section, fragment, framed, inline_svg, number
from emmc_rig.study.pictured import ShownMark, marks_data
from emmc_rig.study.stability.curves import LOST_DB, Curve, Levels, breaking_rows
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.stability.stability_study import StabilityStudy

PANEL_INCHES = (3.9, 2.75)
FLOOR_DB = 6.0
"""Below the least of the copied centre view: further down, a curve says nothing more."""


def draw_curves(
    curves: Sequence[Curve], colours: dict[str, str], path: Path, columns: int = 3
) -> Path:
    """Write a panel for each fault of some curves as SVG and PNG; return the SVG's path.

    Every measured point of the SVG has the name of `Curve.mark_name`.
    """
    faults = list(dict.fromkeys(curve.fault.name for curve in curves))
    panels = [[curve for curve in curves if curve.fault.name == name] for name in faults]
    figure, axes = sheet(len(panels), *PANEL_INCHES, columns=min(columns, len(panels)))
    for one, some in zip(axes, panels, strict=True):
        _panel(one, some, colours)
    _legend(figure, curves, colours)
    return save_drawing(figure, path)


def _panel(axes: Axes, curves: Sequence[Curve], colours: dict[str, str]) -> None:
    fault, strengths = curves[0].fault, curves[0].strengths
    views = next((c.views for c in curves if None not in c.views), curves[0].views)
    axes.plot(*_known(views), ":", color=FAINT, linewidth=1.2, zorder=1)
    floor = _limit(axes, curves)
    for curve in curves:
        colour = colours[curve.method]
        places, levels = _known(curve.levels)
        axes.plot(places, levels, "-", color=colour, linewidth=1.5, zorder=2)
        for i, level in zip(places, levels, strict=True):
            (dot,) = axes.plot(i, level, "o", markersize=3.6, color=colour, zorder=3)
            dot.set_gid(curve.mark_name(i))
        place = curve.below_best()
        if place is not None and levels:
            level = max(float(np.interp(place, places, levels)), floor)
            axes.plot(
                place, level, "x", color=colour, markersize=9, markeredgewidth=1.4, zorder=4,
                clip_on=False,
            )  # fmt: skip
    axes.set_xticks(range(len(strengths)), [shown(strength) for strength in strengths])
    axes.set_xlim(-0.25, len(strengths) - 0.75)
    axes.tick_params(labelsize=7.5)
    titled(axes, fault.title, fault.unit)


def _known(levels: Levels) -> tuple[list[int], list[float]]:
    """Return places and levels where there are such."""
    pairs = [(i, level) for i, level in enumerate(levels) if level is not None]
    return [i for i, _ in pairs], [level for _, level in pairs]


def _limit(axes: Axes, curves: Sequence[Curve]) -> float:
    """End the axis a little below the copied view, where lower values add nothing; return where."""
    views = [view for curve in curves for view in curve.views if view is not None]
    levels = [level for curve in curves for level in curve.levels if level is not None]
    if not levels:
        return -math.inf
    views = views or levels
    low = max(min(levels), min(min(views), max(levels) - LOST_DB) - FLOOR_DB)
    high = max(*levels, *views)
    bottom = low - 0.06 * (high - low)
    axes.set_ylim(bottom, high + 0.08 * (high - low))
    return bottom


def shown(strength: float) -> str:
    """Return a strength for a tick: short."""
    if strength >= 1000:
        return f"{strength / 1000:g}k"
    return f"{strength:.3g}"


def _legend(figure: Figure, curves: Sequence[Curve], colours: dict[str, str]) -> None:
    methods = dict.fromkeys(curve.method for curve in curves)
    lines = [Line2D([], [], color=colours[name], marker="o", markersize=4) for name in methods]
    names = list(methods)
    lines.append(Line2D([], [], color=INK, linestyle="", marker="x"))
    names.append(f"{LOST_DB:g} dB below its best")
    lines.append(Line2D([], [], color=FAINT, linestyle=":"))
    names.append("copied true centre view")
    legend_below(figure, lines, names, 5)


CAVEATS = (
    "A method breaks where it falls 3 dB below its best on that curve, and where it falls below "
    "the true centre view copied to every view. Between measured strengths the curve is taken as "
    "straight.",
    "The readings are made by the real Psi with the sensor's noise on the grid of the "
    "reconstruction; where mask, lens or shots are at fault, the methods are given the design's.",
    "Turning and scaling a mask moves its rim most: the larger the picture, the sooner it breaks.",
    "Contrast: the PSNR is that of the picture stretched back to full contrast.",
)


def stability_page(
    about: Sequence[str],
    sections: Sequence[Section],
    study: StabilityStudy,
    curves: Sequence[Curve],
) -> str:
    """Return the page. about: sentences under the title. curves: whose points show pictures."""
    return framed(
        "Where methods fail", about, CAVEATS, sections, ["chart.css", "stability.css"],
        ["chart.js"], marks_data(_marks(study, curves)), head=_head(curves),
    )  # fmt: skip


def _head(curves: Sequence[Curve]) -> Head:
    """Return the method that breaks under the fewest faults; curves: pooled first."""
    first = [curve for curve in curves if curve.scene == curves[0].scene]
    faults = len({curve.fault.name for curve in first})
    broken = Counter({curve.method: 0 for curve in first})
    broken.update(curve.method for curve in first if curve.below_best() is not None)
    if not broken:
        why = "no method ran under any of the faults"
        return Head("nothing measured", why, ["choose among: `emmc-rig stability --list`"])
    (best, least), *others = reversed(broken.most_common())
    return Head(
        best,
        f"falls {LOST_DB:g} dB below its best under {least} of {faults} faults, the fewest",
        [
            "keep your bench below the strengths of the breaking points",
            *(f"compare {name}: under {count} of {faults} faults" for name, count in others),
        ],
    )


def breaking_section(scene: str, curves: Sequence[Curve]) -> Section:
    """Return the table of one scene, or of all: method x fault -> breaking point."""
    rows, methods = breaking_rows(curves, scene)
    body = fragment("stability_breaking.html", rows=rows, methods=methods)
    return Section("breaking-" + scene.replace(" ", "-"), f"Breaking points, {scene}", body)


def curves_section(scene: str, kind: str, curves: Sequence[Curve], svg: Path) -> Section:
    """Return the small multiples of one kind of fault; points show their picture."""
    key = f"{kind}-{scene}".lower().replace(" ", "-")
    first = curves[0].mark_name(0)
    body = fragment("stability_curves.html", drawing=inline_svg(svg, key), first=first)
    return Section(key, f"{kind}, {scene}", body)


def _marks(study: StabilityStudy, curves: Iterable[Curve]) -> dict[str, ShownMark]:
    marks = {}
    for curve in curves:
        measured = zip(curve.strengths, curve.levels, curve.points, strict=True)
        for index, (strength, level, points) in enumerate(measured):
            if level is not None:
                label = f"{curve.fault.title}, {shown(strength)} {curve.fault.unit}"
                pairs = [
                    (_words(study, point), study.picture(point), study.truth_picture(point))
                    for point in points
                ]
                words = f"{curve.method}: {level:.2f} dB"
                marks[curve.mark_name(index)] = ShownMark(label, words, pairs)
    return marks


def _words(study: StabilityStudy, point: Point) -> str:
    result = study.results[point]
    words = f"{point.scene_name}: {number(result['psnr_db'], '.2f')} dB"
    if result["view_db"] is None:
        return words
    return f"{words}, copied centre view {result['view_db']:.2f} dB"

"""Measured points as curves, one per fault and method; their breaking points and drawings.

A place on a sweep is an index into its strengths, with a fraction between two of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from emmc_rig.report.drawing import FAINT, INK, legend_below, save_drawing, sheet, titled
from emmc_rig.study.stability.fault import Fault
from emmc_rig.study.stability.faults import FAULTS, Point

LOST_DB = 3.0
PANEL_INCHES, PANELS_IN_ROW = (3.9, 2.75), 3
FLOOR_DB = 6.0
"""Below the least of the baseline: further down, a curve says nothing more."""
POOLED = "all scenes"
Levels = Sequence[float | None]
"""PSNR in dB by strength; None where a method failed."""
BreakingRow = tuple[Fault, list[str]]
"""A fault, and where each method breaks under it, in words."""


def below_best(levels: Levels, whole: bool = False) -> float | None:
    """Return the place beyond their best where levels fall LOST_DB below it; see `crossing`."""
    best = max((level for level in levels if level is not None), default=0.0)
    return crossing([None if v is None else v - best + LOST_DB for v in levels], whole)


def below_view(levels: Levels, views: Levels, whole: bool = False) -> float | None:
    """Return the place where levels fall below those of the baseline; see `crossing`.

    Where the baseline is exact (None or infinite) nothing exceeds it.
    """
    margins = [
        None if level is None or view is None or math.isinf(view) else level - view
        for level, view in zip(levels, views, strict=True)
    ]
    return crossing(margins, whole)


def crossing(margins: Levels, whole: bool = False) -> float | None:
    """Return the first place beyond the largest margin where margins fall below 0.

    None where they do not; 0 where no margin reaches 0. Between the measured places margins are
    linear; whole: there is nothing between them, so the first one beyond counts.
    """
    values = [-math.inf if margin is None else margin for margin in margins]
    start = max(range(len(values)), key=values.__getitem__)
    if not values[start] >= 0:
        return 0.0
    for at in range(start + 1, len(values)):
        if values[at] < 0:
            before = values[at - 1]
            return (
                float(at)
                if whole or math.isinf(values[at])
                else (at - 1 + before / (before - values[at]))
            )
    return None


def strength_at(strengths: Sequence[float], place: float) -> float:
    """Return the strength at a place: geometric between two above 0, else linear."""
    index = min(int(place), len(strengths) - 1)
    part = place - index
    if part == 0:
        return strengths[index]
    first, last = strengths[index], strengths[index + 1]
    if first > 0 and last > 0:
        return first * (last / first) ** part
    return first + (last - first) * part


def place_words(place: float | None, strengths: Sequence[float]) -> str:
    """Return a breaking point in words, for the table: two digits and no exponent."""
    if place is None:
        return "never"
    if place == 0:
        return "already at the mildest"
    rounded = float(f"{strength_at(strengths, place):.2g}")
    return f"{rounded:.0f}" if rounded >= 10 else f"{rounded:g}"


@dataclass(frozen=True)
class Curve:
    """PSNR by strength. scene: a scene's name, or POOLED: the mean over those with the fault.

    views: the copied centre view of the truth; None where it is exact.
    """

    scene: str
    fault: Fault
    method: str
    strengths: tuple[float, ...]
    levels: tuple[float | None, ...]
    views: tuple[float | None, ...]

    def below_best(self) -> float | None:
        """Return where it breaks by the first measure: 3 dB below its best."""
        return below_best(self.levels, self.fault.whole)

    def below_view(self) -> float | None:
        """Return where it breaks by the second: below the copied centre view."""
        return below_view(self.levels, self.views, self.fault.whole)


def curves(results: Mapping[Point, dict]) -> list[Curve]:
    """Return the curves of every scene, those of all scenes first where there are several."""
    scenes = list(dict.fromkeys(point.scene_name for point in results))
    kinds = list(dict.fromkeys((str(p.fault), p.method) for p in results))
    groups = [(scene, [scene]) for scene in scenes]
    if len(scenes) > 1:
        groups.insert(0, (POOLED, scenes))
    every = (_curve(name, some, *kind, results) for name, some in groups for kind in kinds)
    return [curve for curve in every if curve is not None]


def _curve(
    name: str, scenes: Sequence[str], fault: str, method: str, results: Mapping[Point, dict]
) -> Curve | None:
    """Return one curve, averaged over the scenes with the most strengths measured."""
    by_scene = {
        scene: {
            point.strength: point
            for point in results
            if (point.scene_name, point.fault, point.method) == (scene, fault, method)
        }
        for scene in scenes
    }
    most = max(len(some) for some in by_scene.values())
    whole = [some for some in by_scene.values() if len(some) == most]
    if most < 2:
        return None
    points = tuple(tuple(some[s] for some in whole) for s in whole[0])

    def mean(key: str) -> tuple[float | None, ...]:
        means = []
        for some in points:
            known = [v for v in (results[point].get(key) for point in some) if v is not None]
            means.append(float(np.mean(known)) if len(known) == len(some) else None)
        return tuple(means)

    return Curve(name, FAULTS[fault], method, tuple(whole[0]), mean("psnr_db"), mean("view_db"))


def breaking_rows(curves: Sequence[Curve], scene: str) -> tuple[list[BreakingRow], tuple[str, ...]]:
    """Return the table of one scene, or of all together: cells by fault; and their methods."""
    of_scene = {(c.fault.name, c.method): c for c in curves if c.scene == scene}
    methods = tuple(dict.fromkeys(method for _, method in of_scene))
    rows = []
    for fault in FAULTS.values():
        some = [of_scene.get((fault.name, method)) for method in methods]
        if any(some):
            rows.append((fault, ["-" if curve is None else _cell(curve) for curve in some]))
    return rows, methods


def _cell(curve: Curve) -> str:
    places = curve.below_best(), curve.below_view()
    return " / ".join(place_words(place, curve.strengths) for place in places)


def break_row(curve: Curve) -> dict[str, object]:
    """Return where a curve breaks, in its fault's unit."""
    row: dict[str, object] = {
        "scene": curve.scene,
        "fault": curve.fault.name,
        "unit": curve.fault.unit,
        "repairable": curve.fault.repairable,
        "method": curve.method,
        "best_db": max((level for level in curve.levels if level is not None), default=None),
    }
    for name, place in (("below_best", curve.below_best()), ("below_view", curve.below_view())):
        row[f"{name}_to"] = None if place is None else strength_at(curve.strengths, place)
        row[name] = place_words(place, curve.strengths)
    return row


def draw_curves(curves: Sequence[Curve], colours: dict[str, str], path: Path) -> Path:
    """Write a panel for each fault of some curves as SVG; return its path."""
    faults = list(dict.fromkeys(curve.fault.name for curve in curves))
    panels = [[curve for curve in curves if curve.fault.name == name] for name in faults]
    figure, axes = sheet(len(panels), *PANEL_INCHES, columns=min(PANELS_IN_ROW, len(panels)))
    for panel_axes, some in zip(axes, panels, strict=True):
        _panel(panel_axes, some, colours)
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
        axes.plot(places, levels, "-o", color=colour, linewidth=1.5, markersize=3.6, zorder=2)
        place = curve.below_best()
        if place is not None and levels:
            level = max(float(np.interp(place, places, levels)), floor)
            axes.plot(
                place, level, "x", color=colour, markersize=9, markeredgewidth=1.4, zorder=4,
                clip_on=False,
            )  # fmt: skip
    axes.set_xticks(range(len(strengths)), [_tick(strength) for strength in strengths])
    axes.set_xlim(-0.25, len(strengths) - 0.75)
    axes.tick_params(labelsize=7.5)
    titled(axes, fault.title, fault.unit)


def _known(levels: Levels) -> tuple[list[int], list[float]]:
    """Return places and levels where there are such."""
    pairs = [(i, level) for i, level in enumerate(levels) if level is not None]
    return [i for i, _ in pairs], [level for _, level in pairs]


def _limit(axes: Axes, curves: Sequence[Curve]) -> float:
    """End the axis a little below the baseline, where lower values add nothing; return where."""
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


def _tick(strength: float) -> str:
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
    names.append("baseline: true centre view in all places")
    legend_below(figure, lines, names, 5)

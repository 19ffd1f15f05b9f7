"""Measured points as curves, one per fault, method and screening; where each of them breaks.

A place on a sweep is an index into its strengths, with a fraction between two of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.trial import Fault

LOST_DB = 3.0


@dataclass(frozen=True)
class Span:
    """Between which places a curve stays above its limit; None: to the end of the sweep.

    low: towards the harmless end, which is where a design may break too. high: towards the
    hopeless end.
    """

    low: float | None
    high: float | None


def known_levels(levels: Sequence[float | None]) -> tuple[list[int], list[float]]:
    """Return places and levels where there are such."""
    pairs = [(i, level) for i, level in enumerate(levels) if level is not None]
    return [i for i, _ in pairs], [level for _, level in pairs]


def below_best(levels: Sequence[float | None], whole: bool = False) -> Span | None:
    """Return where levels (dB, None where a method failed) fall LOST_DB below their best.

    None where there is no level at all. whole: see `span`.
    """
    known = [level for level in levels if level is not None]
    if not known:
        return None
    return span([None if v is None else v - max(known) + LOST_DB for v in levels], whole)


def below_view(
    levels: Sequence[float | None], views: Sequence[float | None], whole: bool = False
) -> Span | None:
    """Return where levels fall below those of the copied centre view; None: they never exceed it.

    Where the copied view is exact (None or infinite) nothing exceeds it.
    """
    margins = [
        None if level is None or view is None or math.isinf(view) else level - view
        for level, view in zip(levels, views, strict=True)
    ]
    return span(margins, whole)


def span(margins: Sequence[float | None], whole: bool = False) -> Span | None:
    """Return how far around the largest margin the margins stay at 0 or above.

    Crossings are interpolated linearly between the measured places; whole: there is nothing
    between them, so the first one beyond counts. None where no margin reaches 0.
    """
    values = [-math.inf if margin is None else margin for margin in margins]
    start = max(range(len(values)), key=values.__getitem__)
    if not values[start] >= 0:
        return None
    return Span(_crossing(values, start, -1, whole), _crossing(values, start, 1, whole))


def _crossing(values: Sequence[float], start: int, step: int, whole: bool) -> float | None:
    at = start
    while 0 <= at + step < len(values):
        if values[at + step] < 0:
            if whole or math.isinf(values[at + step]):
                return float(at + step)
            return at + step * values[at] / (values[at] - values[at + step])
        at += step
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


def span_words(found: Span | None, strengths: Sequence[float]) -> str:
    """Return a span in words, for the table."""
    if found is None:
        return "already at the mildest"
    words = []
    if found.low is not None:
        words.append(f"before {_plain(strength_at(strengths, found.low))}")
    if found.high is not None:
        from_there = _plain(strength_at(strengths, found.high))
        words.append(f"from {from_there}" if words else from_there)
    return ", ".join(words) or "never"


def _plain(strength: float) -> str:
    """Return a strength with two digits and no exponent: 0.042, 12, 340."""
    rounded = float(f"{strength:.2g}")
    return f"{rounded:.0f}" if rounded >= 10 else f"{rounded:g}"


POOLED = "all scenes"


@dataclass(frozen=True)
class Curve:
    """PSNR by strength. scene: a scene's name, or POOLED: the mean over those with the fault.

    levels: dB, None where the method failed. views: the copied centre view of the truth; None
    where it is exact. points: those of each strength, one a scene.
    """

    scene: str
    fault: Fault
    method: str
    screened: bool
    strengths: tuple[float, ...]
    levels: tuple[float | None, ...]
    views: tuple[float | None, ...]
    points: tuple[tuple[Point, ...], ...]

    @property
    def label(self) -> str:
        """The method, and whether it got the frames as they were."""
        return self.method if self.screened else f"{self.method}, not screened"

    @property
    def key(self) -> str:
        """Unique among the curves of one scene."""
        return f"{self.fault.name}-{self.method}{'' if self.screened else '-bare'}"

    def mark_name(self, index: int) -> str:
        """Return the name of a measured point in the drawing, unique on the page."""
        return f"mark-{self.scene.replace(' ', '-')}-{self.key}-{index}"

    def below_best(self) -> Span | None:
        """Return where it breaks by the first measure: 3 dB below its best."""
        return below_best(self.levels, self.fault.whole)

    def below_view(self) -> Span | None:
        """Return where it breaks by the second: below the copied centre view."""
        return below_view(self.levels, self.views, self.fault.whole)


def curves(results: Mapping[Point, dict]) -> list[Curve]:
    """Return the curves of every scene, those of all scenes first where there are several."""
    scenes = list(dict.fromkeys(point.scene_name for point in results))
    kinds = list(dict.fromkeys((str(p.fault), p.method, p.screened) for p in results))
    found = []
    if len(scenes) > 1:
        found += [_curve(POOLED, scenes, kind, results) for kind in kinds]
    for scene in scenes:
        found += [_curve(scene, [scene], kind, results) for kind in kinds]
    return [curve for curve in found if curve is not None]


def _curve(
    name: str, scenes: Sequence[str], kind: tuple[str, str, bool], results: Mapping[Point, dict]
) -> Curve | None:
    """Return one curve; of several scenes those that have every strength that any has."""
    by_scene = {
        scene: {
            point.strength: point
            for point in results
            if point.scene_name == scene and (point.fault, point.method, point.screened) == kind
        }
        for scene in scenes
    }
    most = max(len(found) for found in by_scene.values())
    whole = [found for found in by_scene.values() if len(found) == most]
    if most < 2:
        return None
    fault, method, screened = kind
    points = tuple(tuple(found[s] for found in whole) for s in whole[0])

    def mean(key: str) -> tuple[float | None, ...]:
        means = []
        for some in points:
            known = [v for v in (results[point].get(key) for point in some) if v is not None]
            means.append(float(np.mean(known)) if len(known) == len(some) else None)
        return tuple(means)

    return Curve(
        name, FAULTS[fault], method, screened, tuple(whole[0]), mean("psnr_db"), mean("view_db"),
        points,
    )  # fmt: skip


@dataclass(frozen=True)
class BreakingRow:
    """One line of the table "method x fault -> breaking point"; cells: one per method."""

    fault: Fault
    title: str
    unit: str
    cells: tuple[str, ...]


def breaking_rows(curves: Sequence[Curve], scene: str) -> tuple[list[BreakingRow], tuple[str, ...]]:
    """Return the table of one scene, or of all together, and the methods of its columns.

    A fault that was measured with and without screening has two rows.
    """
    of_scene = [curve for curve in curves if curve.scene == scene]
    methods = tuple(dict.fromkeys(curve.method for curve in of_scene))
    rows = []
    for fault in FAULTS.values():
        kinds = {curve.screened for curve in of_scene if curve.fault == fault}
        for screened in sorted(kinds, reverse=True):
            some = {
                curve.method: curve
                for curve in of_scene
                if curve.fault == fault and curve.screened is screened
            }
            title = fault.title + (", not screened" if len(kinds) > 1 and not screened else "")
            cells = tuple(_cell(some[name]) if name in some else "-" for name in methods)
            rows.append(BreakingRow(fault, title, fault.unit, cells))
    return rows, methods


def _cell(curve: Curve) -> str:
    return " / ".join(
        span_words(span, curve.strengths) for span in (curve.below_best(), curve.below_view())
    )


def break_row(curve: Curve) -> dict[str, object]:
    """Return where a curve breaks, in its fault's unit."""
    best, view = curve.below_best(), curve.below_view()
    known = [level for level in curve.levels if level is not None]

    def ends(name: str, span: Span | None) -> dict[str, object]:
        places = (None, None) if span is None else (span.low, span.high)
        low, high = (None if p is None else strength_at(curve.strengths, p) for p in places)
        return {f"{name}_from": low, f"{name}_to": high, name: span_words(span, curve.strengths)}

    return {
        "scene": curve.scene,
        "fault": curve.fault.name,
        "unit": curve.fault.unit,
        "repairable": curve.fault.repairable,
        "method": curve.method,
        "screened": curve.screened,
        "best_db": max(known, default=None),
        **ends("below_best", best),
        **ends("below_view", view),
    }

"""Measured points as curves, one per fault, method and screening; where each of them breaks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emmc_rig.study.stability.breaking import Span, below_best, below_view, span_words, strength_at
from emmc_rig.study.stability.fault import Fault
from emmc_rig.study.stability.fault_points import Point
from emmc_rig.study.stability.faults import FAULTS

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
    scenes = list(dict.fromkeys(point.scene for point in results))
    kinds = list(dict.fromkeys((p.fault, p.method, p.screened) for p in results))
    found = []
    if len(scenes) > 1:
        found += [_curve(POOLED, scenes, kind, results) for kind in kinds]
    for scene in scenes:
        found += [_curve(Path(scene).stem, [scene], kind, results) for kind in kinds]
    return [curve for curve in found if curve is not None]


def _curve(
    name: str,
    scenes: Sequence[str],
    kind: tuple[str, str, bool],
    results: Mapping[Point, dict],
) -> Curve | None:
    """Return one curve; of several scenes those that have every strength that any has."""
    by_scene = {
        scene: {
            point.strength: point
            for point in results
            if point.scene == scene and (point.fault, point.method, point.screened) == kind
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

"""Measured points and breaking points as rows: of two tidy CSV files, and of the table."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from emmc_rig.study.stability.breaking import Span, strength_at, told
from emmc_rig.study.stability.curves import Curve
from emmc_rig.study.stability.faults import FAULTS, Fault
from emmc_rig.study.stability.plan import Point

POINT_COLUMNS = (
    "scene", "fault", "unit", "strength", "method", "screened", "psnr_db", "view_db",
    "angular_db", "usable", "noise_sigma", "psi_error", "status", "advice", "screening",
    "failed",
)  # fmt: skip
BREAK_COLUMNS = (
    "scene", "fault", "unit", "repairable", "method", "screened", "best_db",
    "below_best_from", "below_best_to", "below_best", "below_view_from", "below_view_to",
    "below_view",
)  # fmt: skip
"""`..._to`: the strength from which on it is broken, towards the hopeless end; `..._from`: the one
towards the other end below which it is; empty: not within the sweep. The last says it in words."""


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
        told(span, curve.strengths) for span in (curve.below_best(), curve.below_view())
    )


def points_csv(results: Mapping[Point, dict]) -> str:
    """Return one row per point, in the order they were measured; empty is infinite or unknown."""
    rows = []
    for point, result in results.items():
        fault = FAULTS[point.fault]
        rows.append(
            {
                **result,
                "scene": point.scene_name,
                "fault": fault.name,
                "unit": fault.unit,
                "strength": f"{point.strength:g}",
                "method": point.method,
                "screened": point.screened,
            }
        )
    return _written(POINT_COLUMNS, rows)


def breaks_csv(curves: Sequence[Curve]) -> str:
    """Return one row per curve."""
    return _written(BREAK_COLUMNS, [break_row(curve) for curve in curves])


def break_row(curve: Curve) -> dict[str, object]:
    """Return where a curve breaks, in its fault's unit."""
    best, view = curve.below_best(), curve.below_view()
    known = [level for level in curve.levels if level is not None]

    def ends(name: str, span: Span | None) -> dict[str, object]:
        places = (None, None) if span is None else (span.low, span.high)
        low, high = (None if p is None else strength_at(curve.strengths, p) for p in places)
        return {f"{name}_from": low, f"{name}_to": high, name: told(span, curve.strengths)}

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


def _written(columns: Sequence[str], rows: Sequence[Mapping[str, object]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n", restval="", extrasaction="ignore")
    writer.writeheader()
    for row in rows:
        writer.writerow({key: _plain(value) for key, value in row.items()})
    return text.getvalue()


def _plain(value: object) -> object:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else value

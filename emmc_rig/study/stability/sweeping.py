"""`emmc-rig stability`: measure the sweeps, and write tables, charts, page and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.pages.drawing import colours_of
from emmc_rig.pages.page import Section, provenance_section
from emmc_rig.progress import Watcher
from emmc_rig.study.stability.curve_drawing import draw_curves
from emmc_rig.study.stability.curves import Curve, break_row, curves
from emmc_rig.study.stability.fault_points import (
    Point,
    StabilitySettings,
    chosen_methods,
    planned,
)
from emmc_rig.study.stability.fault_sweep import StabilitySweep
from emmc_rig.study.stability.faults import FAULTS
from emmc_rig.study.stability.stability_page import (
    breaking_section,
    curves_section,
    stability_page,
)
from emmc_rig.study.sweep import csv_text, machine, provenance, sweep_folder
from reconstruction.methods import METHODS

POINTS_CSV, BREAKS_CSV, PAGE, DRAWN = "points.csv", "breaking.csv", "stability.html", "charts"
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
class StabilityOutcome:
    """What was measured, and the page that shows it. left_out: in words, what is missing, why."""

    curves: list[Curve]
    left_out: list[str]
    page: Path
    seconds: float


def run_stability(
    settings: StabilitySettings,
    out: Path,
    watcher: Watcher,
    more: Sequence[Section] = (),
    figures: Mapping[str, object] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> StabilityOutcome:
    """Measure into a folder that outlives interruptions, and write everything.

    more: sections of the page between the curves and where they came from. figures: of them, for
    metrics.json. Raises SweepStopped at Ctrl-C, AppError for wrong input and a folder that cannot
    be written, and the errors of the layers below; what is done is kept in each case.
    """
    started = clock()
    points = planned(settings)
    camera = find_camera(settings.camera)
    if settings.dictionary and any(
        METHODS[name].needs_dictionary for name in chosen_methods(settings)
    ):
        open_dictionary(settings.dictionary, camera.views, camera.sensor.binning)
    with sweep_folder(out, StabilitySweep.journal, "stability") as folder:
        sweep = StabilitySweep(settings, folder)
        sweep.run(points, watcher)
        left_out = [*sweep.unmeasured(), *sweep.failures()]
        found = curves(sweep.results)
        if not found:
            why = [*sweep.unmeasured(), "fewer than two strengths were measured"][0]
            raise AppError(f"nothing could be measured: {why}")
        watcher.begin("draw", None)
        outcome = StabilityOutcome(found, left_out, folder / PAGE, clock() - started)
        with result_folder(folder, "stability", adds=True) as new:
            _write(sweep, new, outcome, more, figures or {})
    return outcome


def _write(
    sweep: StabilitySweep,
    folder: Path,
    outcome: StabilityOutcome,
    more: Sequence[Section],
    figures: Mapping[str, object],
) -> None:
    """Write the charts, the two CSV files, the page and metrics.json."""
    found, settings = outcome.curves, sweep.settings
    sources = provenance(settings, outcome.seconds, Machine=machine())
    sections = [*_sections(found, folder / DRAWN), *more, provenance_section(sources)]
    breaks = [break_row(curve) for curve in found]
    text = stability_page(_about(sweep, outcome.left_out), sections, sweep, found)
    rows = [_row(*one) for one in sweep.results.items()]
    write_text(folder / POINTS_CSV, csv_text(rows, POINT_COLUMNS, forms={"strength": "g"}))
    write_text(folder / BREAKS_CSV, csv_text(breaks, BREAK_COLUMNS))
    write_text(folder / PAGE, text)
    metrics = {
        "points": len(sweep.results),
        "seconds": outcome.seconds,
        "machine": machine(),
        "curves": [
            {**row, "strengths": one.strengths, "psnr_db": one.levels, "view_db": one.views}
            for row, one in zip(breaks, found, strict=True)
        ],
        "left_out": outcome.left_out,
        "settings": settings.model_dump(mode="json"),
        **figures,
    }
    write_metrics(folder, metrics)


def _sections(found: Sequence[Curve], drawn: Path) -> list[Section]:
    """Return the tables of all scenes, then their curves, drawn into a folder."""
    drawn.mkdir(exist_ok=True)
    colours = colours_of(curve.method for curve in found)
    tables, charts = [], []
    for scene in dict.fromkeys(curve.scene for curve in found):
        of_scene = [curve for curve in found if curve.scene == scene]
        slug = scene.replace(" ", "-")
        tables.append(breaking_section(scene, of_scene))
        draw_curves(of_scene, colours, drawn / f"{slug}.svg", columns=5)
        for kind in dict.fromkeys(fault.kind for fault in FAULTS.values()):
            some = [curve for curve in of_scene if curve.fault.kind == kind]
            if some:
                name = f"{slug}-{kind.lower().replace(' ', '-')}.svg"
                svg = draw_curves(some, colours, drawn / name)
                charts.append(curves_section(scene, kind, some, svg))
    return [*tables, *charts]


def _row(point: Point, result: dict) -> dict[str, object]:
    """Return a point as a row of points.csv."""
    return {
        **result,
        "scene": point.scene_name,
        "fault": point.fault,
        "unit": FAULTS[point.fault].unit,
        "strength": float(point.strength),
        "method": point.method,
        "screened": point.screened,
    }


def _about(sweep: StabilitySweep, left_out: Sequence[str]) -> list[str]:
    settings = sweep.settings
    size = "all of it" if settings.size is None else f"{settings.size[0]}x{settings.size[1]}"
    lines = [
        f"{len(sweep.results)} points on {', '.join(Path(s).stem for s in settings.scenes)}, "
        f"{size}, through {Path(settings.camera).stem}; seed {settings.seed}.",
    ]
    return [*lines, *([f"Left out: {'; '.join(left_out)}."] if left_out else [])]

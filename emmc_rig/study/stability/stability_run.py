"""`emmc-rig stability`: measure the faults, and write page, charts, tables and metrics."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext
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
from emmc_rig.processing.pool import opened_pool
from emmc_rig.progress import Watcher
from emmc_rig.study.points import study_folder
from emmc_rig.study.rows import csv_text, machine, provenance
from emmc_rig.study.stability.curves import Curve, break_row, curves
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.stability.stability_page import (
    breaking_section,
    curves_section,
    draw_curves,
    stability_page,
)
from emmc_rig.study.stability.stability_study import StabilitySettings, StabilityStudy, planned
from reconstruction.methods import METHODS

DRAWN = "charts"
POINTS_CSV, BREAKS_CSV, PAGE = "points.csv", "breaking.csv", "stability.html"
POINT_COLUMNS = (
    "scene", "fault", "unit", "strength", "method", "psnr_db", "view_db", "angular_db",
    "usable", "noise_sigma", "psi_error", "status", "advice", "screening",
    "failed",
)  # fmt: skip
BREAK_COLUMNS = (
    "scene", "fault", "unit", "repairable", "method", "best_db", "below_best_to", "below_best",
    "below_view_to", "below_view",
)  # fmt: skip
"""`..._to`: the strength from which on it is broken; empty: not within the sweep. Then in words."""


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
    workers: int | None = None,
    cluster: str | None = None,
) -> StabilityOutcome:
    """Measure into a folder that outlives interruptions, and write everything.

    workers: processes that share the trials; None: this one. cluster: the address of a Dask
    scheduler whose workers share them, on a disk shared with them.

    Raises StudyStopped at Ctrl-C, AppError for wrong input and a folder that cannot be written,
    and the errors of the layers below; what is done is kept in each case.
    """
    started = time.perf_counter()
    points = planned(settings)
    camera = find_camera(settings.camera)
    if settings.dictionary and any(METHODS[p.method].needs_dictionary for p in points):
        open_dictionary(settings.dictionary, camera.views, camera.sensor.binning)
    with study_folder(out, StabilityStudy.journal, "stability") as folder:
        study = StabilityStudy(settings, folder)
        shared = workers is not None or cluster is not None
        with opened_pool(workers or 1, cluster) if shared else nullcontext() as pool:
            study.run(points, watcher, pool)
        left_out = [*study.unmeasured(), *study.failures()]
        found = curves(study.results)
        if not found:
            why = [*study.unmeasured(), "fewer than two strengths were measured"][0]
            raise AppError(f"nothing could be measured: {why}")
        watcher.begin("draw", None)
        seconds = time.perf_counter() - started
        outcome = StabilityOutcome(found, left_out, folder / PAGE, seconds)
        with result_folder(folder, "stability", adds=True) as new:
            _write(study, new, outcome)
    return outcome


def _write(study: StabilityStudy, folder: Path, outcome: StabilityOutcome) -> None:
    """Write the charts, the two CSV files, the page and metrics.json."""
    found, settings = outcome.curves, study.settings
    sources = provenance(settings, outcome.seconds, Machine=machine())
    sections = [*_sections(found, folder / DRAWN), provenance_section(sources)]
    breaks = [break_row(curve) for curve in found]
    text = stability_page(_about(study, outcome.left_out), sections, study, found)
    rows = [_row(*pair) for pair in study.results.items()]
    write_text(folder / POINTS_CSV, csv_text(rows, POINT_COLUMNS))
    write_text(folder / BREAKS_CSV, csv_text(breaks, BREAK_COLUMNS))
    write_text(folder / PAGE, text)
    metrics = {
        "points": len(study.results),
        "seconds": outcome.seconds,
        "machine": machine(),
        "curves": [
            {**row, "strengths": c.strengths, "psnr_db": c.levels, "view_db": c.views}
            for row, c in zip(breaks, found, strict=True)
        ],
        "left_out": outcome.left_out,
        "settings": settings.model_dump(mode="json"),
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
        "unit": FAULTS[str(point.fault)].unit,
        "strength": float(point.strength),
        "method": point.method,
    }


def _about(study: StabilityStudy, left_out: Sequence[str]) -> list[str]:
    settings = study.settings
    size = "all of it" if settings.size is None else f"{settings.size[0]}x{settings.size[1]}"
    lines = [
        f"{len(study.results)} points on {', '.join(Path(s).stem for s in settings.scenes)}, "
        f"{size}, through {Path(settings.camera).stem}; seed {settings.seed}."
    ]
    return [*lines, *([f"Left out: {'; '.join(left_out)}."] if left_out else [])]

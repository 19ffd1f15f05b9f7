"""`emmc-rig stability`: plan, measure, and write tables, charts, page and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.pages.page import Section, provenance_table
from emmc_rig.progress import Watcher
from emmc_rig.study.chart.run import machine
from emmc_rig.study.points import kept_when_stopped, open_folder
from emmc_rig.study.stability.curves import Curve, curves
from emmc_rig.study.stability.draw import colours_of, draw_curves
from emmc_rig.study.stability.faults import FAULTS
from emmc_rig.study.stability.page import breaking_section, curves_section, page, points_data
from emmc_rig.study.stability.plan import StabilitySettings, chosen_methods, planned
from emmc_rig.study.stability.rows import break_row, breaks_csv, points_csv
from emmc_rig.study.stability.run import POINTS, StabilityRun, StabilityStopped
from reconstruction.methods import METHODS

POINTS_CSV, BREAKS_CSV, PAGE, DRAWN = "points.csv", "breaking.csv", "stability.html", "charts"


@dataclass(frozen=True)
class Outcome:
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
) -> Outcome:
    """Measure into a folder that outlives interruptions, and write everything.

    more: sections of the page between the curves and where they came from. figures: of them, for
    metrics.json. Raises
    StabilityStopped at Ctrl-C, AppError for wrong input and a folder that cannot be written, and
    the errors of the layers below; what is done is kept in each case.
    """
    started = clock()
    points = planned(settings)
    camera = find_camera(settings.camera)
    if settings.dictionary and any(
        METHODS[name].needs_dictionary for name in chosen_methods(settings)
    ):
        open_dictionary(settings.dictionary, camera.views, camera.sensor.binning)
    folder = open_folder(out, POINTS, "an earlier sweep")
    run = StabilityRun(settings, folder)
    run.measure_all(points, watcher)
    found = curves(run.results)
    if not found:
        why = run.left_out[0] if run.left_out else "fewer than two strengths were measured"
        raise AppError(f"nothing could be measured: {why}")
    left_out = [
        *run.left_out,
        *(
            f"{point.label}: {result['failed']}"
            for point, result in run.results.items()
            if "failed" in result
        ),
    ]
    watcher.begin("draw", None)
    with kept_when_stopped(out, folder, StabilityStopped):
        path = _written(run, found, left_out, more, figures or {}, clock() - started)
    return Outcome(found, left_out, path, clock() - started)


def _written(
    run: StabilityRun,
    found: Sequence[Curve],
    left_out: Sequence[str],
    more: Sequence[Section],
    figures: Mapping[str, object],
    seconds: float,
) -> Path:
    folder, colours = run.folder, colours_of(found)
    (folder / DRAWN).mkdir(exist_ok=True)
    kinds = dict.fromkeys(fault.kind for fault in FAULTS.values())
    tables, drawn = [], []
    scenes = dict.fromkeys(curve.scene for curve in found)
    for scene in scenes:
        of_scene = [curve for curve in found if curve.scene == scene]
        slug = scene.replace(" ", "-")
        tables.append(breaking_section(scene, of_scene))
        draw_curves(of_scene, colours, folder / DRAWN / f"{slug}.svg", columns=5)
        for kind in kinds:
            some = [curve for curve in of_scene if curve.fault.kind == kind]
            if some:
                name = f"{slug}-{kind.lower().replace(' ', '-')}.svg"
                svg = draw_curves(some, colours, folder / DRAWN / name)
                drawn.append(curves_section(scene, kind, some, svg))
    told = provenance_table(_provenance(run, seconds))
    last = Section("provenance", "Provenance", "Provenance", told)
    data = points_data(run, found)
    text = page(_about(run, left_out), [*tables, *drawn, *more, last], data)
    write_text(folder / POINTS_CSV, points_csv(run.results))
    write_text(folder / BREAKS_CSV, breaks_csv(found))
    write_text(folder / PAGE, text)
    write_metrics(folder, {**_metrics(run, found, left_out, seconds), **figures})
    return folder / PAGE


def _about(run: StabilityRun, left_out: Sequence[str]) -> list[str]:
    settings = run.settings
    size = "all of it" if settings.size is None else f"{settings.size[0]}x{settings.size[1]}"
    told = [
        f"{len(run.results)} points on {', '.join(Path(s).stem for s in settings.scenes)}, "
        f"{size}, through {Path(settings.camera).stem}; seed {settings.seed}.",
    ]
    if left_out:
        told.append("Left out: " + "; ".join(left_out) + ".")
    return told


def _provenance(run: StabilityRun, seconds: float) -> dict[str, str]:
    return {
        "Command line": command_line(),
        "Seconds of this run": f"{seconds:.0f}",
        "Machine": machine(),
        "Settings": run.settings.model_dump_json(),
        **{f"Version of {name}": version for name, version in versions().items()},
    }


def _metrics(
    run: StabilityRun, found: Sequence[Curve], left_out: Sequence[str], seconds: float
) -> dict:
    return {
        "points": len(run.results),
        "seconds": seconds,
        "machine": machine(),
        "curves": [
            {
                **break_row(curve),
                "strengths": list(curve.strengths),
                "psnr_db": list(curve.levels),
                "view_db": list(curve.views),
            }
            for curve in found
        ],
        "left_out": list(left_out),
        "settings": run.settings.model_dump(mode="json"),
        "command": command_line(),
        "versions": versions(),
    }

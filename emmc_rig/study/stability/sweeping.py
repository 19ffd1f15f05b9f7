"""`emmc-rig stability`: measure the sweeps and the studies beside them, write page and metrics.

Beside them: theory, numerical stability and the mismatch protocol, each with sections of the page,
a chart, a CSV file and figures for metrics.json.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
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
from emmc_rig.study.stability.curves import Curve, break_row, curves
from emmc_rig.study.stability.fault_sweep import (
    StabilitySettings,
    StabilitySweep,
    chosen_methods,
    planned,
)
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.stability.mismatch import measure_mismatch, mismatch_sections, recovered_share
from emmc_rig.study.stability.numerics import measure_numerics, numerics_section
from emmc_rig.study.stability.rounding import BROKEN, WEAK
from emmc_rig.study.stability.stability_page import (
    breaking_section,
    curves_section,
    draw_curves,
    stability_page,
)
from emmc_rig.study.stability.theory import METHODS_COMPARED, measure_theory
from emmc_rig.study.stability.theory_section import (
    breaking,
    compared,
    is_predicted,
    oracle_offset,
    theory_sections,
)
from emmc_rig.study.sweep import (
    NotApplicableError,
    csv_text,
    machine,
    plain,
    provenance,
    sweep_folder,
)
from reconstruction.methods import METHODS

DRAWN = "charts"


@dataclass(frozen=True, eq=False)
class Beside:
    """sections: of the page. metrics: by part. lines: for the terminal."""

    sections: list[Section]
    metrics: dict[str, object]
    lines: list[str]


def _theory(settings: StabilitySettings, folder: Path, new: Path, watcher: Watcher) -> Beside:
    points = measure_theory(settings, folder, watcher)
    rows = [
        {"scene": one.scene_name, "fault": one.fault, "strength": float(one.strength), **figures}
        for one, figures in points.items()
    ]
    write_text(new / "theory.csv", csv_text(rows))
    every = compared(points, METHODS_COMPARED)
    mean, root = oracle_offset(every)
    breaks = [breaking(one, method) for one in every for method in METHODS_COMPARED]
    agreed = sum(is_predicted(one["judged"]) for one in breaks)
    metrics = {"oracle_less_bound_db": {"mean": mean, "rms": root}, "breaks": breaks}
    line = (
        f"theory: the bound says where a method breaks in {agreed} of {len(breaks)} curves; "
        f"the oracle lies {mean:+.2f} dB from it"
    )
    sections = theory_sections(points, METHODS_COMPARED, new / DRAWN)
    return Beside(sections, {"theory": metrics}, [line])


def _numerics(settings: StabilitySettings, folder: Path, new: Path, watcher: Watcher) -> Beside:
    found = measure_numerics(watcher, settings.fast)
    rows = [asdict(one) for one in found.findings]
    write_text(new / "numerics.csv", csv_text(rows))
    verdicts = [one.verdict for one in found.findings]
    weak, broken = verdicts.count(WEAK), verdicts.count(BROKEN)
    line = f"numerics: {len(rows)} checks, {weak} weak, {broken} broken"
    return Beside([numerics_section(found, new / DRAWN)], {"numerics": rows}, [line])


def _mismatch(settings: StabilitySettings, folder: Path, new: Path, watcher: Watcher) -> Beside:
    try:
        found = measure_mismatch(settings, folder, watcher)
    except NotApplicableError as fault:
        return Beside([], {}, [f"mismatch left out: {fault}"])
    rows = [
        plain({**asdict(one), "recovered": one.recovered, "recovered_of_oracle": one.of_oracle})
        for one in found
    ]
    write_text(new / "mismatch.csv", csv_text(rows))
    share = recovered_share(found, of_oracle=True)
    line = "mismatch: too little is lost to measure a recovered share"
    if share is not None:
        line = f"mismatch: blind correction recovers {share:.0%} of what the true Psi recovers"
    return Beside(mismatch_sections(found, new / DRAWN), {"mismatch": rows}, [line])


PARTS: dict[str, Callable[[StabilitySettings, Path, Path, Watcher], Beside]] = {
    "theory": _theory,
    "numerics": _numerics,
    "mismatch": _mismatch,
}


def measure_beside(
    settings: StabilitySettings, parts: Sequence[str], out: Path, watcher: Watcher
) -> Beside:
    """Return the parts wanted, in the order of PARTS, measured into the folder of the sweeps.

    Raises SweepStopped at Ctrl-C, AppError for wrong input and a folder that cannot be written,
    and the errors of the layers below; points that are done are kept in each case.
    """
    sections, metrics, lines = [], {}, []
    if not parts:
        return Beside(sections, metrics, lines)
    find_camera(settings.camera)  # raises before anything is written
    with (
        sweep_folder(out, StabilitySweep.journal, "stability") as folder,
        result_folder(folder, "stability", adds=True) as new,
    ):
        (new / DRAWN).mkdir()
        for name, measure in PARTS.items():
            if name in parts:
                found = measure(settings, folder, new, watcher)
                sections += found.sections
                metrics |= found.metrics
                lines += found.lines
    return Beside(sections, metrics, lines)


POINTS_CSV, BREAKS_CSV, PAGE = "points.csv", "breaking.csv", "stability.html"
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
    workers: int | None = None,
    cluster: str | None = None,
) -> StabilityOutcome:
    """Measure into a folder that outlives interruptions, and write everything.

    more: sections of the page between the curves and where they came from. figures: of them, for
    metrics.json. workers: processes that share the trials; None: this one. cluster: the address of
    a Dask scheduler whose workers share them, on a disk shared with them. Raises SweepStopped at
    Ctrl-C, AppError for wrong input and a folder that cannot be written, and the errors of the
    layers below; what is done is kept in each case.
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
        shared = workers is not None or cluster is not None
        with opened_pool(workers or 1, cluster) if shared else nullcontext() as pool:
            sweep.run(points, watcher, pool)
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
        "unit": FAULTS[str(point.fault)].unit,
        "strength": float(point.strength),
        "method": point.method,
        "screened": point.screened,
    }


def _about(sweep: StabilitySweep, left_out: Sequence[str]) -> list[str]:
    settings = sweep.settings
    size = "all of it" if settings.size is None else f"{settings.size[0]}x{settings.size[1]}"
    lines = [
        f"{len(sweep.results)} points on {', '.join(Path(s).stem for s in settings.scenes)}, "
        f"{size}, through {Path(settings.camera).stem}; seed {settings.seed}."
    ]
    return [*lines, *([f"Left out: {'; '.join(left_out)}."] if left_out else [])]

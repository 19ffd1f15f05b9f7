"""`emmc-rig stability`: measure the faults, and write page, charts, tables and metrics."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.dictionary import open_dictionary
from emmc_rig.reconstruction.methods import METHODS
from emmc_rig.report.drawing import (
    FAINT,
    INK,
    colours_of,
    legend_below,
    save_drawing,
    sheet,
    titled,
)
from emmc_rig.report.page import (
    Head,
    Section,
    embedded,
    fragment,
    framed,
    part,
    provenance_section,
)
from emmc_rig.store.folders import result_folder
from emmc_rig.store.pool import opened_pool
from emmc_rig.store.results import write_metrics
from emmc_rig.study.points import study_folder
from emmc_rig.study.rows import csv_text, machine, provenance
from emmc_rig.study.stability.curves import (
    LOST_DB,
    Curve,
    Levels,
    break_row,
    breaking_rows,
    curves,
    place_words,
)
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.stability.stability_study import StabilitySettings, StabilityStudy, planned

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
"""`..._to`: the lowest strength that breaks a method; empty: beyond the sweep. Then in words."""
PANEL_INCHES, COLUMNS = (3.9, 2.75), 3
FLOOR_DB = 6.0
"""Below the least of the baseline: further down, a curve says nothing more."""
CAVEATS = (
    "A method breaks where it falls 3 dB below its best on that curve, and where it falls below "
    "the baseline: the true centre view in all places. Between measured strengths curves are "
    "interpolated linearly.",
    "Frames are simulated with the faulty Psi and the sensor's noise, on the grid of the "
    "reconstruction; the methods are given the Psi of the design.",
    "Turning or scaling a mask moves its rim most: the larger the picture, the smaller the error "
    "that breaks a method.",
    "Contrast: PSNR is measured after stretching the picture back to full contrast.",
)


@dataclass(frozen=True)
class StabilityOutcome:
    """Curves and the page of a sweep. left_out: points that are missing and why, in words."""

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

    Raises StoppedError at Ctrl-C, AppError for wrong input and a folder that cannot be written,
    and the errors of the layers below; measured points are kept in each case.
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
    text = stability_page(_about(study, outcome.left_out), sections, found)
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
        for kind in dict.fromkeys(fault.kind for fault in FAULTS.values()):
            some = [curve for curve in of_scene if curve.fault.kind == kind]
            if some:
                name = f"{slug}-{kind.lower().replace(' ', '-')}.svg"
                svg = draw_curves(some, colours, drawn / name)
                charts.append(curves_section(scene, kind, svg, answers(some)))
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
    size = "whole views" if settings.size is None else f"{settings.size[0]}x{settings.size[1]}"
    return [
        f"{len(study.results)} points on {', '.join(Path(s).stem for s in settings.scenes)}, "
        f"{size}, through {Path(settings.camera).stem}; seed {settings.seed}.",
        *([f"Excluded: {'; '.join(left_out)}."] if left_out else []),
    ]


def draw_curves(curves: Sequence[Curve], colours: dict[str, str], path: Path) -> Path:
    """Write a panel for each fault of some curves as SVG; return its path."""
    faults = list(dict.fromkeys(curve.fault.name for curve in curves))
    panels = [[curve for curve in curves if curve.fault.name == name] for name in faults]
    figure, axes = sheet(len(panels), *PANEL_INCHES, columns=min(COLUMNS, len(panels)))
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
    axes.set_xticks(range(len(strengths)), [shown(strength) for strength in strengths])
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
    names.append("baseline: true centre view in all places")
    legend_below(figure, lines, names, 5)


def stability_page(
    about: Sequence[str], sections: Sequence[Section], curves: Sequence[Curve]
) -> str:
    """Return the page. about: sentences under the title."""
    head = _head(curves)
    return framed("Where methods fail", about, CAVEATS, sections, ["stability.css"], head=head)


def _head(curves: Sequence[Curve]) -> Head:
    """Return the method that breaks under the fewest faults; curves: pooled first."""
    first = [curve for curve in curves if curve.scene == curves[0].scene]
    faults = len({curve.fault.name for curve in first})
    broken = Counter({curve.method: 0 for curve in first})
    broken.update(curve.method for curve in first if curve.below_best() is not None)
    if not broken:
        why = "none of the methods could be measured"
        return Head("nothing measured", why, ["list the faults: `emmc-rig stability --list`"])
    (best, least), *others = reversed(broken.most_common())
    return Head(
        f"{best} holds out best" if others else best,
        f"it falls {LOST_DB:g} dB below its best under {least} of {faults} faults"
        + (", the fewest" if others else ""),
        [
            "keep the errors of your bench below the breaking points",
            *(
                f"for comparison, {name}: under {count} of {faults} faults"
                for name, count in others
            ),
        ],
    )


def answers(curves: Sequence[Curve]) -> list[str]:
    """Return for each fault of some curves a sentence: which method breaks first, which last."""
    sentences = []
    for fault in dict.fromkeys(curve.fault for curve in curves):
        some = [(curve.below_best(), curve) for curve in curves if curve.fault is fault]
        never = [curve.method for place, curve in some if place is None]
        breaking = sorted(
            ((place, curve) for place, curve in some if place is not None), key=lambda pair: pair[0]
        )
        if not breaking:
            sentences.append(f"{fault.title}: no method loses {LOST_DB:g} dB in this sweep.")
            continue
        first, last = breaking[0], breaking[-1]
        words = f"{fault.title}: {_broken(*first)}"
        if never:
            words += f"; {', '.join(never)} nowhere in this sweep"
        elif last is not first:
            words += f"; {_broken(*last)}, the last"
        sentences.append(words + ".")
    return sentences


def _broken(place: float, curve: Curve) -> str:
    at = f"{place_words(place, curve.strengths)} {curve.fault.unit}"
    return f"{curve.method} has lost {LOST_DB:g} dB at {at}"


def breaking_section(scene: str, curves: Sequence[Curve]) -> Section:
    """Return the table of one scene, or of all: method x fault -> breaking point."""
    rows, methods = breaking_rows(curves, scene)
    body = fragment("stability_breaking.html", rows=rows, methods=methods)
    return Section("breaking-" + scene.replace(" ", "-"), f"Breaking points, {scene}", body)


def curves_section(scene: str, kind: str, svg: Path, answers: Sequence[str]) -> Section:
    """Return the small multiples of one kind of fault, below what they say."""
    title = f"{kind}, {scene}"
    body = part("bullets", answers) + part("drawings", {title: embedded(svg)})
    return Section(title.lower().replace(", ", "-").replace(" ", "-"), title, body)

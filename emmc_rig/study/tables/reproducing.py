"""`emmc-rig tables`: measure the cells, test the claims, and write tables.csv, page and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
from emmc_rig.study.sweep import csv_text, provenance, sweep_folder
from emmc_rig.study.tables.cell_sweep import TablesSettings, TablesSweep
from emmc_rig.study.tables.cells import Cell, Part, cells_of, chosen_parts
from emmc_rig.study.tables.charts import draw_charts
from emmc_rig.study.tables.dictionaries import Given, LeaveOneOut, Source
from emmc_rig.study.tables.figures import draw_figures
from emmc_rig.study.tables.findings import Finding, judge
from emmc_rig.study.tables.grids import Grid, grids
from emmc_rig.study.tables.library import Library, scene_specs
from emmc_rig.study.tables.tables_page import tables_page
from reconstruction.methods import METHODS

CSV, PAGE, DRAWN, DICTIONARIES = "tables.csv", "tables.html", "figures", "dictionaries"
COLUMNS = (
    "tables", "scene", "scenario", "shots", "r", "mask", "noise", "demosaiced_first", "method",
    "psnr_db", "paper_psnr_db", "ssim", "replicate_psnr_db", "luma_psnr_db", "chroma_psnr_db",
    "chroma_share", "sensor_psnr_db", "noise_sigma", "rows", "columns", "seconds", "steps",
    "status", "advice", "dictionary", "settings",
)  # fmt: skip
"""Of tables.csv. PSNRs have peak 1; an empty field is infinite, not printed or not applicable."""
FORMS = {"seconds": ".3f", "noise_sigma": ".6f", "ssim": ".5f"}


@dataclass(frozen=True)
class TablesOutcome:
    """What was found, and the page that shows it."""

    grids: list[Grid]
    findings: list[Finding]
    page: Path
    seconds: float


def run_tables(
    scenes: Path | None,
    out: Path,
    only: str | None,
    dictionaries: Sequence[str],
    settings: TablesSettings,
    watcher: Watcher,
    clock: Callable[[], float] = time.perf_counter,
) -> TablesOutcome:
    """Do the chosen tables and figures into a folder that outlives interruptions.

    scenes: a folder of them; None takes the built-in ones. only: names with commas; None takes
    all. dictionaries: files or names; none trains on the other scenes. Raises SweepStopped at
    Ctrl-C, AppError for wrong input and a folder that cannot be written, and the errors of the
    layers below; what is done is kept in each case.
    """
    started = clock()
    parts = chosen_parts(only)
    library = Library(scene_specs(scenes), settings.cuts, settings.seed)
    with sweep_folder(out, TablesSweep.journal, "tables") as folder:
        source = _source(parts, library, dictionaries, settings, folder)
        sweep = TablesSweep(settings, folder, parts, library, source, clock)
        results = sweep.measure(watcher)
        watcher.begin("write the tables and figures", None)
        found = grids(parts, results, library.names)
        findings = judge(results, library.names)
        outcome = TablesOutcome(found, findings, folder / PAGE, clock() - started)
        more = {
            **{f"Scene {name}": spec for name, spec in library.specs.items()},
            "Dictionary": ", ".join(dictionaries) or "K-SVD, leave-one-out over the scenes given",
            "Seed": str(settings.seed),
        }
        sources = provenance(settings, outcome.seconds, **more)
        with result_folder(folder, "tables", adds=True) as new:
            (new / DRAWN).mkdir()
            charts = draw_charts(new / DRAWN, results, library.names)
            figures = draw_figures(new / DRAWN, sweep, results)
            text = tables_page(_about(sweep), found, findings, charts, figures, sources)
            write_text(new / CSV, cells_csv(sweep))
            write_text(new / PAGE, text)
            write_metrics(new, _metrics(sweep, dictionaries, outcome))
    return outcome


def _source(
    parts: Sequence[Part],
    library: Library,
    dictionaries: Sequence[str],
    settings: TablesSettings,
    folder: Path,
) -> Source:
    if not dictionaries:
        return LeaveOneOut(library, settings.training, folder / DICTIONARIES)
    cells = [cell for part in parts for cell in cells_of(part, library.names)]
    binnings = sorted({cell.capture.binning for cell in cells})
    return Given.opened(dictionaries, binnings, sorted({cell.scene for cell in cells}))


def _about(sweep: TablesSweep) -> list[str]:
    cut = sweep.settings.cut.size
    size = "whole views" if cut is None else f"the middle {cut[0]}×{cut[1]} pixels"
    solver = sweep.settings.methods.sparse.solver.method
    coded = "" if solver == "admm" else f" Dict-ADMM's patches are coded by {solver.upper()} here."
    return [
        f"{len(sweep.results)} reconstructions of {', '.join(sweep.library.names)}; {size}, "
        "5×5 views, PSNR with peak 1 over all views, pixels and colours.",
        "Equal total exposure for every capture; frames are made with the Psi that reconstructs "
        f"them, as in the paper.{coded}",
    ]


def _metrics(sweep: TablesSweep, dictionaries: Sequence[str], outcome: TablesOutcome) -> dict:
    return {
        "cells": len(sweep.results),
        "seconds": outcome.seconds,
        "scenes": sweep.library.specs,
        "parts": [part.name for part in sweep.parts],
        "dictionary": list(dictionaries) or "leave-one-out",
        "findings": [_described_finding(finding) for finding in outcome.findings],
        "seed": sweep.settings.seed,
        "settings": sweep.settings.model_dump(mode="json"),
    }


def _described_finding(finding: Finding) -> dict[str, object]:
    judged = finding.judged
    spread = (
        {}
        if judged is None
        else {
            "by_db": judged.mean_db,
            "lowest_scene_db": judged.low_db,
            "highest_scene_db": judged.high_db,
            "scenes": judged.scenes,
            "scenes_holding": judged.holding,
        }
    )
    return {
        "name": finding.claim.name,
        "says": finding.claim.says,
        "verdict": finding.verdict,
        **spread,
        "paper_db": None if finding.printed is None else finding.printed.mean_db,
    }


def cells_csv(sweep: TablesSweep) -> str:
    """Return tables.csv: one row per cell, in the order of the tables."""
    parts: dict[Cell, list[str]] = {}
    for part in sweep.parts:
        for cell in cells_of(part, sweep.library.names):
            parts.setdefault(cell, []).append(part.name)
    rows = [
        {**sweep.results[cell], **_described(sweep, cell), "tables": " ".join(names)}
        for cell, names in parts.items()
        if cell in sweep.results
    ]
    return csv_text(rows, COLUMNS, ".4f", FORMS)


def _described(sweep: TablesSweep, cell: Cell) -> dict[str, object]:
    capture, method = cell.capture, METHODS[cell.method]
    size = sweep.truth(cell).shape[2:4]
    settings = sweep.settings.of(cell.method, capture)
    changed = settings.model_dump_json(exclude_defaults=True)
    named = sweep.source.label(cell.scene, capture.binning) if method.needs_dictionary else ""
    return {
        "scene": cell.scene,
        "scenario": capture.scenario,
        "shots": capture.shots,
        "r": f"1/{capture.binning**2}" if capture.binning > 1 else "1",
        "mask": capture.mask,
        "noise": "yes" if capture.noisy else "no",
        "demosaiced_first": "yes" if capture.demosaiced else "no",
        "method": cell.method,
        "paper_psnr_db": cell.paper_psnr_db,
        "rows": size[0],
        "columns": size[1],
        "dictionary": named,
        "settings": changed,
    }

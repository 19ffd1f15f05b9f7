"""`emmc-rig tables`: plan, do the cells, judge, and write tables.csv, tables.html, metrics.json."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
from emmc_rig.study.points import kept_when_stopped, open_folder
from emmc_rig.study.tables.charts import draw_charts
from emmc_rig.study.tables.dictionaries import Given, LeaveOneOut, Source
from emmc_rig.study.tables.figures import draw_figures
from emmc_rig.study.tables.findings import Finding, judge
from emmc_rig.study.tables.grids import Grid, grids
from emmc_rig.study.tables.library import Library, scene_specs
from emmc_rig.study.tables.page import page
from emmc_rig.study.tables.plan import Part, cells_of, chosen_parts
from emmc_rig.study.tables.rows import csv_text
from emmc_rig.study.tables.run import CELLS, Run, TablesSettings, TablesStopped, do_cells

CSV, PAGE, DRAWN, DICTIONARIES = "tables.csv", "tables.html", "figures", "dictionaries"


@dataclass(frozen=True)
class Outcome:
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
) -> Outcome:
    """Do the chosen tables and figures into a folder that outlives interruptions.

    scenes: a folder of them; None takes the built-in ones. only: names with commas; None takes
    all. dictionaries: files or names; none trains on the other scenes. Raises TablesStopped at
    Ctrl-C, AppError for wrong input and a folder that cannot be written, and the errors of the
    layers below; what is done is kept in each case.
    """
    started = clock()
    parts = chosen_parts(only)
    library = Library(scene_specs(scenes), settings.cuts, settings.seed)
    folder = open_folder(out, CELLS, "earlier tables")
    source = _source(parts, library, dictionaries, settings, folder)
    run = Run(parts, library, source, settings, folder)
    with kept_when_stopped(out, folder, TablesStopped, lambda: "every cell that was done is"):
        results = do_cells(run, watcher, clock)
        watcher.begin("write the tables and figures", None)
        found = grids(parts, results, library.names)
        findings = judge(results, library.names)
        (folder / DRAWN).mkdir(exist_ok=True)
        charts = draw_charts(folder / DRAWN, results, library.names)
        figures = draw_figures(folder / DRAWN, run, results)
        seconds = clock() - started
        provenance = _provenance(run, dictionaries, seconds)
        text = page(
            "The paper's tables and figures, reproduced",
            _about(run, len(results)), found, findings, charts, figures, provenance,
        )  # fmt: skip
        write_text(folder / CSV, csv_text(run, results))
        write_text(folder / PAGE, text)
        write_metrics(folder, _metrics(run, dictionaries, results, findings, seconds))
    return Outcome(found, findings, folder / PAGE, seconds)


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


def _about(run: Run, cells: int) -> list[str]:
    cut = run.settings.cut.size
    size = "whole views" if cut is None else f"the middle {cut[0]}×{cut[1]} pixels"
    solver = run.settings.methods.sparse.solver.method
    coded = "" if solver == "admm" else f" Dict-ADMM's patches are coded by {solver.upper()} here."
    return [
        f"{cells} reconstructions of {', '.join(run.library.names)}; {size}, 5×5 views, PSNR with "
        "peak 1 over all views, pixels and colours.",
        "Equal total exposure for every capture; frames are made with the Psi that reconstructs "
        f"them, as in the paper.{coded}",
    ]


def _provenance(run: Run, dictionaries: Sequence[str], seconds: float) -> dict[str, str]:
    return {
        "Command line": command_line(),
        "Seconds of this run": f"{seconds:.0f}",
        **{f"Scene {name}": spec for name, spec in run.library.specs.items()},
        "Dictionary": ", ".join(dictionaries) or "K-SVD, leave-one-out over the scenes given",
        "Settings": run.settings.model_dump_json(exclude_defaults=True),
        "Seed": str(run.settings.seed),
        **{f"Version of {name}": version for name, version in versions().items()},
    }


def _metrics(
    run: Run,
    dictionaries: Sequence[str],
    results: dict,
    findings: Sequence[Finding],
    seconds: float,
) -> dict:
    return {
        "cells": len(results),
        "seconds": seconds,
        "scenes": run.library.specs,
        "parts": [part.name for part in run.parts],
        "dictionary": list(dictionaries) or "leave-one-out",
        "findings": [
            {
                "name": finding.claim.name,
                "says": finding.claim.says,
                "verdict": finding.verdict,
                **(
                    {}
                    if finding.judged is None
                    else {
                        "by_db": finding.judged.mean_db,
                        "lowest_scene_db": finding.judged.low_db,
                        "highest_scene_db": finding.judged.high_db,
                        "scenes": finding.judged.scenes,
                        "scenes_holding": finding.judged.holding,
                    }
                ),
                "paper_db": None if finding.printed is None else finding.printed.mean_db,
            }
            for finding in findings
        ],
        "settings": run.settings.model_dump(mode="json"),
        "seed": run.settings.seed,
        "command": command_line(),
        "versions": versions(),
    }

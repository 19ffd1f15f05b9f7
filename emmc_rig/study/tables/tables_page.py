"""`emmc-rig tables`: measure the cells, and write tables.csv, page and metrics."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emmc_rig.model.files import write_text
from emmc_rig.progress import Watcher
from emmc_rig.report.page import Head, Section, framed, number, part, provenance_section
from emmc_rig.store.folders import result_folder
from emmc_rig.store.results import write_metrics
from emmc_rig.study.points import study_folder
from emmc_rig.study.rows import csv_text, provenance
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cells import (
    METHODS,
    Cell,
    Part,
    Setup,
    cells_of,
    chosen_parts,
    scenes_of,
)
from emmc_rig.study.tables.tables_study import TablesSettings, TablesStudy, scene_specs

CAVEATS = (
    "The paper's figures are for orientation: its aperture variant of the MIT scenes and its "
    "distance from mask to sensor are unknown. Compare methods and scenarios within one run.",
    "The paper's means are over all of its scenes, whether they are measured here or not.",
)
CSV, PAGE = "tables.csv", "tables.html"
COLUMNS = (
    "tables", "scene", "scenario", "shots", "r", "noise", "method", "psnr_db",
    "paper_psnr_db", "ssim", "angular_db", "replicate_psnr_db", "noise_sigma", "rows", "columns",
    "seconds", "steps", "status", "advice", "dictionary", "settings",
)  # fmt: skip
"""Of tables.csv. PSNRs have peak 1; an empty field is infinite, not printed or not applicable."""

Results = Mapping[Cell, Mapping]


@dataclass(frozen=True)
class Grid:
    """One table: ours and the paper's PSNR in dB, as "30.12 | 30.22", a row a scene and method."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def grid_of(part: Part, results: Results, scenes: Sequence[str]) -> Grid:
    """Return a part's scenes by all methods, then means; what was not measured is a dash."""
    shown, printed = scenes_of(part, scenes), scenes_of(part, list(paper.TITLES))
    groups = [(scene, [scene], [scene]) for scene in shown] + [("mean", shown, printed)]
    rows = [
        (
            f"{name}, {title}",
            *(_pair(setup, method, ours, theirs, results) for setup in part.setups),
        )
        for name, ours, theirs in groups
        for method, title in METHODS.items()
    ]
    return Grid(part.title, ("scene, method", *part.columns), tuple(rows))


def _pair(
    setup: Setup, method: str, ours: Sequence[str], theirs: Sequence[str], results: Results
) -> str:
    """Return our mean over some scenes, and the paper's over others, where it prints any."""
    cells = [Cell(scene, setup, method) for scene in ours]
    measured = [results[cell]["psnr_db"] for cell in cells if cell in results]
    printed = [Cell(scene, setup, method).paper_psnr_db for scene in theirs]
    return _mean(measured) + (f" | {_mean(printed)}" if any(printed) else "")


def _mean(levels: Sequence[float | None]) -> str:
    known = [level for level in levels if level is not None]
    return number(float(np.mean(known)) if known else None, ".2f")


def tables_page(
    about: Sequence[str], results: Results, grids: Sequence[Grid], provenance: Mapping[str, str]
) -> str:
    """Return the page. about: sentences under the title."""
    sections = []
    for index, grid in enumerate(grids):
        body = part("lead", "PSNR in dB, the paper's after the bar.")
        body += part("wide_table", grid.heads, grid.rows)
        sections.append(Section(f"table-{index}", grid.title, body, grid.title.partition(":")[0]))
    sections.append(provenance_section(provenance))
    title = "The paper's tables, reproduced"
    return framed(title, about, CAVEATS, sections, head=_head(results))


def _head(results: Results) -> Head:
    """Return the method that is best in the mean over what all methods reconstructed."""
    by_method: dict[str, list[float]] = {}
    for cell, result in results.items():
        if result.get("psnr_db") is not None:
            by_method.setdefault(cell.method, []).append(result["psnr_db"])
    if not by_method:
        why = "no cell of these tables was reconstructed"
        return Head("nothing measured", why, ["compute all tables: `emmc-rig tables`"])
    means = {METHODS[name]: float(np.mean(levels)) for name, levels in by_method.items()}
    best = max(means, key=lambda name: means[name])
    return Head(
        f"{best} is best in the mean",
        ", ".join(f"{name} {db:.2f} dB" for name, db in means.items()),
        [
            "compare methods within a column, and scenarios within a row",
            "measure on light fields of your own: `emmc-rig tables --scenes FOLDER`",
        ],
    )


@dataclass(frozen=True)
class TablesOutcome:
    """The measured tables, and their page."""

    grids: list[Grid]
    page: Path
    seconds: float


def run_tables(
    folder_of_scenes: Path | None,
    out: Path,
    only: str | None,
    settings: TablesSettings,
    watcher: Watcher,
) -> TablesOutcome:
    """Compute the chosen tables into a folder that outlives interruptions.

    folder_of_scenes: None takes the built-in ones. only: names with commas; None takes all.

    Raises StoppedError at Ctrl-C, AppError for wrong input and a folder that cannot be written, and
    the errors of the layers below; measured cells are kept in each case.
    """
    started = time.perf_counter()
    parts = chosen_parts(only)
    scenes = scene_specs(folder_of_scenes)
    with study_folder(out, TablesStudy.journal, "tables") as folder:
        study = TablesStudy(settings, folder, parts, scenes)
        results = study.measure(watcher)
        watcher.begin("write the tables", None)
        grids = [grid_of(part, results, list(scenes)) for part in parts]
        seconds = time.perf_counter() - started
        origin = {f"Scene {name}": spec for name, spec in scenes.items()}
        with result_folder(folder, "tables", adds=True) as new:
            text = tables_page(
                _about(study), results, grids, provenance(settings, seconds, **origin)
            )
            write_text(new / CSV, cells_csv(study))
            write_text(new / PAGE, text)
            write_metrics(
                new,
                {
                    "cells": len(results),
                    "seconds": seconds,
                    "scenes": scenes,
                    "tables": {grid.title: [grid.heads, *grid.rows] for grid in grids},
                    "settings": settings.model_dump(mode="json"),
                },
            )
    return TablesOutcome(grids, folder / PAGE, seconds)


def _about(study: TablesStudy) -> list[str]:
    cut = study.settings.size
    size = "whole views" if cut is None else f"the middle {cut[0]}×{cut[1]} pixels"
    return [
        f"{len(study.results)} reconstructions of {', '.join(study.scenes)}; {size}, "
        "5×5 views, PSNR with peak 1 over all views, pixels and colours.",
        "Equal total exposure for every setup; frames are made with the Psi that reconstructs "
        "them, as in the paper.",
    ]


def cells_csv(study: TablesStudy) -> str:
    """Return tables.csv: one row per cell, in the order of the tables."""
    parts: dict[Cell, list[str]] = {}
    for table in study.parts:
        for cell in cells_of(table, list(study.scenes)):
            parts.setdefault(cell, []).append(table.name)
    rows = [
        {
            **study.results[cell],
            "scenario": cell.setup.scenario,
            "shots": cell.setup.shots,
            "r": f"1/{cell.setup.binning**2}" if cell.setup.binning > 1 else "1",
            "noise": "yes" if cell.setup.noisy else "no",
            "scene": cell.scene,
            "method": cell.method,
            "paper_psnr_db": cell.paper_psnr_db,
            "tables": " ".join(names),
            "dictionary": study.inputs(cell)["dictionary"],
            "settings": study.settings.of(cell.setup).model_dump_json(exclude_defaults=True),
        }
        for cell, names in parts.items()
        if cell in study.results
    ]
    return csv_text(rows, COLUMNS)

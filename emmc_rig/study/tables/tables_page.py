"""`emmc-rig tables`: measure the cells, test the claims, and write tables.csv, page and metrics."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.pages.page import (
    Head,
    Section,
    fragment,
    framed,
    provenance_section,
)
from emmc_rig.progress import Watcher
from emmc_rig.study.points import study_folder
from emmc_rig.study.rows import csv_text, provenance
from emmc_rig.study.tables.cells import METHOD_TITLES, Cell, cells_of, chosen_parts
from emmc_rig.study.tables.findings import Finding, findings_from
from emmc_rig.study.tables.grids import Grid, Pair, grids
from emmc_rig.study.tables.table_scenes import Scenes, scene_specs
from emmc_rig.study.tables.tables_study import TablesSettings, TablesStudy
from reconstruction.methods import METHODS

CAVEAT = (
    "The paper's figures stand beside ours to show the order of things, not to be reached or "
    "beaten: which aperture variant of the MIT scenes it used, and how far its mask stood from the "
    "sensor, is unknown. Compare methods and scenarios within one run."
)


def tables_page(
    about: Sequence[str],
    grids: Sequence[Grid],
    findings: Sequence[Finding],
    provenance: Mapping[str, str],
) -> str:
    """Return the page. about: sentences under the title."""
    body = fragment("tables_findings.html", findings=findings, titles=METHOD_TITLES)
    sections = [Section("findings", "Findings", body)]
    for grid in grids:
        body = fragment("tables_grid.html", grid=grid, titles=METHOD_TITLES)
        sections.append(Section(grid.name, grid.title, body, grid.title.partition(":")[0]))
    sections.append(provenance_section(provenance))
    title = "The paper's tables, reproduced"
    return framed(title, about, [CAVEAT], sections, ["tables.css"], head=_head(findings))


def _head(findings: Sequence[Finding]) -> Head:
    """Return how many of the paper's findings hold."""
    measured = [one for one in findings if one.spread is not None]
    broken = [one.claim.says for one in measured if one.verdict != "holds"]
    if not measured:
        why = "what was computed in this run decides none of the paper's findings"
        return Head("no finding tested", why, ["compute all of it: `emmc-rig tables`"])
    left = len(findings) - len(measured)
    holding = len(measured) - len(broken)
    return Head(
        f"{holding} of {len(measured)} findings hold",
        f"{left} of the paper's cannot be tested by this run" if left else "all were tested",
        [f"look at what does not hold: {says}" for says in broken]
        or ["compare methods and scenarios in the tables, within one run"],
        "watch" if broken else "good",
    )


COLOURS = {"holds": "green", "does not hold": "red"}
WIDE = 3


def shown(grids: Sequence[Grid], findings: Sequence[Finding]) -> Iterator[Table | Text]:
    """Yield everything to print, the caveat last."""
    yield from _tables(grids)
    yield _findings_table(findings)
    yield Text(CAVEAT, style="yellow")


def _tables(grids: Sequence[Grid]) -> Iterator[Table]:
    """Yield one table per grid: ours, and the paper's behind a bar or, in wide ones, below."""
    for grid in grids:
        table = Table(title=grid.title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
        table.title_justify = table.caption_justify = "left"
        for head in grid.heads:
            table.add_column(head, no_wrap=True)
        stacked = len(grid.columns) > WIDE
        for column in grid.columns:
            table.add_column(column.replace(") ", ")\n"), justify="right")
        table.caption = "PSNR in dB: ours" + (
            ", the paper's below" if stacked else " | the paper's"
        )
        before = None
        for line in grid.lines:
            if before and line.heads[0] != before.heads[0]:
                table.add_section()
            pairs = [_shown(pair, stacked) for pair in line.pairs]
            heads = line.shown_heads(before)[:-1]
            table.add_row(*heads, line.heads[-1], *pairs, style="bold" if line.mean else "")
            before = line
        yield table


def _shown(pair: Pair, stacked: bool) -> Text:
    text = Text(_db(pair.ours))
    if pair.paper is not None:
        text.append("\n" if stacked else " | ", style="dim")
        text.append(_db(pair.paper), style="dim")
    return text


def _db(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _findings_table(findings: Sequence[Finding]) -> Table:
    """Return the findings: verdict, by how much and in how many scenes, and in the paper."""
    table = Table(title="The paper's findings on these light fields, by TV-Dict", box=SIMPLE_HEAD)
    table.title_justify = table.caption_justify = "left"
    table.add_column("verdict", no_wrap=True)
    table.add_column("dB: mean (range), scenes", no_wrap=True)
    table.add_column("paper", justify="right", no_wrap=True)
    table.add_column("finding")
    missing = 0
    for finding in findings:
        spread, printed = finding.spread, finding.printed
        if spread is None:
            missing += 1
            continue
        method = finding.claim.by_method
        by_method = "" if method == "tv-dict" else f" [dim](by {METHOD_TITLES[method]})[/]"
        table.add_row(
            Text(finding.verdict, style=COLOURS[finding.verdict]),
            f"{spread}, {spread.holding}/{spread.scenes}",
            "-" if printed is None else f"{printed.mean_db:+.2f}",
            finding.claim.says + by_method,
        )
    if missing:
        table.caption = f"{missing} findings need tables that were not asked for"
    return table


CSV, PAGE = "tables.csv", "tables.html"
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
    folder_of_scenes: Path | None,
    out: Path,
    only: str | None,
    settings: TablesSettings,
    watcher: Watcher,
) -> TablesOutcome:
    """Compute the chosen tables into a folder that outlives interruptions.

    folder_of_scenes: None takes the built-in ones. only: names with commas; None takes all.

    Raises StudyStopped at Ctrl-C, AppError for wrong input and a folder that cannot be written, and
    the errors of the layers below; what is done is kept in each case.
    """
    started = time.perf_counter()
    parts = chosen_parts(only)
    scenes = Scenes(scene_specs(folder_of_scenes), settings.seed)
    with study_folder(out, TablesStudy.journal, "tables") as folder:
        study = TablesStudy(settings, folder, parts, scenes)
        results = study.measure(watcher)
        watcher.begin("write the tables", None)
        found = grids(parts, results, scenes.names)
        findings = findings_from(results, scenes.names)
        outcome = TablesOutcome(found, findings, folder / PAGE, time.perf_counter() - started)
        more = {
            **{f"Scene {name}": spec for name, spec in scenes.specs.items()},
            "Dictionary": settings.dictionary or "lambertian",
            "Seed": str(settings.seed),
        }
        sources = provenance(settings, outcome.seconds, **more)
        with result_folder(folder, "tables", adds=True) as new:
            text = tables_page(_about(study), found, findings, sources)
            write_text(new / CSV, cells_csv(study))
            write_text(new / PAGE, text)
            write_metrics(new, _metrics(study, outcome))
    return outcome


def _about(study: TablesStudy) -> list[str]:
    cut = study.settings.size
    size = "whole views" if cut is None else f"the middle {cut[0]}×{cut[1]} pixels"
    solver = study.settings.methods.sparse.solver.method
    coded = "" if solver == "admm" else f" Dict-ADMM's patches are coded by {solver.upper()} here."
    return [
        f"{len(study.results)} reconstructions of {', '.join(study.scenes.names)}; {size}, "
        "5×5 views, PSNR with peak 1 over all views, pixels and colours.",
        "Equal total exposure for every capture; frames are made with the Psi that reconstructs "
        f"them, as in the paper.{coded}",
    ]


def _metrics(study: TablesStudy, outcome: TablesOutcome) -> dict:
    return {
        "cells": len(study.results),
        "seconds": outcome.seconds,
        "scenes": study.scenes.specs,
        "parts": [part.name for part in study.parts],
        "findings": [_described_finding(finding) for finding in outcome.findings],
        "seed": study.settings.seed,
        "settings": study.settings.model_dump(mode="json"),
    }


def _described_finding(finding: Finding) -> dict[str, object]:
    figures = {}
    if finding.spread is not None:
        spread = finding.spread
        figures = {
            "by_db": spread.mean_db,
            "lowest_scene_db": spread.low_db,
            "highest_scene_db": spread.high_db,
            "scenes": spread.scenes,
            "scenes_holding": spread.holding,
        }
    return {
        "name": finding.claim.name,
        "says": finding.claim.says,
        "verdict": finding.verdict,
        **figures,
        "paper_db": None if finding.printed is None else finding.printed.mean_db,
    }


def cells_csv(study: TablesStudy) -> str:
    """Return tables.csv: one row per cell, in the order of the tables."""
    parts: dict[Cell, list[str]] = {}
    for part in study.parts:
        for cell in cells_of(part, study.scenes.names):
            parts.setdefault(cell, []).append(part.name)
    rows = [
        {**study.results[cell], **_described(study, cell), "tables": " ".join(names)}
        for cell, names in parts.items()
        if cell in study.results
    ]
    return csv_text(rows, COLUMNS, ".4f", FORMS)


def _described(study: TablesStudy, cell: Cell) -> dict[str, object]:
    capture, method = cell.capture, METHODS[cell.method]
    settings = study.settings
    changed = settings.of(cell.method, capture).model_dump_json(exclude_defaults=True)
    named = (settings.dictionary or "lambertian") if method.needs_dictionary else ""
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
        "dictionary": named,
        "settings": changed,
    }

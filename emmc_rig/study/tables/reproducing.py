"""`emmc-rig tables`: measure the cells, test the claims, and write tables.csv, page and metrics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import write_metrics
from emmc_rig.model.files import write_text
from emmc_rig.pages.drawing import webp_of
from emmc_rig.pages.page import (
    Head,
    Section,
    data_address,
    embedded,
    fragment,
    framed,
    provenance_section,
)
from emmc_rig.pages.paper_figure import PaperFigure
from emmc_rig.progress import Watcher
from emmc_rig.study.sweep import csv_text, provenance, sweep_folder
from emmc_rig.study.tables.cell_sweep import TablesSettings, TablesSweep
from emmc_rig.study.tables.cells import METHOD_TITLES, PARTS, Cell, Part, cells_of, chosen_parts
from emmc_rig.study.tables.charts import draw_charts
from emmc_rig.study.tables.figures import draw_figures
from emmc_rig.study.tables.findings import Finding, findings_from
from emmc_rig.study.tables.grids import Grid, Pair, grids
from emmc_rig.study.tables.library import Given, LeaveOneOut, Library, Source, scene_specs
from reconstruction.methods import METHODS

CAVEAT = (
    "The paper's figures stand beside ours to show the order of things, not to be reached or "
    "beaten: which aperture variant of the MIT scenes it used, and how far its mask stood from the "
    "sensor, is unknown. Compare methods and scenarios within one run."
)
ALTS = {
    "figure5": "Frames of the three scenarios with enlarged pieces",
    "figure6": "Reconstructed views of the three scenarios with enlarged pieces",
    "figure7": "Epipolar images, true and reconstructed",
    "figure8": "Mask patterns",
    "figure9": "Reconstructed views by method and scenario with enlarged pieces",
    "figure10": "Super-resolved views with enlarged pieces",
}


def tables_page(
    about: Sequence[str],
    grids: Sequence[Grid],
    findings: Sequence[Finding],
    charts: Mapping[str, Path],
    figures: Mapping[str, PaperFigure],
    provenance: Mapping[str, str],
) -> str:
    """Return the page. about: sentences under the title. charts: by title. figures: by part."""
    body = fragment("tables_findings.html", findings=findings, titles=METHOD_TITLES)
    sections = [Section("findings", "Findings", body)]
    if charts:
        drawn = {title: embedded(path) for title, path in charts.items()}
        sections.append(Section("charts", "Charts", fragment("tables_charts.html", charts=drawn)))
    for grid in grids:
        body = fragment("tables_grid.html", grid=grid, titles=METHOD_TITLES)
        sections.append(_section(grid.name, grid.title, body))
    for name, drawn in figures.items():
        picture = data_address(webp_of(drawn.figure), ".webp")
        caption = drawn.caption.removeprefix(f"{PARTS[name].title}: ")
        body = fragment("tables_figure.html", alt=ALTS[name], picture=picture, caption=caption)
        sections.append(_section(f"{name}-picture", PARTS[name].title, body))
    sections.append(provenance_section(provenance))
    title = "The paper's tables and figures, reproduced"
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


def _section(key: str, title: str, body: str) -> Section:
    return Section(key, title, body, title.partition(":")[0])


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
        findings = findings_from(results, library.names)
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

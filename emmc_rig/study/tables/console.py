"""The tables and findings as text for a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from emmc_rig.study.tables.cells import METHOD_TITLES
from emmc_rig.study.tables.findings import Finding
from emmc_rig.study.tables.grids import Grid, Pair
from emmc_rig.study.tables.tables_page import CAVEAT

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
        judged, printed = finding.judged, finding.printed
        if judged is None:
            missing += 1
            continue
        judge = finding.claim.judged_by
        by_method = "" if judge == "tv-dict" else f" [dim](by {METHOD_TITLES[judge]})[/]"
        table.add_row(
            Text(finding.verdict, style=COLOURS[finding.verdict]),
            f"{judged}, {judged.holding}/{judged.scenes}",
            "-" if printed is None else f"{printed.mean_db:+.2f}",
            finding.claim.says + by_method,
        )
    if missing:
        table.caption = f"{missing} findings need tables that were not asked for"
    return table

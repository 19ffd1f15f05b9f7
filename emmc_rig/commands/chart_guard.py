"""`emmc-rig chart --guard`: PSNR of the default method against stored figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer


def chart_guard(
    scenes: Sequence[str], camera: Sequence[str] | None, size: tuple[int, int] | None, out: Path
) -> None:
    """Measure fixed captures, print them beside their stored figures; exit 1 where one fell."""
    from rich.console import Console
    from rich.table import Table

    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import write_metrics
    from emmc_rig.model.files import write_text
    from emmc_rig.study import guard

    stored = guard.stored_figures()
    chosen = guard.cases(scenes, size, (camera or [guard.CAMERA])[0])
    table, rows = Table("case", "dB", "stored dB", ""), []
    with result_folder(out, "chart --guard") as folder:
        for row in guard.guarded(chosen, stored):
            rows.append(row)
            was = "-" if row.stored_db is None else f"{row.stored_db:.2f}"
            word = "fell" if row.fell else "none stored" if row.stored_db is None else ""
            table.add_row(row.case.key, f"{row.psnr_db:.2f}", was, word)
        fallen = [row.case.key for row in rows if row.fell]
        write_text(folder / guard.STORED, guard.merged_text(rows, stored))
        metrics = {"psnr_db": {row.case.key: row.psnr_db for row in rows}, "fell": fallen}
        write_metrics(folder, metrics)
    Console().print(table)
    if fallen:
        typer.echo(
            f"{len(fallen)} figure(s) fell by more than {guard.MOST_FALL_DB} dB: "
            f"{'; '.join(fallen)}: fix the method, or store {out / guard.STORED} where intended",
            err=True,
        )
        raise typer.Exit(1)

"""`emmc-rig chart --stated`: what a reconstruction states of itself, against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer


def chart_stated(
    scenes: Sequence[str], camera: Sequence[str] | None, size: tuple[int, int] | None, out: Path
) -> None:
    """Measure stated PSNRs and deviations on fixed captures, and print them beside the truth."""
    from rich.console import Console
    from rich.table import Table

    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import command_line, versions, write_metrics
    from emmc_rig.study import guard
    from emmc_rig.study.stated import stated, summary

    chosen = guard.cases(scenes, size, (camera or [guard.CAMERA])[0])
    table = Table("case", "method", "stated dB", "true dB", "within one", "within two")
    rows = []
    with result_folder(out, "chart --stated") as folder:
        for row in stated(chosen):
            rows.append(row)
            expected = row.expected
            shares = [
                "-" if one is None else f"{one:.0%}" for one in (row.within_one, row.within_two)
            ]
            table.add_row(
                row.case.key,
                expected.method,
                f"{expected.psnr_db:.1f} ({expected.low_db:.1f} to {expected.high_db:.1f})",
                f"{row.true_db:.1f}" + ("" if row.inside else " (outside)"),
                *shares,
            )
        lines = summary(rows)
        metrics = {"rows": [row.as_dict() for row in rows], "summary": lines}
        write_metrics(folder, {**metrics, "command": command_line(), "versions": versions()})
    Console().print(table)
    for line in lines:
        typer.echo(line)

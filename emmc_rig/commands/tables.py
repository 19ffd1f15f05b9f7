"""The command `emmc-rig tables`: the paper's tables, ours beside the paper's."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import DictionaryOption, FastOption, OutOption, SeedOption
from emmc_rig.commands.output import give_result, show_table, shown_progress, tell


def tables(
    scenes: Annotated[
        Path | None,
        typer.Option("--scenes", help="a folder of scenes (default: the built-in ones)"),
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", help="some of table2, table3, table4; commas between")
    ] = None,
    fast: FastOption = False,
    dictionary: DictionaryOption = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-tables"),
) -> None:
    """Reproduce the paper's tables.

    The same command goes on where it stopped.
    """
    from emmc_rig.study.tables.tables_page import run_tables
    from emmc_rig.study.tables.tables_study import FAST, TablesSettings

    settings = (FAST if fast else TablesSettings()).model_copy(
        update={"seed": seed, "dictionary": dictionary}
    )
    with shown_progress() as bars:
        outcome = run_tables(scenes, out, only, settings, bars)
    for grid in outcome.grids:
        # Ours above the paper's: side by side the widest table does not fit a terminal.
        rows = [[cell.replace(" | ", "\n") for cell in row] for row in grid.rows]
        show_table(grid.heads, rows, grid.title)
    tell("PSNR in dB, the paper's below; compare figures within one run only")
    tell(f"{outcome.seconds:.0f} s; open {out / outcome.page.name}")
    give_result(out)

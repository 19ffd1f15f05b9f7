"""The command `emmc-rig tables`: the paper's tables and figures, ours beside the paper's."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import OutOption, SeedOption
from emmc_rig.commands.output import give_result, show, shown_progress, tell


def tables(
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="a folder of scenes (default: the built-in)")
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", help="table2,table3,table4,figure5,...,figure10")
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="crops and small dictionaries: minutes, not days")
    ] = False,
    dictionary: Annotated[
        list[str] | None,
        typer.Option(
            "--dictionary",
            help="a file, lambertian or dct; again for r = 1/4 (default: train leave-one-out)",
        ),
    ] = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-tables"),
) -> None:
    """Reproduce the paper's tables and figures; run it again to go on where it stopped."""
    from emmc_rig.study.tables.cell_sweep import FAST, TablesSettings
    from emmc_rig.study.tables.reproducing import run_tables, shown

    settings = (FAST if fast else TablesSettings()).model_copy(update={"seed": seed})
    with shown_progress() as bars:
        outcome = run_tables(scenes, out, only, dictionary or [], settings, bars)
    for part in shown(outcome.grids, outcome.findings):
        show(part)
    tell(f"{outcome.seconds:.0f} s; open {out / outcome.page.name}")
    give_result(out)

"""The command `emmc-rig tables`: the paper's tables, ours beside the paper's."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import DictionaryOption, FastOption, OutOption, SeedOption
from emmc_rig.commands.output import show_study, shown_progress


def tables(
    scenes: Annotated[
        Path | None,
        typer.Option("--scenes", help="a folder of scenes (default: the built-in ones)"),
    ] = None,
    only: Annotated[
        str | None, typer.Option("--only", help="some of table2,table3,table4 (default: all)")
    ] = None,
    fast: FastOption = False,
    dictionary: DictionaryOption = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-tables"),
) -> None:
    """Reproduce the paper's tables.

    The same command goes on where it stopped.
    """
    from emmc_rig.study.tables.cells import chosen_parts
    from emmc_rig.study.tables.tables_study import FAST, TablesSettings, TablesStudy, scene_specs

    settings = (FAST if fast else TablesSettings()).model_copy(
        update={"seed": seed, "dictionary": dictionary}
    )
    study = TablesStudy(settings, out, chosen_parts(only), scene_specs(scenes))
    with shown_progress() as bars:
        study.carry_out(bars)
    show_study(study, out)

"""The command `emmc-rig design`: which mask to order."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import OutOption, ScenesOption, SeedOption, size_option
from emmc_rig.commands.output import show_study, shown_progress


def design(
    bench: Annotated[
        Path | None,
        typer.Argument(
            help="a YAML file that describes the bench (default: the bench in docs/design.md)"
        ),
    ] = None,
    scene: ScenesOption = None,
    size: Annotated[str | None, size_option("96x96")] = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-design"),
) -> None:
    """Design the mask to order, by theory and simulation."""
    from emmc_rig.store.results import parse_size
    from emmc_rig.study.design.bench import load_bench
    from emmc_rig.study.design.designing import run_design

    described, sides = load_bench(bench), parse_size(size)
    with shown_progress() as bars:
        study = run_design(described, scene or [], sides, seed, out, bars)
    show_study(study, out)

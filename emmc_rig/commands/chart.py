"""The command `emmc-rig chart`: speed against accuracy of every method."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import (
    DictionaryOption,
    FastOption,
    MethodsOption,
    OutOption,
    ScenesOption,
    SeedOption,
    size_option,
)
from emmc_rig.commands.output import show_study, shown_progress


def chart(
    scene: ScenesOption = None,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            "--camera",
            help="a shipped camera or a YAML file; may repeat (default: four; with --fast two)",
        ),
    ] = None,
    fast: FastOption = False,
    method: MethodsOption = None,
    dictionary: DictionaryOption = None,
    size: Annotated[str | None, size_option("the whole; with --fast 64x80")] = None,
    repeats: Annotated[
        int | None,
        typer.Option(
            "--repeats", min=1, help="timed runs of each method (default: 5; with --fast 3)"
        ),
    ] = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-chart"),
) -> None:
    """Chart the speed and accuracy of every method.

    The same command goes on where it stopped.
    """
    from emmc_rig.store.results import parse_size
    from emmc_rig.study.chart.chart_points import chart_settings
    from emmc_rig.study.chart.charting import ChartStudy

    settings = chart_settings(
        fast, scene or [], camera or [], parse_size(size), repeats,
        methods=tuple(method or []), dictionary=dictionary, seed=seed,
    )  # fmt: skip
    study = ChartStudy(settings, out)
    with shown_progress() as bars:
        study.carry_out(bars)
    show_study(study, out)

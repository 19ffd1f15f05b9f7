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
    SizeOption,
)
from emmc_rig.commands.output import give_result, say, show_table, shown_progress, tell


def chart(
    scene: ScenesOption = None,
    camera: Annotated[
        list[str] | None,
        typer.Option("--camera", help="a shipped camera or a YAML file; may repeat"),
    ] = None,
    fast: FastOption = False,
    method: MethodsOption = None,
    dictionary: DictionaryOption = None,
    size: SizeOption = None,
    repeats: Annotated[
        int | None, typer.Option("--repeats", min=1, help="timed runs of each method")
    ] = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-chart"),
) -> None:
    """Chart the speed and accuracy of every method.

    The same command goes on where it stopped.
    """
    from emmc_rig.store.results import parse_size
    from emmc_rig.study.chart.chart_points import chart_settings
    from emmc_rig.study.chart.charting import run_chart

    settings = chart_settings(
        fast, scene or [], camera or [], parse_size(size), repeats,
        methods=tuple(method or []), dictionary=dictionary, seed=seed,
    )  # fmt: skip
    with shown_progress() as bars:
        outcome = run_chart(settings, out, bars)
    for panel in outcome.shown():
        rows = [
            (m.configuration.label, f"{m.seconds:.3g}", f"{m.psnr_db:.2f}") for m in panel.front()
        ]
        show_table(("method", "s", "dB"), rows, panel.title)
    for line in outcome.left_out:
        say("excluded", line)
    tell(f"{outcome.seconds:.0f} s; open {out / outcome.page.name}")
    give_result(out)

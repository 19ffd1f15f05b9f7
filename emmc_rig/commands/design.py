"""The command `emmc-rig design`: which mask to order."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import OutOption, ScenesOption, SeedOption, SizeOption
from emmc_rig.commands.output import give_result, say, show_table, shown_progress, tell


def design(
    bench: Annotated[
        Path | None,
        typer.Argument(
            help="a YAML file that describes the bench (default: one of docs/design.md)"
        ),
    ] = None,
    scene: ScenesOption = None,
    size: SizeOption = None,
    seed: SeedOption = 0,
    out: OutOption = Path("emmc-design"),
) -> None:
    """Design the mask to order, by theory and simulation."""
    from emmc_rig.store.results import parse_size
    from emmc_rig.study.design.bench import load_bench
    from emmc_rig.study.design.designing import run_design, simulated_table

    described = load_bench(bench)
    sides = parse_size(size)
    with shown_progress() as bars:
        designed = run_design(described, scene or [], sides, seed, out, bars)
    best = designed.found.expected
    loss_db = designed.found.ideal_db - best.psnr_db
    tell(designed.found.winner.label)
    tell(
        f"expected {best.psnr_db:.2f} dB, {best.light:.0%} of the light, Fresnel number "
        f"{best.fresnel:.2g}: diffraction loses {loss_db:.2f} dB"
    )
    show_table(*simulated_table(designed.simulated))
    tell(designed.verdict)
    for line in designed.left_out:
        say("note", line)
    tell(f"open {designed.page}")
    give_result(out)

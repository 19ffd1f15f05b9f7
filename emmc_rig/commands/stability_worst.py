"""`emmc-rig stability --worst`: the worst noise-sized perturbation, and small details."""

from __future__ import annotations

from pathlib import Path

import typer


def stability_worst(
    fast: bool,
    scenes: list[str],
    camera: str | None,
    methods: list[str],
    size: tuple[int, int] | None,
    dictionary: str | None,
    seed: int,
    out: Path,
) -> None:
    """Measure what harms every method most, and which details it keeps, loses or invents."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from emmc_rig.commands.bars import shown_bars
    from emmc_rig.study.stability.worst_study import (
        details_table,
        noise_table,
        run_worst,
        worst_settings,
    )

    settings = worst_settings(fast, scenes, camera, methods, size, dictionary, seed)
    with shown_bars() as bars:
        outcome = run_worst(settings, out, bars)
    for scene in settings.scenes:
        name = Path(scene).stem
        for heads, rows in (
            noise_table(name, outcome.noise),
            details_table(name, outcome.details),
        ):
            table = Table(*heads, box=SIMPLE, title=name)
            for row in rows:
                table.add_row(*row)
            Console().print(table)
    typer.echo(f"open {outcome.page}")

"""`emmc-rig stability --verdicts`: how often verdicts flag broken results and pass good ones."""

from __future__ import annotations

from pathlib import Path

import typer

from emmc_rig.errors import StoppedError


def stability_verdicts(
    fast: bool,
    scenes: list[str] | None,
    camera: str | None,
    faults: list[str] | None,
    methods: list[str] | None,
    size: tuple[int, int] | None,
    seed: int,
    out: Path,
) -> None:
    """Measure how often verdicts flag results that a fault broke, and good ones."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from emmc_rig.commands.bars import say, shown_bars
    from emmc_rig.study.stability.detector import (
        case_words,
        detector_settings,
        run_detector,
        tables,
        wrong,
    )

    settings = detector_settings(
        fast, scenes or [], camera, faults or [], methods or [], size, seed
    )
    try:
        with shown_bars() as bars:
            results = run_detector(settings, out, bars)
    except KeyboardInterrupt as stop:
        raise StoppedError(
            f"stopped by Ctrl-C; what is measured is kept in {out}: run it again"
        ) from stop
    table = Table(
        "fault",
        "method",
        "broken: flagged",
        "good: flagged",
        "between",
        "poor",
        "cannot tell",
        box=SIMPLE,
    )
    for (name, method), tally in tables(results).items():
        table.add_row(
            name,
            method,
            f"{tally.broken_flagged} of {tally.broken}",
            f"{tally.good_flagged} of {tally.good}",
            f"{tally.between_flagged} of {tally.between}",
            f"{tally.poor_flagged} of {tally.poor}",
            str(tally.untold),
        )
    Console().print(table)
    for one in wrong(results):
        kind = "missed" if one.kind == "broken" else "false alarm"
        say(kind, case_words(one))
    typer.echo(f"open {out / 'verdicts.csv'}")

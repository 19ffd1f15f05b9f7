"""`emmc-rig chart --next-shot`: how many shots scenes need, and what choosing them saves."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import typer


def chart_next_shot(
    scenes: list[str], camera: str, size: tuple[int, int], until: list[float], seed: int, out: Path
) -> None:
    """Measure how many shots scenes need for a PSNR, chosen one by one or in a fixed number."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    import emmc_rig as emmc
    from emmc_rig.commands.bars import shown_bars
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import write_metrics
    from emmc_rig.study.next_shot import ROWS, next_shots, savings, total_savings
    from emmc_rig.study.sweep import open_folder

    described = emmc.camera(camera)
    folder = open_folder(out, ROWS, "chart --next-shot")
    with shown_bars() as bars:
        found = next_shots(scenes, camera, described, size, seed, folder, bars)
    names = ("scene", "wanted, dB", "shots", "stated, dB", "in truth, dB", "fixed number")
    table = Table(*names, box=SIMPLE)
    rows = [one for scene in found for one in savings(scene, until)]
    for one in rows:
        table.add_row(
            one.scene,
            f"{one.target_db:g}",
            f"{one.stopped.count}" if one.reached else f"{one.stopped.count}, short",
            f"{one.stopped.stated_db:.2f}",
            f"{one.stopped.psnr_db:.2f}",
            "-" if one.fixed is None else str(one.fixed),
        )
    Console().print(table)
    for line in total_savings(rows):
        typer.echo(line)
    metrics = {
        "camera": camera,
        "size": list(size),
        "seed": seed,
        "rows": [row.as_dict() for row in rows],
        "scenes": [asdict(scene) for scene in found],
    }
    with result_folder(folder, "chart --next-shot", adds=True) as results:
        write_metrics(results, metrics)

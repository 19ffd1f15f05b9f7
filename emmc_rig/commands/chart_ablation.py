"""`emmc-rig chart --ablation`, `--constants`: what parts of `adaptive` and its constants buy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def chart_ablation(scene: str, camera: str, size: tuple[int, int], seed: int, out: Path) -> None:
    """Measure the adaptive method without each of its parts, and print a table."""
    from rich.console import Console
    from rich.table import Table

    import emmc_rig as emmc
    from emmc_rig.commands.bars import shown_bars
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import write_metrics
    from emmc_rig.study.ablation import AblationSweep, Exposure, ablations
    from emmc_rig.study.sweep import sweep_folder

    given = Exposure(scene, emmc.camera(camera), size, seed)
    command = "chart --ablation"
    with sweep_folder(out, AblationSweep.journal, command) as folder, shown_bars() as bars:
        rows = ablations(given, folder, bars)
        with result_folder(folder, command, adds=True) as new:
            figures = [row.as_dict() for row in rows]
            metrics = {"scene": scene, "camera": camera, "size": list(size), "rows": figures}
            write_metrics(new, metrics)
    table = Table("adaptive", "dB", "s", "buys dB", "costs s")
    for row in rows:
        table.add_row(
            row.name,
            f"{row.psnr_db:.2f}",
            f"{row.seconds:.1f}",
            f"{row.buys_db:+.2f}",
            f"{row.costs_s:+.1f}",
        )
    Console().print(table)


def chart_constants(
    scenes: Sequence[str], camera: str, size: tuple[int, int], seed: int, out: Path
) -> None:
    """Measure the adaptive method with twice and half of each constant, and print a table."""
    from rich.console import Console
    from rich.table import Table

    import emmc_rig as emmc
    from emmc_rig.commands.bars import say, shown_bars
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import write_metrics
    from emmc_rig.study.ablation import Exposure
    from emmc_rig.study.constants import ConstantSweep, constant_costs
    from emmc_rig.study.sweep import sweep_folder

    seen = emmc.camera(camera)
    command = "chart --constants"
    with sweep_folder(out, ConstantSweep.journal, command) as folder, shown_bars() as bars:
        exposures = [Exposure(scene, seen, size, seed) for scene in scenes]
        costs, left_out = constant_costs(exposures, folder, bars)
        with result_folder(folder, command, adds=True) as new:
            figures = [cost.as_dict() for cost in costs]
            metrics = {"scenes": list(scenes), "camera": camera, "size": list(size)}
            write_metrics(new, {**metrics, "rows": figures, "left_out": left_out})
    table = Table("constant", "value", "times", "costs dB", "at most")
    for cost in costs:
        lost = f"{cost.mean_db:+.2f}", f"{cost.worst_db:+.2f}"
        table.add_row(cost.constant, cost.value, f"{cost.factor:g}", *lost)
    Console().print(table)
    for line in left_out:
        say("left out", line)

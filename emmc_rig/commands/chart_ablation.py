"""`emmc-rig chart --ablation`: gain and cost of each part of the adaptive method."""

from __future__ import annotations

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

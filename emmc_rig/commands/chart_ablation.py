"""`emmc-rig chart --ablation`: what each piece of the adaptive method buys."""

from __future__ import annotations

from pathlib import Path


def chart_ablation(scene: str, camera: str, size: tuple[int, int], seed: int, out: Path) -> None:
    """Measure the adaptive method without each of its pieces, and print a table."""
    from rich.console import Console
    from rich.table import Table

    import emmc_rig as emmc
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import command_line, versions, write_metrics
    from emmc_rig.study.ablation import ablations

    table = Table("adaptive", "dB", "s", "buys dB", "costs s")
    rows = []
    with result_folder(out, "chart --ablation") as folder:
        for row in ablations(scene, emmc.camera(camera), size, seed):
            rows.append(row.as_dict())
            table.add_row(
                row.name,
                f"{row.psnr_db:.2f}",
                f"{row.seconds:.1f}",
                f"{row.buys_db:+.2f}",
                f"{row.costs_s:+.1f}",
            )
        metrics = {"scene": scene, "camera": camera, "size": list(size), "rows": rows}
        write_metrics(folder, {**metrics, "command": command_line(), "versions": versions()})
    Console().print(table)

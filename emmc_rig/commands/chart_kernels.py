"""`emmc-rig chart --kernels`: every kernel as a ratio to its memory bound, and start-up times."""

from __future__ import annotations

from pathlib import Path

import typer


def chart_kernels(camera: str, size: tuple[int, int], repeats: int, out: Path) -> None:
    """Time every kernel against its memory bound, and one reconstruction."""
    from rich.console import Console
    from rich.table import Table

    import emmc_rig as emmc
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import write_metrics
    from emmc_rig.study.benchmarks.kernels import kernel_timings, reconstruction_memory
    from emmc_rig.study.benchmarks.timing import start_timings

    described = emmc.camera(camera)
    table = Table("kernel", "GB counted", "ms", "GB/s", "times its bound")
    rows = []
    with result_folder(out, "chart --kernels") as folder:
        seconds, peak_gib = reconstruction_memory(camera, size)
        for timing in kernel_timings(described, size, repeats):
            rows.append(timing.as_dict())
            table.add_row(
                timing.name,
                f"{timing.gigabytes:.3f}",
                f"{timing.seconds * 1e3:.1f}",
                f"{timing.gigabytes / timing.seconds:.1f}",
                f"{timing.ratio:.2f}",
            )
        starts = start_timings(repeats)
        metrics = {
            "camera": camera,
            "size": list(size),
            "kernels": rows,
            "starts": [start.as_dict() for start in starts],
            "reconstruction_seconds": seconds,
            "reconstruction_peak_gib": peak_gib,
        }
        write_metrics(folder, metrics)
    Console().print(table)
    typer.echo(f"one TV reconstruction: {seconds:.1f} s, peak memory {peak_gib:.2f} GiB")
    for start in starts:
        typer.echo(f"{start.name}: {start.seconds:.2f} s to start")

"""`emmc-rig chart --solvers`: the sparse solvers, and scikit-learn's beside them."""

from __future__ import annotations

from pathlib import Path

import typer


def chart_solvers(camera: str, dictionary: str | None, out: Path) -> None:
    """Time the sparse solvers on one sensed dictionary, and those of another library."""
    from rich.console import Console
    from rich.table import Table

    import emmc_rig as emmc
    from emmc_rig.commands.bars import say
    from emmc_rig.errors import AppError
    from emmc_rig.files.dictionaries import open_dictionary
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import write_metrics
    from emmc_rig.study.benchmarks.sparse import TIMED_SIZE, peer_timings, solver_timings

    described = emmc.camera(camera)
    table = Table("solver", "ms/patch", "passes", "GFLOP/s", "times its bound", "gap", "dB")
    rows, peers = [], []
    with result_folder(out, "chart --solvers") as folder:
        atoms = open_dictionary(dictionary, described.views, described.sensor.binning)
        for timing in solver_timings(described, TIMED_SIZE, atoms):
            rows.append(timing.as_dict())
            table.add_row(
                timing.name,
                f"{timing.milliseconds:.2f}",
                f"{timing.passes:.0f}",
                f"{timing.gigaflops:.1f}",
                f"{timing.ratio:.1f}",
                f"{timing.gap:.1e}",
                f"{timing.psnr_db:.2f}",
            )
        Console().print(table)
        try:
            peers = [timing.as_dict() for timing in peer_timings(described, TIMED_SIZE, atoms)]
        except AppError as missing:
            say("not compared", missing)
        metrics = {
            "camera": camera,
            "dictionary": atoms.kind,
            "atoms": atoms.size,
            "solvers": rows,
            "peers": peers,
        }
        write_metrics(folder, metrics)
    for peer in peers:
        typer.echo(
            f"{peer['name']}: ours {peer['ours_ms']:.2f} ms a patch, scikit-learn's "
            f"{peer['theirs_ms']:.2f} ms: {peer['ratio']:.1f} times faster"
        )

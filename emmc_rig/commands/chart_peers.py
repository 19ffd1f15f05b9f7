"""`emmc-rig chart --peers`: the primal-dual step beside pyproximal's."""

from __future__ import annotations

from pathlib import Path


def chart_peers(camera: str, size: tuple[int, int], repeats: int, out: Path) -> None:
    """Time the primal-dual step, and that of another library."""
    from rich.console import Console
    from rich.table import Table

    import emmc_rig as emmc
    from emmc_rig.files.folders import result_folder
    from emmc_rig.files.results import write_metrics
    from emmc_rig.study.benchmarks.variational import variational_timings

    described = emmc.camera(camera)
    table = Table("primal-dual step", "ms", "times ours")
    rows = []
    with result_folder(out, "chart --peers") as folder:
        for timing in variational_timings(described, size, repeats):
            rows.append(timing.as_dict())
            table.add_row(timing.name, f"{timing.seconds * 1e3:.1f}", f"{timing.times_ours:.1f}")
        metrics = {"camera": camera, "size": list(size), "steps": rows}
        write_metrics(folder, metrics)
    Console().print(table)

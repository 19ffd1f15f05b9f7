"""The command `emmc-rig train`: a dictionary of light-field patches from scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import SeedOption


def train(
    out: Annotated[Path, typer.Option("--out", help="the dictionary to write, FILE.h5")],
    scenes: Annotated[
        list[str] | None,
        typer.Option(
            "--scenes",
            help="a folder of scenes, a scene, or a built-in name; may repeat "
            "(default: the built-in scenes)",
        ),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option("--leave-out", help="a scene not to train on, by its name; may repeat"),
    ] = None,
    views: Annotated[
        str | None, typer.Option("--views", help="ROWSxCOLUMNS, the middle ones (default: all)")
    ] = None,
    kind: Annotated[str, typer.Option("--kind", help="ksvd, online or separable")] = "ksvd",
    atoms: Annotated[int, typer.Option("--atoms", help="number of atoms")] = 1024,
    patch: Annotated[str, typer.Option("--patch", help="ROWSxCOLUMNS of a patch")] = "9x9",
    patches: Annotated[int, typer.Option("--patches", help="patches to train on")] = 10_000,
    sparsity: Annotated[int, typer.Option("--sparsity", help="atoms per patch at most")] = 8,
    iterations: Annotated[int, typer.Option("--iterations", help="steps in all")] = 15,
    seed: SeedOption = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="go on where the same training stopped")
    ] = False,
) -> None:
    """Train a dictionary of light-field patches; Ctrl-C leaves a checkpoint for --resume."""
    from emmc_rig.commands.bars import shown_bars
    from emmc_rig.files.results import parse_size
    from emmc_rig.reconstruct.training import picture_path, train_settings
    from emmc_rig.reconstruct.training import train as run

    size, grid = parse_size(patch, "--patch", "9x9"), parse_size(views, "--views", "5x5")
    assert size is not None
    chosen = {
        "patches": {"rows": size[0], "columns": size[1], "count": patches, "seed": seed},
        "learning": {"atoms": atoms, "sparsity": sparsity, "iterations": iterations, "seed": seed},
    }
    settings = train_settings(out, scenes or (), leave_out or (), grid, kind, chosen, resume)
    with shown_bars() as bars:
        dictionary, provenance = run(settings, bars)
    last = provenance["history"][-1]
    typer.echo(
        f"{dictionary.size} atoms from {patches} patches of {len(provenance['sources'])} "
        f"scene(s): error {last['updated_rmse'] or last['coded_rmse']:.5f} with {sparsity} atoms "
        f"per patch; {provenance['learning_seconds']:.1f} s, peak memory "
        f"{provenance['peak_memory_gib']:.2f} GiB"
    )
    typer.echo(f"wrote {out}; its atoms: {picture_path(out)}")

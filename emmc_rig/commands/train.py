"""The command `emmc-rig train`: a dictionary of patches, a network, or a coded aperture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import SeedOption
from emmc_rig.commands.output import give_result, shown_progress, tell

NETWORK_CAMERAS = (
    "scenario-ii-cfa", "rgbw-bayer-1shot", "rgbw-bayer-3shots", "rgbw-mono",
)  # fmt: skip


def train(
    out: Annotated[
        Path, typer.Option("--out", help="the file to write: FILE.h5, of --aperture FILE.yaml")
    ],
    scenes: Annotated[
        list[str] | None,
        typer.Option(
            "--scenes",
            help="a folder of scenes, a scene, or a built-in name; may repeat "
            "(default: the built-in scenes; of --network random worlds alone)",
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
    network: Annotated[
        bool,
        typer.Option(
            "--network", help="instead: the network of `unrolled`, on random worlds, and --scenes"
        ),
    ] = False,
    camera: Annotated[
        list[str] | None,
        typer.Option(
            "--camera",
            help="of --network: whose kinds of masks it sees, may repeat; of --aperture: whose "
            "transmittances are learned (default: learned-aperture)",
        ),
    ] = None,
    aperture: Annotated[
        bool, typer.Option("--aperture", help="instead: the masks in the plane of a lens")
    ] = False,
    steps: Annotated[int, typer.Option("--steps", min=1, help="of --network, in all")] = 6000,
    minutes: Annotated[
        float | None,
        typer.Option("--minutes", min=0, help="of --network: then write it; --resume goes on"),
    ] = None,
) -> None:
    """Train a dictionary of patches or a network (Ctrl-C leaves a checkpoint), or an aperture."""
    from emmc_rig.files.results import parse_size

    if aperture:
        _train_aperture(out, camera or ["learned-aperture"], seed)
        return
    if network:
        _train_network(
            out, camera or list(NETWORK_CAMERAS), views, steps, minutes, seed, resume,
            scenes or [], leave_out or [],
        )  # fmt: skip
        return
    from emmc_rig.processing.training import picture_path, train_settings
    from emmc_rig.processing.training import train as run

    size, grid = parse_size(patch, "--patch", "9x9"), parse_size(views, "--views", "5x5")
    assert size is not None
    chosen = {
        "patches": {"rows": size[0], "columns": size[1], "count": patches, "seed": seed},
        "learning": {"atoms": atoms, "sparsity": sparsity, "iterations": iterations, "seed": seed},
    }
    settings = train_settings(out, scenes or (), leave_out or (), grid, kind, chosen, resume)
    with shown_progress() as bars:
        dictionary, provenance = run(settings, bars)
    last = provenance["history"][-1]
    tell(
        f"{dictionary.size} atoms from {patches} patches of {len(provenance['sources'])} "
        f"scene(s): error {last['updated_rmse'] or last['coded_rmse']:.5f} with {sparsity} atoms "
        f"per patch; {provenance['learning_seconds']:.1f} s, peak memory "
        f"{provenance['peak_memory_gib']:.2f} GiB"
    )
    tell(f"wrote {out}; its atoms: {picture_path(out)}")
    give_result(out, provenance=provenance)


def _train_network(
    out: Path,
    cameras: list[str],
    views: str | None,
    steps: int,
    minutes: float | None,
    seed: int,
    resume: bool,
    scenes: list[str],
    leave_out: list[str],
) -> None:
    from emmc_rig.files.results import parse_size
    from emmc_rig.processing.network_training import NetworkTraining, train_network
    from reconstruction.unrolled.weights import Architecture

    architecture = Architecture(views=parse_size(views, "--views", "5x5") or (5, 5))
    training = NetworkTraining(
        out, tuple(cameras), architecture, steps, tuple(scenes), tuple(leave_out), minutes,
        seed=seed, resume=resume,
    )  # fmt: skip
    with shown_progress() as bars:
        weights, learner = train_network(training, bars)
    count = sum(array.size for array in weights.arrays.values())
    last = learner.losses_db[-max(1, learner.steps // 20) :]
    tell(
        f"{count} weights after {learner.steps} of {steps} steps: {sum(last) / len(last):.2f} dB "
        "on the last twentieth of what it saw"
    )
    tell(f"wrote {out}")
    give_result(out, weights=count, steps=learner.steps, psnr_db=sum(last) / len(last))


def _train_aperture(out: Path, cameras: list[str], seed: int) -> None:
    from emmc_rig.processing.aperture_training import ApertureTraining, train_aperture

    if len(cameras) > 1:
        raise typer.BadParameter("--aperture learns the masks of one --camera")
    with shown_progress() as bars:
        figures = train_aperture(ApertureTraining(out, cameras[0], seed=seed), bars)
    tell(
        f"expected by the best linear decoder: {figures['before_db']:.2f} dB as the camera was, "
        f"{figures['after_db']:.2f} dB now; from other starts "
        + ", ".join(f"{end:.2f}" for end in figures["ends_db"][1:])
    )
    tell(f"wrote {out}")
    give_result(out, **figures)

"""The command `emmc-rig demo`: the whole loop on the simulated rig, and its report."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.modes import given_names, refuse
from emmc_rig.commands.options import (
    DEFAULT_CAMERA,
    CameraOption,
    DictionaryOption,
    MethodOption,
    OutOption,
    SceneOption,
    SeedOption,
    ShotsOption,
    size_option,
)
from emmc_rig.commands.output import give_result, say, show_verdict, shown_progress, tell

DEMO_SCENE = "toy-table"
"""Large even surfaces, sharp edges and letters: what a light field of few pixels can show well."""


def demo(
    context: typer.Context,
    scene: SceneOption = DEMO_SCENE,
    camera: CameraOption = DEFAULT_CAMERA,
    shots: ShotsOption = None,
    seed: SeedOption = 0,
    size: Annotated[str | None, size_option("the whole; of a built-in scene 108x144")] = None,
    method: MethodOption = None,
    exact_psi: Annotated[
        bool, typer.Option("--exact-psi", help="reconstruct with the exact Psi too, for comparison")
    ] = False,
    dictionary: DictionaryOption = None,
    own_data: Annotated[
        Path | None,
        typer.Option(
            "--own-data",
            help="only write a folder of files to import: frames, a mask's photograph, a camera",
        ),
    ] = None,
    out: OutOption = Path("emmc-demo"),
) -> None:
    """Try it on a simulated rig: calibrate, capture, reconstruct.

    The method adaptive runs here without TV + dictionary.
    """
    if own_data is not None:
        _write_own_data(own_data, seed)
        return
    import emmc_rig as emmc
    from emmc_rig.commands.first_run import helped_to_compile
    from emmc_rig.demo import DemoSettings, run_demo
    from emmc_rig.model.view_axes import middle_name
    from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
    from emmc_rig.reconstruction.methods import DEFAULT_METHOD, MethodSettings, find_method
    from emmc_rig.store.folders import result_folder
    from emmc_rig.store.results import parse_size

    method = method or DEFAULT_METHOD
    if not find_method(method).needs_dictionary:
        refuse(context, given_names(context) & {"dictionary"}, f"on --method {method}")
    described = emmc.camera(camera, shots)
    # TV + dictionary gains 0.1 dB on the built-in scenes, for twice the time.
    solver = MethodSettings(adaptive=AdaptiveSettings(patches=None))
    settings = DemoSettings(
        scene,
        camera,
        described,
        parse_size(size),
        seed,
        method=method,
        dictionary=dictionary,
        solver=solver,
        exact_psi=exact_psi,
        out=str(out),
    )
    for warning in described.warnings():
        say("warning", warning)
    with (
        result_folder(out, "demo") as folder,
        shown_progress() as bars,
        helped_to_compile(method, camera, shots),
    ):
        metrics = run_demo(settings, folder, bars)
    gain, middle = (
        metrics["psnr_db"] - metrics["replicate_psnr_db"],
        middle_name(described.view_axes),
    )
    tell(
        f"PSNR {metrics['psnr_db']:.2f} dB from {metrics['shots']} "
        f"shot{'s' * (metrics['shots'] > 1)}, {gain:+.2f} dB over the baseline "
        f"({middle} in all places); SSIM {metrics['ssim']:.3f}; "
        + f"calibration error {metrics['psi_relative_error']:.2%}; {metrics['status']}"
        + (f" ({metrics['advice']})" if metrics["advice"] else "")
    )
    tell(f"open {out / 'report.html'}")
    show_verdict(metrics)
    give_result(out)


def _write_own_data(out: Path, seed: int) -> None:
    """Write the folder of --own-data, and print the commands that go on from it."""
    from emmc_rig import own_data
    from emmc_rig.store.folders import refuse_filled, result_folder

    refuse_filled(out)
    with result_folder(out, "demo --own-data") as folder, shown_progress() as bars:
        counts = own_data.write_own_data(folder, seed, bars)
    mask, photo, table, camera = (
        shlex.quote(str(out / name))
        for name in ("mine.png", own_data.PHOTO, own_data.TABLE, own_data.CAMERA_FILE)
    )
    rows, columns = own_data.CELLS
    frames = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    tell(f"{counts.total()} frames ({frames}), the camera's file and a photograph, in {out}")
    tell(
        f"go on with: emmc-rig mask {photo} --cells {rows}x{columns} "
        f"--cell-um {own_data.CELL_UM} --out {mask}"
    )
    tell(f"then: emmc-rig import {table} --camera {camera} --out bench")
    tell("then: emmc-rig reconstruct bench")
    give_result(out, frames=counts.total(), seed=seed)

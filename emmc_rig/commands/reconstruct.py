"""The command `emmc-rig reconstruct`: a folder of frames to a light field, by any method."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import DictionaryOption
from emmc_rig.commands.verdict import end_with_verdict


def reconstruct(
    frames: Annotated[
        Path | None,
        typer.Argument(help="a session of `capture`, or a folder that `demo` or `simulate` wrote"),
    ] = None,
    method: Annotated[
        str | None, typer.Option("--method", help="see --list (default: adaptive)")
    ] = None,
    list_methods: Annotated[
        bool, typer.Option("--list", help="the methods: what each assumes, costs, is for")
    ] = False,
    psi: Annotated[
        Path | None,
        typer.Option("--psi", help="imaging matrix (default: psi.h5 beside the frames)"),
    ] = None,
    dictionary: DictionaryOption = None,
    settings: Annotated[
        Path | None, typer.Option("--settings", help="YAML of method settings: tv, sparse")
    ] = None,
    truth: Annotated[
        str | None, typer.Option("--truth", help="the scene that was captured, to compare with")
    ] = None,
    tile: Annotated[
        int | None, typer.Option("--tile", min=1, help="in tiles of so many samples: less memory")
    ] = None,
    budget: Annotated[
        str | None, typer.Option("--budget", help="choose the best method for a time, as 30s")
    ] = None,
    want: Annotated[
        str | None, typer.Option("--want", help="choose the quickest method for a PSNR, as 28dB")
    ] = None,
    chart_folder: Annotated[
        Path | None,
        typer.Option("--chart", help="of `emmc-rig chart`, to choose by (default: the shipped)"),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="exit with 1 when the verdict is: do not use")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="folder to write (default: emmc-reconstruction; of a session, in the session)",
        ),
    ] = None,
) -> None:
    """Reconstruct the light field of a folder of frames, by any method."""
    from emmc_rig.commands.bars import console, say, shown_bars
    from emmc_rig.files.folders import is_session, result_folder
    from emmc_rig.reconstruct.inputs import load_settings
    from emmc_rig.reconstruct.solve import reconstruct_folder
    from emmc_rig.reconstruct.tiles import reconstruct_folder_in_tiles
    from emmc_rig.session.session import RECONSTRUCTION
    from reconstruction.methods import DEFAULT_METHOD

    if list_methods:
        _list_methods()
        return
    if frames is None:
        raise typer.BadParameter("name a folder of frames, or --list the methods")
    chosen, why = load_settings(settings), None
    if budget is not None or want is not None:
        if method is not None or settings is not None:
            raise typer.BadParameter("--budget and --want choose the method and its settings")
        from emmc_rig.advice.recommend import advice_for
        from emmc_rig.files.frames import PSI
        from emmc_rig.model.sensing import ImagingMatrix

        advice = advice_for(ImagingMatrix.load(psi or frames / PSI), budget, want, chart_folder)
        method, chosen, why = advice.method, advice.settings, advice.why
        console.print(why, highlight=False, soft_wrap=True)
    elif chart_folder is not None:
        raise typer.BadParameter("--chart serves --budget and --want")
    method = method or DEFAULT_METHOD
    place = frames / RECONSTRUCTION if is_session(frames) else None
    out = out or place or Path("emmc-reconstruction")
    results = result_folder(out, "reconstruct", belongs_to=place)
    if tile is not None:
        if truth is not None:
            raise typer.BadParameter(
                "--truth needs the whole light field in memory, without --tile"
            )
        with results as folder, shown_bars() as bars:
            bars.begin(f"{method} in tiles", None)
            metrics = reconstruct_folder_in_tiles(
                frames, folder, method, tile, psi, dictionary, chosen, lambda *_: bars.step("")
            )
        typer.echo(f"{method}: {metrics['tiles']} tiles in {metrics['seconds']:.1f} s")
        typer.echo(f"read {out / 'light_field.h5'}")
        end_with_verdict(metrics["verdict"], strict)
        return
    with results as folder, shown_bars() as bars:
        bars.begin(method, None)
        metrics = reconstruct_folder(
            frames, folder, method, psi, dictionary, chosen, truth,
            lambda step: bars.advance(step), why,
        )  # fmt: skip
    for line in metrics["screening"]:
        say("screening", line)
    for line in metrics.get("left_out", ()):
        say("not modelled", line, "cyan")
    compared = ""
    if "psnr_db" in metrics:
        gain = metrics["psnr_db"] - metrics["replicate_psnr_db"]
        compared = (
            f"; {metrics['psnr_db']:.2f} dB, {gain:+.2f} dB against the copied centre view, "
            f"SSIM {metrics['ssim']:.3f}"
        )
    typer.echo(
        f"{metrics['method']}: {metrics['status']} in {metrics['seconds']:.1f} s{compared}"
        + (f" ({metrics['advice']})" if metrics["advice"] else "")
    )
    typer.echo(f"open {out / 'pictures'}")
    end_with_verdict(metrics["verdict"], strict)


def _list_methods() -> None:
    from reconstruction.method import COSTS
    from reconstruction.methods import METHODS

    for known in METHODS.values():
        typer.echo(f"{known.name}: {known.title}")
        typer.echo(f"    assumes  {known.assumes}")
        typer.echo(f"    use it   {known.when}")
        typer.echo(f"    costs    {known.cost}")
    typer.echo(COSTS)

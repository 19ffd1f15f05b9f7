"""The command `emmc-rig reconstruct`: a folder of frames to a light field, by any method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from emmc_rig.commands.options import (
    PARALLEL_PANEL,
    ClusterOption,
    DictionaryOption,
    MethodOption,
    TruthOption,
    WorkersOption,
    ZarrOption,
    check_workers,
    out_option,
)
from emmc_rig.commands.output import give_result, say, show_verdict, shown_progress, tell
from emmc_rig.store.folders import WRITTEN_BY, refuse_missing

if TYPE_CHECKING:
    from emmc_rig.process.captures import Capture
    from emmc_rig.process.reconstructing import Place

DEFAULT = Path("emmc-reconstruction")
"""The folder that is written, unless it is in a session."""


def reconstruct(
    frames: Annotated[
        list[Path] | None,
        typer.Argument(help="sessions, or folders that `demo` or `simulate` wrote"),
    ] = None,
    method: MethodOption = None,
    list_methods: Annotated[
        bool,
        typer.Option("--list", help="list the methods: what each assumes and how long it takes"),
    ] = False,
    psi: Annotated[
        Path | None,
        typer.Option("--psi", help="the imaging matrix (default: beside the frames)"),
    ] = None,
    dictionary: DictionaryOption = None,
    settings: Annotated[
        Path | None,
        typer.Option(
            "--settings",
            help="YAML file of settings, by method: tv, sparse, adaptive, film, blocks",
        ),
    ] = None,
    truth: TruthOption = None,
    without_shots: Annotated[
        list[int] | None,
        typer.Option("--without-shots", help="exclude a shot, counted from 1; may repeat"),
    ] = None,
    frame: Annotated[
        int | None,
        typer.Option("--frame", min=0, help="one frame of a film alone, counted from 0"),
    ] = None,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    as_zarr: ZarrOption = False,
    memory: Annotated[
        str | None,
        typer.Option(
            "--memory",
            help="memory of all processes together at most, such as 2GiB (default: no limit)",
            rich_help_panel=PARALLEL_PANEL,
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option("--budget", help="choose the most accurate method within a time, such as 30s"),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="exit code 1 where the verdict is: do not use")
    ] = False,
    out: Annotated[Path | None, out_option("in a session, else emmc-reconstruction")] = None,
) -> None:
    """Reconstruct light fields from frames, or a film of them, with a verdict."""
    if list_methods:
        _list_methods()
        return
    if frames is not None and len(frames) == 1:
        refuse_missing(frames[0], WRITTEN_BY)  # before the methods load, for a second
    from emmc_rig.commands.first_run import helped_to_compile
    from emmc_rig.process.captures import opened_capture
    from emmc_rig.process.cost import method_within, parse_memory
    from emmc_rig.process.reconstructing import load_settings, reconstruct_captures
    from emmc_rig.reconstruction.methods import DEFAULT_METHOD, find_method

    if not frames:
        raise typer.BadParameter(
            "name a session or a folder of frames, or list the methods by --list"
        )
    check_workers(workers, cluster)
    if memory is not None and cluster is not None:
        raise typer.BadParameter("--memory is for this machine only: leave it out with --cluster")
    chosen, limit = load_settings(settings), None if memory is None else parse_memory(memory)
    captures = [opened_capture(folder) for folder in frames]
    films = [capture for capture in captures if capture.planned_frames]
    if films and frame is None:
        ignored = {
            "--truth": truth, "--without-shots": without_shots, "--zarr": as_zarr,
            "--budget": budget, "--dictionary": dictionary,
        }  # fmt: skip
        if len(frames) > 1:
            raise typer.BadParameter("a film is reconstructed alone: name one session")
        for name, given in ignored.items():
            if given:
                raise typer.BadParameter(
                    f"{name}: no effect on a whole film; leave it out, or choose a frame by --frame"
                )
        ((_, written),) = _places(captures, out)
        _film(
            films[0], written, strict, method=method or DEFAULT_METHOD, psi_path=psi,
            settings=chosen, memory=limit, workers=workers, cluster=cluster,
        )  # fmt: skip
        return
    if frame is not None and not (films and len(frames) == 1):
        raise typer.BadParameter(
            "--frame: chooses a frame of a film; name one session that holds a film"
        )
    why = None
    if budget is not None:
        if method is not None or settings is not None:
            raise typer.BadParameter(
                "--budget chooses method and settings: leave --method and --settings out"
            )
        method, why = method_within(*captures[0].loaded(psi, frame), budget)
        say("chosen", why, "cyan")
    method = method or DEFAULT_METHOD
    if dictionary is not None and not find_method(method).needs_dictionary:
        raise typer.BadParameter(f"--dictionary: no effect on --method {method}; leave it out")
    places = _places(captures, out if frame is None else out or DEFAULT)
    with shown_progress() as bars, helped_to_compile(method):
        bars.begin(method if len(places) == 1 else f"{method}, {len(places)} captures", None)
        outcomes = list(
            reconstruct_captures(
                places, workers, cluster, limit, bars,
                method=method, psi_path=psi, dictionary_spec=dictionary, settings=chosen,
                truth=truth, chosen=why, as_zarr=as_zarr, without_shots=without_shots or (),
                frame=frame,
            )
        )  # fmt: skip
        if len(outcomes) == 1 and isinstance(outcomes[0][1], Exception):
            raise outcomes[0][1]
    _show_outcomes(outcomes, strict)


def _show_outcomes(outcomes: Sequence[tuple[Place, dict | Exception]], strict: bool) -> None:
    """Print each capture's result or error; raises Exit for an error.

    strict: also for a light field with the verdict "do not use".
    """
    failed = False
    for (capture, written), outcome in outcomes:
        if len(outcomes) > 1:
            tell(f"{capture.folder}:")
        if isinstance(outcome, Exception):
            tell(f"failed: {outcome}", "red")
            failed = True
            continue
        _say_result(outcome, written)
        show_verdict(outcome)
        give_result(written)
        failed |= strict and outcome["verdict"]["level"] == "do not use"
    if failed:
        raise typer.Exit(1)


def _film(capture: Any, out: Path, strict: bool, **given: Any) -> None:
    """Reconstruct a film, and say in a line how that went; given: to `reconstruct_film_session`.

    capture: a `SessionCapture`.
    """
    from emmc_rig.commands.first_run import helped_to_compile
    from emmc_rig.process.filming import reconstruct_film_session
    from emmc_rig.store.results import shown_seconds, stated_words

    with shown_progress(given["method"]) as bars, helped_to_compile(given["method"]):
        metrics = reconstruct_film_session(capture, out, watcher=bars, **given)
    film = metrics["film"]
    if "assumed" in metrics:
        say("note", metrics["assumed"])
    for frame, why in film["failed"].items():
        say(f"frame {frame}", why)
    worst, count = film["worst"], sum(film["verdicts"].values())
    stated = stated_words(worst)
    tell(
        f"{metrics['method']}: {count} of {film['frames']} frames in "
        f"{shown_seconds(metrics['seconds'])}, {film['seconds_per_frame']:.1f} s each; trusted: "
        f"{film['verdicts']['trust']}; worst: frame {worst['frame']} at {worst['time_s']:.1f} s"
        + (f", estimated accuracy {stated}" if stated else "")
    )
    tell(
        f"kept from earlier frames, as readings did not change: {film['still_share']:.0%} of the "
        f"pixels; frames that begin anew: {', '.join(map(str, film['begun_anew'])) or 'none'}"
    )
    show_verdict(metrics)
    shown = capture.folder if out == capture.own_place else out
    tell(f"emmc-rig export {shown} shows it")
    give_result(out)
    if strict and film["verdicts"]["do not use"]:
        raise typer.Exit(1)


def _places(captures: Sequence[Capture], out: Path | None) -> list[tuple[Capture, Path]]:
    """Return each capture with the folder to write."""
    if len(captures) == 1:
        return [(captures[0], out or captures[0].own_place or DEFAULT)]
    names = [capture.folder.resolve().name for capture in captures]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice and not (out is None and all(capture.own_place for capture in captures)):
        raise typer.BadParameter(
            f"several captures are named {twice[0]}, and --out gets a folder for each name: rename "
            "one"
        )
    return [
        (capture, (out is None and capture.own_place) or (out or DEFAULT) / name)
        for capture, name in zip(captures, names, strict=True)
    ]


def _say_result(metrics: dict, out: Path) -> None:
    from emmc_rig.model.view_axes import axes_of, middle_name
    from emmc_rig.store.results import unmeasured_words

    if "assumed" in metrics:
        say("note", metrics["assumed"])
    if unmeasured := unmeasured_words(metrics):
        say("note", unmeasured)
    for line in metrics["screening"]:
        say("clean-up", line)
    compared = ""
    if "psnr_db" in metrics:
        gain = metrics["psnr_db"] - metrics["replicate_psnr_db"]
        compared = (
            f"; PSNR {metrics['psnr_db']:.2f} dB, {gain:+.2f} dB over the baseline "
            f"({middle_name(axes_of(metrics))} in all places), SSIM {metrics['ssim']:.3f}"
        )
    if "blocks" in metrics:
        rows, columns = metrics["blocks"]
        compared += f"; {rows}x{columns} blocks, at most {metrics['peak_gib']:.2f} GiB a worker"
    tell(
        f"{metrics['method']}: {metrics['status']} in {metrics['seconds']:.1f} s{compared}"
        + (f" ({metrics['advice']})" if metrics["advice"] else "")
    )
    written = ("report.html", "light_field.h5", "result.zarr")
    shown = next(out / name for name in written if (out / name).exists())
    tell(f"open {shown}")


def _list_methods() -> None:
    from emmc_rig.reconstruction.methods import METHODS

    for known in METHODS.values():
        tell(f"{known.name}: {known.title}")
        tell(f"    assumes  {known.assumes}")
        tell(f"    use for  {known.when}")
        tell(f"    takes    {known.cost}")
    give_result(methods=list(METHODS))

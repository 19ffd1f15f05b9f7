"""The command `emmc-rig calibrate`: whiteboards to Psi, and their plan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emmc_rig.commands.options import SIZE_VARIABLE, out_option
from emmc_rig.commands.output import give_result, say, shown_progress, tell
from emmc_rig.errors import AppError

DEFAULT_CAMERA = "rgbw-bayer-1shot"
DEFAULT_OUT = "in the session; with --plan emmc-calibration, with --drift emmc-drift"


def calibrate(
    session: Annotated[
        Path | None,
        typer.Argument(help="a session with whiteboards, as `capture` writes it"),
    ] = None,
    camera: Annotated[
        str, typer.Option("--camera", help="with --plan: a shipped camera or a YAML file")
    ] = DEFAULT_CAMERA,
    size: Annotated[
        str,
        typer.Option(
            "--size", envvar=SIZE_VARIABLE, help="with --plan: ROWSxCOLUMNS of the light field"
        ),
    ] = "192x256",
    method: Annotated[
        str,
        typer.Option("--method", help="auto (the best by validation), parametric, mixed or free"),
    ] = "auto",
    plan: Annotated[
        bool, typer.Option("--plan", help="plan the whiteboards: writes plan.yaml for `capture`")
    ] = False,
    drift: Annotated[
        Path | None,
        typer.Option(
            "--drift",
            help="a folder with frames.h5: check the Psi of --known by it, and correct its drift",
        ),
    ] = None,
    known: Annotated[
        Path | None, typer.Option("--known", help="with --drift: the folder of a calibration")
    ] = None,
    target: Annotated[
        float, typer.Option("--target", help="with --plan: relative error of Psi to reach")
    ] = 0.005,
    frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            min=1,
            help="with --plan: frames at most (default: as few as reach --target)",
        ),
    ] = None,
    few: Annotated[
        bool,
        typer.Option(
            "--few",
            help="with --plan: about ten whiteboards in place of one of every view, for a mask as "
            "designed",
        ),
    ] = False,
    skip: Annotated[
        str | None,
        typer.Option(
            "--skip",
            help="with --plan: whiteboards that the rig cannot take: lamp, response, colours, "
            "turned, aperture, mask; commas between",
        ),
    ] = None,
    sensor: Annotated[
        bool,
        typer.Option(
            "--sensor", help="characterise the sensor too (EMVA 1288): writes sensor.json"
        ),
    ] = False,
    out: Annotated[Path | None, out_option(DEFAULT_OUT)] = None,
) -> None:
    """Measure Psi from a session's whiteboards.

    Or plan these by --plan, or correct Psi for drift by --drift.
    """
    from emmc_rig.store.results import parse_size

    if drift is not None:
        if known is None:
            raise typer.BadParameter("--drift needs --known, a folder that `calibrate` wrote")
        _check_drift(known, drift, out or Path("emmc-drift"))
    elif session is not None:
        _calibrate_session(session, method, out, sensor)
    elif plan:
        if not 0 < target < 1:
            raise AppError(f"--target {target:g}: a relative error lies between 0 and 1")
        shape = parse_size(size)
        assert shape is not None
        skipped = frozenset(skip.split(",") if skip else ())
        _plan_whiteboards(camera, shape, target, frames, skipped, few, out)
    else:
        raise typer.BadParameter("name a session, or plan its whiteboards by --plan")


def _plan_whiteboards(
    camera: str,
    size: tuple[int, int],
    target: float,
    most_frames: int | None,
    skipped: frozenset[str],
    few: bool,
    out: Path | None,
) -> None:
    """Write a plan of whiteboards that measure Psi to the relative error `target`."""
    from emmc_rig.captures.board_plan import PlanSettings, write_plan
    from emmc_rig.formats.cameras import find_camera
    from emmc_rig.store.folders import result_folder

    settings = PlanSettings(camera, find_camera(camera), size, target, most_frames, skipped, few)
    out = out or Path("emmc-calibration")
    with result_folder(out, "calibrate --plan") as folder, shown_progress("plan"):
        metrics = write_plan(settings, folder)
    tell(
        f"{metrics['frames']} frames, and {metrics['shots']} of the scene; expected calibration "
        f"error {metrics['expected_relative_error']:.2%}"
    )
    if wanted := metrics["few_would_take_frames"]:
        tell(f"planned one whiteboard of every view: with --few it would be {wanted} frames")
    tell(f"next: emmc-rig capture {out / 'plan.yaml'} --rig RIG.yaml")
    give_result(out)


def _calibrate_session(path: Path, method: str, out: Path | None, sensor: bool) -> None:
    from emmc_rig.process.session_calibration import SENSOR, calibrate_into
    from emmc_rig.session.measured_psi import stored_calibration
    from emmc_rig.session.session import CALIBRATION, Session
    from emmc_rig.store.folders import result_folder
    from emmc_rig.store.result_files import read_metrics

    captured, place = Session(path), path / CALIBRATION
    product, words = stored_calibration(captured) if out is None else (None, "")
    out, sheet = out or place, None
    known = product is not None and product.inputs["method"] == method
    if known and (not sensor or (place / SENSOR).is_file()):
        say("note", f"nothing new to measure: {words}")
        metrics = read_metrics(place)
    else:
        with result_folder(out, "calibrate", belongs_to=place) as folder, shown_progress() as bars:
            calibration = calibrate_into(folder, captured, method, sensor, bars)
        metrics, sheet = calibration.metrics, calibration.sensor
    chosen = metrics["chosen"]
    judged = metrics["held_out"][chosen]
    tell(
        f"{metrics['why']}, {metrics['frames'][chosen]} frames; validation whiteboard predicted "
        f"to {judged['relative_error']:.2%}"
    )
    for label, key in (("finding: ", "findings"), ("", "unwatched"), ("advice: ", "advice")):
        for line in metrics[key]:
            tell(label + line)
    for row in () if sheet is None else sheet.rows():
        spread = "" if row.deviation is None else f" +- {row.deviation:.2g}"
        tell(f"    {row.title}: {row.value:.5g}{spread} {row.unit}".rstrip())
    tell(f"open {out / 'report.html'}")
    give_result(out)


def _check_drift(known: Path, frames: Path, out: Path) -> None:
    from emmc_rig.process.session_drift import run_drift
    from emmc_rig.store.folders import result_folder

    with result_folder(out, "calibrate --drift") as folder, shown_progress("fit the drift"):
        metrics = run_drift(known, frames, folder)
    tell(metrics["words"])
    for kind, value in metrics["values"].items():
        tell(f"    {kind} {value:+.4g} +- {metrics['deviations'][kind]:.2g}")
    tell(f"use {out / 'psi.h5'}")
    give_result(out)

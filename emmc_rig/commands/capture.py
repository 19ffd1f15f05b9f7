"""The command `emmc-rig capture`: options in, a session on the disk."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console

from emmc_rig.commands.modes import SIMULATED_ONLY, given_names, refuse
from emmc_rig.commands.options import (
    SIMULATED_PANEL,
    HostOption,
    RigOption,
    RigSceneOption,
    RigSizeOption,
    out_option,
)
from emmc_rig.commands.output import (
    emit,
    give_result,
    json_wanted,
    naming_stage,
    say,
    show_reason,
    tell,
)
from emmc_rig.errors import ERRORS, AppError
from emmc_rig.progress import Event, Watcher
from emmc_rig.store.folders import is_session

if TYPE_CHECKING:
    from emmc_rig.captures.control import Control
    from emmc_rig.captures.events import RunEnd
    from emmc_rig.captures.schedule import Estimate
    from emmc_rig.commands.capture_display import CaptureDisplay
    from emmc_rig.session.session import Session


def capture(
    context: typer.Context,
    plan: Annotated[
        Path | None, typer.Argument(help="a plan (YAML), or a session to go on with")
    ] = None,
    new: Annotated[
        str | None, typer.Option("--new", help="write a commented plan for this camera, and exit")
    ] = None,
    rig: RigOption = None,
    scene: RigSceneOption = "deep-occlusions",
    size: RigSizeOption = None,
    seed: Annotated[
        int,
        typer.Option(
            "--seed", min=0, help="seed of the scene and noise", rich_help_panel=SIMULATED_PANEL
        ),
    ] = 0,
    rays: Annotated[
        int | None,
        typer.Option(
            "--rays",
            min=16,
            help="rays traced per view and pixel (default: 128; to calibrate within 1 %: 1024)",
            rich_help_panel=SIMULATED_PANEL,
        ),
    ] = None,
    flaws: Annotated[
        str | None,
        typer.Option(
            "--flaws",
            help="faults of the rig, commas between, such as tilt,lamp,crosstalk; together: most "
            "(default: none)",
            rich_help_panel=SIMULATED_PANEL,
        ),
    ] = None,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time",
            help="let moves and exposures take as long as on a bench",
            rich_help_panel=SIMULATED_PANEL,
        ),
    ] = False,
    until: Annotated[
        str | None,
        typer.Option(
            "--until",
            help="PSNR, such as 30dB: the plan's further shots are skipped once it is estimated",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="check the plan and estimate its time, without capturing"),
    ] = False,
    page: Annotated[bool, typer.Option("--page", help="show the capture on a local page")] = False,
    steer: Annotated[
        bool,
        typer.Option(
            "--steer", help="as --page, with buttons that pause, take frames again and finish"
        ),
    ] = False,
    other_devices: Annotated[
        bool,
        typer.Option(
            "--other-devices", help="go on with a camera or stage of another serial number"
        ),
    ] = False,
    host: HostOption = "127.0.0.1",
    out: Annotated[Path | None, out_option("PLAN-session")] = None,
) -> None:
    """Capture a plan's frames on a rig.

    Ctrl-C stops after the current frame; the same command goes on where it stopped.
    """
    if new is not None:
        _write_plan(new, out or Path("plan.yaml"))
        return
    if plan is None:
        raise typer.BadParameter("name a plan, or write one by --new CAMERA")
    from emmc_rig.captures.plan import load_plan

    if not is_session(plan):
        load_plan(plan)  # its faults are reported before a bench's modules load, for seconds
    from emmc_rig.bench.rig_config import SIMULATED, ImagedRig, rig_description
    from emmc_rig.model.settings import validated
    from emmc_rig.store.results import parse_psnr, parse_size

    given: dict[str, Any] = {} if rays is None else {"rays": rays}
    if flaws is not None:
        given["flaws"] = flaws.split(",")
    settings = {"scene": scene, "size": parse_size(size), "seed": seed, "real_time": real_time}
    imaged = validated(ImagedRig, settings | given, "the simulated rig", AppError)
    until_db = None if until is None else parse_psnr(until, "--until")
    chosen = None if rig is None else rig_description(rig, imaged)
    if chosen is None or chosen["kind"] != SIMULATED:
        where = "on a session's own rig" if chosen is None else "on a rig of real devices"
        refuse(context, given_names(context) & set(SIMULATED_ONLY), where)
    if dry_run and (page or steer):
        refuse(context, given_names(context) & {"page", "steer"}, "with --dry-run")
    if not (page or steer):
        refuse(context, given_names(context) & {"host"}, "without --page or --steer")
    shown = None if not (page or steer) else "steers" if steer else "shows"
    with naming_stage(rig or ""):
        _run(plan, chosen, until_db, dry_run, out, shown, host, other_devices)


def _write_plan(name: str, path: Path) -> None:
    from emmc_rig.captures.plan import new_plan
    from emmc_rig.captures.run import write_new
    from emmc_rig.formats.cameras import find_camera

    write_new(path, new_plan(name, find_camera(name)))
    tell(f"wrote {path}; edit it, then: emmc-rig capture {path} --rig simulated")


def _run(
    plan: Path,
    rig: Mapping[str, Any] | None,
    until_db: float | None,
    dry_run: bool,
    out: Path | None,
    page: Literal["shows", "steers"] | None,
    host: str,
    other_devices: bool,
) -> None:
    from emmc_rig.captures.control import Control
    from emmc_rig.captures.events import Listener
    from emmc_rig.captures.run import FrontEnd, asked_folder, capture_session
    from emmc_rig.commands.capture_display import CaptureDisplay

    control = Control(stays=page == "steers")
    display = CaptureDisplay(Console(stderr=True, quiet=json_wanted.get()), control)
    watcher: Watcher = Listener(_print_line) if json_wanted.get() else display

    def agreed(expected: Estimate) -> bool:
        if expected.frames:
            watcher.tell(_estimate_words(expected, "" if until_db is None else "at most "))
        return not dry_run

    with ExitStack() as open_things:
        if page is not None:
            folder = asked_folder(plan, out)
            made = _page(folder, control, watcher, page, until_db, host)
            watcher = open_things.enter_context(made)
        open_things.enter_context(display.shown())
        if json_wanted.get():
            emit("stage", stage="open the rig", steps=None)
        ask = partial(_ask, watcher=watcher, display=display, control=control, page=page)
        front = FrontEnd(watcher, ask, agreed, control)
        captured = capture_session(plan, rig, out, until_db, front, other_devices)
    if captured is not None:
        _say_complete(*captured)


def _ask(
    what: str,
    watcher: Watcher,
    display: CaptureDisplay,
    control: Control,
    page: Literal["shows", "steers"] | None,
) -> None:
    """Wait until a person has done something by hand: Enter, or a click on a page that steers.

    Raises AppError where there is neither a terminal nor such a page.
    """
    from emmc_rig.captures.control import pressed_keys

    terminal = sys.stdin.isatty()
    if not terminal and page != "steers":
        raise AppError(
            f"somebody has to {what}: answer on a page (--steer), "
            "run this on a terminal, or automate the lamp and masks"
        )
    began_s, objects = time.perf_counter(), {"asked": what}
    watcher.event(Event("pause", {"reason": f"please {what}"}, objects))
    wish = f"please {what}, then press Enter"
    with display.aside():
        if page != "steers":
            input(f"{wish} ")
        else:
            tell(f"{wish}, or on the page" if terminal else f"please {what}")
            with pressed_keys() as pressed:
                control.until_answered(pressed)
    seconds = round(time.perf_counter() - began_s, 3)
    watcher.event(Event("resume", {"seconds": seconds}, objects))


def _estimate_words(expected: Estimate, most: str) -> str:
    """Return what a capture takes, in words; most: "at most " where it may end earlier, else ""."""
    from emmc_rig.store.results import shown_bytes, shown_seconds

    count, guessed = expected.by_hand, expected.guessed
    hands = f", {count} change{'s' * (count > 1)} by hand" if count else ""
    plural = "s that are" if guessed > 1 else " that is"
    excluded = f"; time excludes {guessed} exposure{plural} metered first" if guessed else ""
    return (
        f"{most}{expected.frames} frames to take, about "
        f"{shown_seconds(expected.seconds)} and {shown_bytes(expected.bytes)}{hands}{excluded}"
    )


def _say_complete(session: Session, outcome: RunEnd) -> None:
    """Print the counts of frames, reasons against the exposures, and the path of the page."""
    from emmc_rig.session.brightness import exposure_reasons, shot_exposures
    from emmc_rig.session.journal import ended
    from emmc_rig.session.session import REPORT
    from emmc_rig.store.results import shown_seconds

    again = f"{outcome.retries} time{'s' * (outcome.retries > 1)}"
    retried = f", tried again {again}" if outcome.retries else ""
    tell(
        f"complete: {len(session.needed)} frames verified, {outcome.taken} taken in "
        f"{shown_seconds(outcome.seconds)}{retried}; in {session.folder}"
    )
    last = ended(session.journal.entries)
    if last is not None:
        tell(str(last))
    for reason in exposure_reasons(shot_exposures(session)):
        show_reason(**asdict(reason))
    tell(f"open {session.folder / REPORT}")
    give_result(out=session.folder, frames=len(session.needed), **asdict(outcome))


@contextmanager
def _page(
    folder: Path,
    control: Control,
    other: Watcher,
    does: Literal["shows", "steers"],
    until_db: float | None,
    host: str,
) -> Iterator[Watcher]:
    """Serve the page of a capture, and say where, until the block ends; yield its watcher.

    other: gets every event before the page.
    """
    from emmc_rig.captures.events import DISPLAYED, Listener
    from emmc_rig.live.server import (
        LOCAL_HOSTS,
        address,
        application,
        names_of,
        new_token,
        served,
    )
    from emmc_rig.live.session_page import SessionPage

    page, token = SessionPage(folder, control, until_db is None), new_token()
    to_act = "start `emmc-rig capture` with --steer"
    made = application(page, token, does == "shows", names_of(host), to_act)
    with served(made, host) as port:
        say("page", address(host, port, token), "cyan")
        if names_of(host) != LOCAL_HOSTS:
            acts = "look" if does == "shows" else "look and steer"
            say("careful", f"others in the network who know this address can {acts}")
        page.start()
        why = ""
        try:
            yield Listener(page.event, other, DISPLAYED)
        except ERRORS as fault:
            why = str(fault)
            raise
        finally:
            page.close(why)


def _print_line(event: Event) -> None:
    print(event.line(), flush=True)

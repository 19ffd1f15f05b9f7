"""`emmc-rig capture`: a plan becomes a session; run it again, and the session goes on."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from emmc_rig.capture.control import Control, interruptible
from emmc_rig.capture.estimate import Estimate, estimate
from emmc_rig.capture.expand import expand
from emmc_rig.capture.order import ordered
from emmc_rig.capture.plan import (
    METERING_EXPOSURE_S,
    Plan,
    first_difference,
    load_plan,
    planned_camera,
)
from emmc_rig.capture.sequencer import Outcome, Sequencer
from emmc_rig.capture.until import Until, refuse_without_choice
from emmc_rig.capture.watcher import Unwatched, Watcher
from emmc_rig.errors import AppError, StoppedError
from emmc_rig.files.results import command_line, shown_bytes, versions
from emmc_rig.model.camera import Camera
from emmc_rig.model.errors import CameraError
from emmc_rig.model.settings import validated
from emmc_rig.pages.session_sheet import quick_pictures, write_sheet
from emmc_rig.rig.hardware import Rig
from emmc_rig.rig.rig_config import Ask, RigChoice, opened_rig
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import (
    HEADER,
    JOURNAL,
    REPORT,
    Frozen,
    Session,
    is_session,
    only_program,
    wall_time,
)
from emmc_rig.session.storage import SYSTEM_DISK, Disk

DISK_RESERVE_BYTES = 100_000_000


@dataclass(frozen=True)
class Wish:
    """What to capture and where to; rig: see `emmc_rig.rig.rig_config`, None on resuming alike.

    until_db: the PSNR at which no further shot is taken; None: what the session has, if any.
    """

    plan_path: Path
    plan: Plan
    plan_yaml: str
    camera: Camera
    out: Path
    rig: Mapping[str, Any]
    until_db: float | None = None


def session_folder(plan_path: Path) -> Path:
    """Return the folder of a plan's session unless another is named."""
    return plan_path.with_name(f"{plan_path.stem}-session")


def wish_from_plan(
    plan_path: Path, out: Path | None, rig: Mapping[str, Any], until_db: float | None = None
) -> Wish:
    """Return what a plan file asks for; raises AppError."""
    plan = load_plan(plan_path)
    camera = planned_camera(plan, plan_path.parent)
    text = plan_path.read_text(encoding="utf-8")
    return Wish(plan_path, plan, text, camera, out or session_folder(plan_path), rig, until_db)


def wish_from_session(
    folder: Path, rig: Mapping[str, Any] | None, until_db: float | None = None
) -> Wish:
    """Return what a session was begun for; raises AppError."""
    session = Session(folder)
    plan = validated(Plan, yaml.safe_load(session.plan_yaml), str(folder), AppError)
    camera = validated(Camera, session.camera, str(folder), CameraError)
    return Wish(folder, plan, session.plan_yaml, camera, folder, rig or session.rig, until_db)


def planned_frames(wish: Wish, rig: Rig) -> tuple[PlannedFrame, ...]:
    """Return every frame of a wish in the order of the capture."""
    return ordered(expand(wish.plan, wish.camera, rig.window_um), wish.plan.order)


def still_possible(wish: Wish, session: Session) -> tuple[PlannedFrame, ...]:
    """Return the frames that going on may take; another target asks for spared shots again."""
    other_target = wish.until_db not in (None, session.target_db)
    frames = session.frames if other_target else session.needed
    return tuple(frame for frame in frames if frame.id not in session.stored)


def begun_session(wish: Wish, disk: Disk = SYSTEM_DISK) -> Session | None:
    """Return the session that the wish goes on with; None where it is to be begun.

    Raises AppError when the folder is in the way, or the session was begun with another plan,
    camera or rig.
    """
    if is_session(wish.out):
        session = Session(wish.out, disk)
        _refuse_changes(wish, session)
        return session
    if (wish.out / HEADER).is_file():
        raise AppError(
            f"{wish.out}: its {JOURNAL} is gone; restore it from a copy, or name another --out"
        )
    if wish.out.exists() and (wish.out.is_file() or any(wish.out.iterdir())):
        raise AppError(
            f"--out {wish.out}: holds something else than a session; choose another folder"
        )
    return None


def new_session(wish: Wish, frames: tuple[PlannedFrame, ...], disk: Disk = SYSTEM_DISK) -> Session:
    """Begin the wish's session; raises AppError where it cannot be made."""
    frozen = Frozen(wish.plan_yaml, _camera_data(wish.camera), dict(wish.rig), frames)
    about = {
        "title": wish.plan.title or wish.plan_path.stem,
        "created": wall_time(),
        "command": command_line(),
        "versions": versions(),
        **({} if wish.until_db is None else {"until_db": wish.until_db}),
    }
    return Session.create(wish.out, frozen, about, disk)


def _camera_data(camera: Camera) -> dict[str, Any]:
    return camera.model_dump(mode="json")


def _refuse_changes(wish: Wish, session: Session) -> None:
    frozen = validated(Plan, yaml.safe_load(session.plan_yaml), str(session.folder), AppError)
    difference = first_difference(wish.plan, frozen)
    if difference:
        raise AppError(
            f"{wish.plan_path}: was edited since session {session.folder.name} began with it "
            f"({difference} as there): take the edit back, or name another --out"
        )
    if json.loads(json.dumps(_camera_data(wish.camera))) != session.camera:
        raise AppError(
            f"{wish.plan.camera}: the camera was edited since session {session.folder.name} began; "
            "take the edit back, or name another --out"
        )
    if json.loads(json.dumps(dict(wish.rig))) != session.rig:
        raise AppError(
            f"session {session.folder.name} was begun with another rig: {json.dumps(session.rig)}; "
            "name the same, or another --out"
        )


def estimated(frames: tuple[PlannedFrame, ...], plan: Plan, rig: Rig) -> Estimate:
    """Return what frames will take."""
    rows, columns = rig.camera.shape
    speeds = {axis: rig.stage.speed_um_s(axis) for axis in rig.stage.axes}
    return estimate(frames, 2 * rows * columns, speeds, plan.settle_s, METERING_EXPOSURE_S)


def refuse_small_disk(out: Path, expected: Estimate, disk: Disk = SYSTEM_DISK) -> None:
    """Raise AppError when the frames will not fit."""
    above = next(folder for folder in (out, *out.absolute().parents) if folder.is_dir())
    free = disk.free_bytes(above)
    if expected.bytes + DISK_RESERVE_BYTES > free:
        raise AppError(
            f"{out}: {expected.frames} frames need about {shown_bytes(expected.bytes)}, "
            f"{shown_bytes(free)} are free; make room, or name another --out"
        )


def refuse_other_camera(session: Session, rig: Rig) -> None:
    """Raise AppError when the session was begun with another camera body or frame size."""
    run = next((entry for entry in session.journal.entries if entry["kind"] == "run"), None)
    if run is None or not session.stored:
        return
    then, now = run["camera"], rig.camera.identity
    if then["serial"] != now.serial or then["shape"] != list(rig.camera.shape):
        raise AppError(
            f"session {session.folder.name} was begun with camera {then['model']} "
            f"{then['serial']} of {then['shape'][0]}x{then['shape'][1]} pixels, this is "
            f"{now.model} {now.serial} of {rig.camera.shape[0]}x{rig.camera.shape[1]}: connect "
            "that one, or name another --out"
        )


@contextmanager
def disk_faults_told(session: Session) -> Iterator[None]:
    """Turn what the disk raises into one line."""
    try:
        yield
    except OSError as fault:
        why = {
            errno.ENOSPC: "the disk is full; make room",
            errno.EDQUOT: "the disk quota is spent; make room",
            errno.EROFS: "the disk is read-only; make it writable",
            errno.EACCES: "this user may not write there; change that",
        }.get(fault.errno or 0, f"{fault.strerror or fault}; mend that")
        raise AppError(
            f"{session.folder}: {why}, then run the same command to go on; "
            f"{len(session.stored)} of {len(session.needed)} frames are safe"
        ) from fault


def run_capture(
    wish: Wish,
    watcher: Watcher,
    ask: Ask,
    agreed: Callable[[Estimate], bool] = lambda expected: True,
    control: Control | None = None,
) -> tuple[Session, Outcome] | None:
    """Capture what is missing of a wish; nothing is made or moved unless `agreed` says yes.

    agreed: is told what it will take. Raises AppError or a `DriverError`.
    """
    control = control or Control()
    if wish.until_db is not None:
        refuse_without_choice(wish.plan, wish.camera)
    with ExitStack() as open_things:
        session = begun_session(wish)
        rig = open_things.enter_context(opened_rig(wish.rig, wish.camera, ask))
        frames = planned_frames(wish, rig) if session is None else still_possible(wish, session)
        expected = estimated(frames, wish.plan, rig)
        refuse_small_disk(wish.out, expected)
        if not agreed(expected):
            return None
        session = session or new_session(wish, frames)
        open_things.enter_context(only_program(session))
        refuse_other_camera(session, rig)
        with interruptible(control, watcher.tell), disk_faults_told(session):
            if wish.until_db not in (None, session.target_db):
                session.note("until", target_db=wish.until_db, wall=wall_time())
            choose = None if session.target_db is None else Until(session, watcher)
            return session, Sequencer(session, wish.plan, rig, watcher, control, choose).run()


def asked_for(
    plan: Path, rig: Mapping[str, Any] | None, out: Path | None, until_db: float | None
) -> Wish:
    """Return what a plan file asks for, or what a session was begun for; raises AppError.

    rig: see `rig_description`; a session has its own.
    """
    if is_session(plan):
        return wish_from_session(plan, rig, until_db)
    if rig is None:
        raise AppError("say which rig: --rig simulated, or --rig and a YAML file of devices")
    return wish_from_plan(plan, out, rig, until_db)


def capture_session(
    wish: Wish,
    watcher: Watcher,
    ask: Ask,
    agreed: Callable[[Estimate], bool] = lambda expected: True,
    control: Control | None = None,
) -> tuple[Session, Outcome] | None:
    """Capture what is missing of a wish, and write the session's report; see `run_capture`.

    None where `agreed` says no. Raises StoppedError when somebody stopped it: what was
    captured is kept, and the same call goes on.
    """
    go_on = f"go on with: emmc-rig capture {wish.out}"
    try:
        captured = run_capture(wish, watcher, ask, agreed, control)
    except KeyboardInterrupt as stop:
        begun = is_session(wish.out)
        kept = f"what was captured is kept, {go_on}" if begun else "nothing was begun"
        raise StoppedError(f"stopped at once; {kept}") from stop
    if captured is None:
        return None
    session, outcome = captured
    try:
        write_sheet(session, session.folder / REPORT, quick_pictures(session))
    except AppError as fault:
        watcher.tell(f"no report: {fault}")
    if not outcome.complete:
        raise StoppedError(
            f"stopped: {outcome.missing} of {len(session.needed)} frames are still to be taken; "
            f"{go_on}"
        )
    return captured


def ask_at_prompt(what: str) -> None:
    """Ask a person to do something at the bench, and wait until Enter is pressed."""
    input(f"please {what}, then press Enter ")


def capture(
    plan: str | Path,
    rig: RigChoice | None = None,
    *,
    out: str | Path | None = None,
    until_db: float | None = None,
    watcher: Watcher | None = None,
    ask: Ask = ask_at_prompt,
) -> Session:
    """Run a plan on a rig and return its session; run again, it goes on where it stopped.

    Args:
        plan: a plan (YAML), or the folder of a session to go on with.
        rig: what `emmc_rig.rig` returns; a session has its own.
        out: folder of the session (default: PLAN-session beside the plan).
        until_db: PSNR, dB, at which no further shot is taken (default: all shots are).
        watcher: is told what is captured.
        ask: does what no axis of the rig does: lamp, board, masks. By default a person is asked.

    Raises:
        AppError: a plan, rig or folder that cannot be used; StoppedError by Ctrl-C.
        DriverError: what a device says.
    """
    description = None if rig is None else rig.description
    wish = asked_for(Path(plan), description, None if out is None else Path(out), until_db)
    captured = capture_session(wish, watcher or Unwatched(), ask)
    assert captured is not None  # nobody is asked whether to agree
    return captured[0]


def write_new(path: Path, text: str) -> None:
    """Write a new file; raises AppError when one of that name is there, or it cannot be."""
    try:
        with open(path, "x", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except FileExistsError as fault:
        raise AppError(f"{path}: exists already; name another --out") from fault
    except OSError as fault:
        raise AppError(f"{path}: cannot be written ({fault.strerror})") from fault

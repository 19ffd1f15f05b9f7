"""`emmc-rig capture`: a plan becomes a session; run it again, and the session goes on.

Whoever calls holds the session meanwhile (`emmc_rig.session.lock.held`), from before it is read.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from emmc_rig.bench.hardware import FOCUS, Rig
from emmc_rig.bench.rig_config import AnyRig, Ask, RigChoice, opened_rig
from emmc_rig.bench.rig_config import rig as choose_rig
from emmc_rig.captures.amend import amendment
from emmc_rig.captures.between import load_hook
from emmc_rig.captures.by_hand import with_hands
from emmc_rig.captures.control import Control, interruptible
from emmc_rig.captures.devices import identity_of, with_trigger
from emmc_rig.captures.events import Listener, OnEvent, RunEnd, emit_end
from emmc_rig.captures.expand import expand
from emmc_rig.captures.faults import GaveUpError, refuse_impossible
from emmc_rig.captures.film import refuse_impossible_film
from emmc_rig.captures.metering import Exposures
from emmc_rig.captures.plan import Plan, load_plan, planned_camera
from emmc_rig.captures.replay import missing_words, replaying, there
from emmc_rig.captures.schedule import Estimate, ordered, pace_of
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.captures.until import Until, refuse_unless_shots_can_be_spared
from emmc_rig.drivers.folder import FolderCamera, Recorded
from emmc_rig.errors import ERRORS, AppError, StoppedError
from emmc_rig.model.arguments import NAMES, path_of, required
from emmc_rig.model.camera import Camera
from emmc_rig.model.errors import CameraError
from emmc_rig.model.files import SYSTEM_DISK, Disk
from emmc_rig.model.settings import validated
from emmc_rig.progress import Watcher
from emmc_rig.report.session_sheet import quick_pictures, write_sheet
from emmc_rig.session.journal import UntilEntry
from emmc_rig.session.lock import held
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import (
    HEADER,
    JOURNAL,
    Frozen,
    Session,
    wall_time,
)
from emmc_rig.store.folders import is_session, new_file, refuse_inside_session
from emmc_rig.store.results import command_line, shown_bytes, versions

DISK_RESERVE_BYTES = 100_000_000


def ask_at_prompt(what: str) -> None:
    """Ask a person to do something at the bench, and wait until Enter is pressed."""
    input(f"please {what}, then press Enter ")


@dataclass(frozen=True)
class CaptureRequest:
    """A capture as it was asked for. rig: see `emmc_rig.bench.rig_config`; None: the session's.

    until_db: the PSNR at which no further shot is taken; None: what the session has, if any.
    other_devices: the session may go on with a camera and stages of other serial numbers.
    """

    plan_path: Path
    plan: Plan
    plan_yaml: str
    camera: Camera
    out: Path
    rig: Mapping[str, Any]
    until_db: float | None = None
    other_devices: bool = False

    def frozen(self, frames: tuple[PlannedFrame, ...]) -> Frozen:
        """Return what a session keeps of the request unchanged."""
        camera = self.camera.model_dump(mode="json")
        return Frozen(self.plan_yaml, camera, dict(self.rig), frames)


@dataclass(frozen=True)
class FrontEnd:
    """Who asks for a capture and follows it: the command line, a page, a program.

    ask: does what no axis of the rig does: lamp, board, masks. agreed: gets what the capture will
    take, once nothing speaks against it; where it says no, nothing is made or moved.
    """

    watcher: Watcher = field(default_factory=Watcher)
    ask: Ask = ask_at_prompt
    agreed: Callable[[Estimate], bool] = lambda expected: True
    control: Control = field(default_factory=Control)


def asked_folder(plan: Path, out: Path | None) -> Path:
    """Return the folder of the session that a plan or session, and --out, name."""
    return out or (plan if is_session(plan) else plan.with_name(f"{plan.stem}-session"))


def asked_for(
    path: Path,
    folder: Path,
    rig: Mapping[str, Any] | None,
    until_db: float | None,
    other_devices: bool = False,
) -> CaptureRequest:
    """Return what a plan file asks for, or what a session was begun for; raises AppError.

    folder: of the session. rig: see `rig_description`; a session keeps its own rig, also under an
    edited plan.
    """
    if is_session(path):
        session = Session(path)
        plan = validated(Plan, session.plan_data(), str(path), AppError)
        camera = validated(Camera, session.camera, str(path), CameraError)
        text, rig = session.plan_yaml, rig or session.rig
    else:
        plan = load_plan(path)
        if rig is None and is_session(folder):
            rig = Session(folder).rig
        if rig is None:
            raise AppError("say which rig: simulated, or a YAML file of devices", "name-rig")
        camera = planned_camera(plan, path.parent)
        text = path.read_text(encoding="utf-8")
    return CaptureRequest(path, plan, text, camera, folder, rig, until_db, other_devices)


def planned_frames(request: CaptureRequest, rig: Rig) -> tuple[PlannedFrame, ...]:
    """Return every frame of a request in the order of the capture."""
    frames = expand(request.plan, request.camera, rig.window_um, rig.window_side_um)
    return ordered(frames, request.plan.order, with_hands(rig, frames).hands)


def begun_session(request: CaptureRequest, disk: Disk = SYSTEM_DISK) -> Session | None:
    """Return the session that the request goes on with; None for a new session.

    Raises AppError when the folder is in the way, or frames were taken by another rig.
    """
    if is_session(request.out):
        session = Session(request.out, disk)
        asked, begun = dict(request.rig), AnyRig.under_new_names(session.rig)
        # How the lights are switched shows in no frame, and may be corrected.
        if session.stored and asked | {"lights": None} != begun | {"lights": None}:
            raise AppError(
                f"session {session.folder.name} was begun with another rig: "
                f"{json.dumps(session.rig)}; name no rig, or begin another session"
            )
        return session
    if (request.out / HEADER).is_file():
        raise AppError(
            f"{request.out}: its {JOURNAL} is gone; restore it from a copy, or name another folder"
        )
    if request.out.exists() and (request.out.is_file() or any(request.out.iterdir())):
        raise AppError(f"{request.out}: holds something other than a session; name another folder")
    refuse_inside_session(request.out)
    return None


def new_session(
    request: CaptureRequest, frames: tuple[PlannedFrame, ...], disk: Disk = SYSTEM_DISK
) -> Session:
    """Begin the requested session; raises AppError where it cannot be made."""
    about = {
        "title": request.plan.title or request.plan_path.stem,
        "created": wall_time(),
        "command": command_line(),
        "versions": versions(),
        **({} if request.until_db is None else {"until_db": request.until_db}),
    }
    return Session.create(request.out, request.frozen(frames), about, disk)


def estimated(
    frames: tuple[PlannedFrame, ...],
    plan: Plan,
    rig: Rig,
    session: Session | None = None,
) -> Estimate:
    """Return what frames will take."""
    return pace_of(rig, plan).estimate(frames, Exposures(plan, session).known_s)


def refuse_small_disk(out: Path, expected: Estimate, disk: Disk = SYSTEM_DISK) -> None:
    """Raise AppError when the frames will not fit."""
    above = next(folder for folder in (out, *out.absolute().parents) if folder.is_dir())
    free = disk.free_bytes(above)
    lacking = expected.bytes + DISK_RESERVE_BYTES - free
    if lacking > 0:
        raise AppError(
            f"{out}: {expected.frames} frames need about {shown_bytes(expected.bytes)}, and "
            f"{shown_bytes(DISK_RESERVE_BYTES)} stay reserved: {shown_bytes(lacking)} more than "
            f"the {shown_bytes(free)} that are free; make room, or name another folder"
        )


def refuse_other_devices(session: Session, rig: Rig, meant: bool = False) -> None:
    """Raise AppError when the last run of a session had another camera, frame size, or stage.

    meant: other serial numbers are, not another frame size. A stage that does not say its serial
    number is not compared.
    """
    last = session.last_run
    if last is None or not session.stored:
        return
    then, now = last.camera, rig.camera.identity
    way = "connect that one, begin another session, or say that other devices are meant"
    same_shape = then["shape"] == list(rig.camera.shape)
    if not same_shape or (then["serial"] != now.serial and not meant):
        raise AppError(
            f"session {session.folder.name} was begun with camera {then['model']} "
            f"{then['serial']} of {then['shape'][0]}x{then['shape'][1]} pixels, this is "
            f"{now.model} {now.serial} of {rig.camera.shape[0]}x{rig.camera.shape[1]}: "
            f"{way if same_shape else 'connect that one, or begin another session'}",
            "other-devices" if same_shape else None,
        )
    for axis in () if meant else rig.stage.axes:
        earlier = last.stage.get(axis, {}).get("identity", {})
        own = identity_of(rig.stage, axis)
        if earlier.get("serial") and own.serial and earlier["serial"] != own.serial:
            raise AppError(
                f"session {session.folder.name} was begun with {axis} on {earlier['model']} "
                f"{earlier['serial']}, now it is on {own.model} {own.serial}: {way}",
                "other-devices",
            )


@contextmanager
def disk_faults_named(session: Session) -> Iterator[None]:
    """Turn what the disk raises into one line."""
    try:
        yield
    except ERRORS:
        raise
    except OSError as fault:
        why = {
            errno.ENOSPC: "the disk is full; make room",
            errno.EDQUOT: "the disk quota is spent; make room",
            errno.EROFS: "the disk is read-only; make it writable",
            errno.EACCES: "this user may not write there; change that",
        }.get(fault.errno or 0, f"{fault.strerror or fault}; correct that")
        raise AppError(
            f"{session.folder}: {why}, then run the same command to go on; "
            f"{len(session.stored)} of {len(session.needed)} frames are safe"
        ) from fault


@contextmanager
def way_on_named(request: CaptureRequest, session: Session) -> Iterator[None]:
    """Say with a fault how to go on; a session without a frame goes, for there is nothing to keep.

    A fault of the plan's is mended in the plan, which may hold for a session that has begun.
    """
    try:
        yield
    except BaseException as fault:
        kept = len(session.stored)
        if not kept:
            session.forget()
        if not isinstance(fault, GaveUpError):
            raise
        way = f"frames kept: {kept}" if kept else "nothing was captured"
        line = f"{fault}; {way}; correct it, then run the same command"
        edited = kept and is_session(request.plan_path)
        raise AppError(line, "capture-edited" if edited else None, request.out) from fault


def run_capture(request: CaptureRequest, front: FrontEnd) -> tuple[Session, RunEnd] | None:
    """Capture what is missing; None, and nothing made or moved, unless the front end agrees.

    Raises AppError or a `DriverError`.
    """
    watcher, plan = front.watcher, request.plan
    if request.until_db is not None:
        if plan.film is not None:
            raise AppError("a film is taken to its end: leave the target PSNR or film out")
        refuse_unless_shots_can_be_spared(plan, request.camera)
    with ExitStack() as open_things:
        # Everything is read and checked before anything is made or moved.
        session = begun_session(request)
        hook = None
        if plan.between is not None:
            hook = load_hook(plan.between, request.plan_path.absolute().parent, Path.cwd())
        rig = open_things.enter_context(opened_rig(request.rig, request.camera, front.ask))
        planned = planned_frames(request, rig)
        rig = with_hands(rig, planned)
        edit = None
        if session is None:
            frames = tuple(frame for frame in planned if not frame.is_optional)
        elif edit := amendment(session, plan, request.camera, request.rig, planned):
            watcher.tell(edit.words(len(session.stored)))
            frames = _not_stored(session, (f for f in edit.frames if not f.is_optional))
        else:
            # Another target asks for spared shots again.
            other_target = request.until_db not in (None, session.target_db)
            frames = _not_stored(session, session.frames if other_target else session.needed)
        recording: Mapping[str, Recorded] | None = None
        if isinstance(rig.camera, FolderCamera):
            folder = rig.camera.folder
            rig, recording = replaying(rig, planned)
            if words := missing_words(folder, frames, recording):
                watcher.tell(words)
        elif plan.focus is not None and FOCUS not in rig.stage.axes:
            known = ", ".join(rig.stage.axes) or "none"
            raise AppError(
                f"focus: the rig has no axis named {FOCUS}, only {known}: name it so in the file "
                "of the stage, or leave focus out of the plan"
            )
        if recording is None:
            rig = with_trigger(rig, plan)
        refuse_impossible(rig, frames)
        refuse_impossible_film(plan, rig, frames)
        if session is not None:
            refuse_other_devices(session, rig, request.other_devices)
        expected = estimated(frames, plan, rig, session)
        refuse_small_disk(request.out, expected)
        if not front.agreed(expected):
            return None
        if session is None:
            session = new_session(request, planned)
            open_things.enter_context(held(session.folder))
        with interruptible(front.control, watcher.tell), disk_faults_named(session):
            if edit is not None:
                session = session.amend(request.frozen(edit.frames), edit.changes)
            with way_on_named(request, session):
                if request.until_db not in (None, session.target_db):
                    session.note(UntilEntry(target_db=request.until_db))
                choose = None if recording is None else there(session, recording)
                if session.target_db is not None:
                    choose = Until(session, watcher)
                run = Sequencer(session, plan, rig, watcher, front.control, choose, hook)
                return session, run.run()


def _not_stored(session: Session, frames: Iterable[PlannedFrame]) -> tuple[PlannedFrame, ...]:
    return tuple(frame for frame in frames if frame.id not in session.stored)


def capture_session(
    plan: Path,
    rig: Mapping[str, Any] | None,
    out: Path | None,
    until_db: float | None,
    front: FrontEnd,
    other_devices: bool = False,
) -> tuple[Session, RunEnd] | None:
    """Capture what is missing of a plan or session, and write the session's report.

    See `asked_for` and `run_capture`. Raises StoppedError when somebody stopped it: what was
    captured is kept, and the same call goes on.
    """
    folder = asked_folder(plan, out)
    with held(folder):
        request = asked_for(plan, folder, rig, until_db, other_devices)
        try:
            captured = run_capture(request, front)
        except (KeyboardInterrupt, StoppedError) as stop:
            if not is_session(folder):
                raise StoppedError("stopped at once; nothing was begun") from stop
            kept = "stopped at once; what was captured is kept"
            raise StoppedError(kept, "capture", folder) from stop
        if captured is None:
            return None
        session, outcome = captured
        try:
            write_sheet(session, session.folder, quick_pictures(session))
        except AppError as fault:
            front.watcher.tell(f"no report: {fault}")
    emit_end(front.watcher, session, outcome)
    if not outcome.complete:
        raise StoppedError(
            f"stopped: {outcome.missing} of {len(session.needed)} frames are still to be taken",
            "capture",
            folder,
        )
    return captured


def capture(
    plan: str | Path,
    rig: RigChoice | str | Path | None = None,
    *,
    out: str | Path | None = None,
    until_db: float | None = None,
    other_devices: bool = False,
    watcher: Watcher | None = None,
    on_event: OnEvent | None = None,
    ask: Ask = ask_at_prompt,
) -> Session:
    """Capture the frames of a plan and return their session; a second call resumes the first.

    Args:
        plan: the YAML file of a plan, or the folder of a session to resume.
        rig: what `emmc_rig.rig` returns, or its first argument. None: that of the session.
        out: folder of the session. None: PLAN-session beside the plan.
        until_db: estimated PSNR, dB, at which no further shot is taken. None: all are taken.
        other_devices: whether a session may be resumed with a camera or stage of another serial
            number.
        watcher: a `Watcher`, whose methods are called with stages, steps and notes.
        on_event: a function of an `Event`, called for the events that `emmc_rig.captures.events`
            lists, such as `frame.written`; a function that raises is not called again.
        ask: a function that is called with the words for a task that no axis of the rig can do
            (lamp, board, masks), and returns when it is done. By default a person is asked.

    Returns:
        The session, with all its frames on the disk.

    Raises:
        AppError: a plan, rig or folder that cannot be used. Its subclass StoppedError: stopped by
            Ctrl-C, or by a hook; the frames captured are kept, and the same call resumes.
        DriverError: a device that fails, after retries.
        CameraError: a plan whose camera is unknown or wrong.
        ArgumentError: a plan, rig or folder of another type.
    """
    takes = "a plan's YAML file, or the folder of a session to go on with"
    plan = path_of(plan, "plan", takes)
    if isinstance(rig, NAMES):
        rig = choose_rig(rig)
    elif rig is not None:
        required(rig, RigChoice, "rig", 'what emmc_rig.rig returns, or its name, as "simulated"')
    description = None if rig is None else rig.description
    folder = None if out is None else path_of(out, "out", "the folder of the new session")
    watching = watcher or Watcher()
    if on_event is not None:
        watching = Listener(on_event, watching)
    front = FrontEnd(watching, ask)
    captured = capture_session(plan, description, folder, until_db, front, other_devices)
    assert captured is not None  # nobody is asked whether to agree
    return captured[0]


def write_new(path: Path, text: str) -> None:
    """Write a new file; raises AppError when the name is taken, or nothing can be written."""
    with new_file(path) as partial:
        partial.write_text(text, encoding="utf-8")

"""The sequencer: the runner that takes every missing frame of a session, until it is complete.

`State` shows the run at a glance. The runner owns the state, the tries after faults, and what
somebody wants in between; `emmc_rig.captures.engine` takes a frame, `emmc_rig.captures.film` the
frames of a film, each at its time, and `emmc_rig.captures.recorder` stores them while the stage
already moves on. However a run ends, the lamp is off and the stage stands when `run` returns or
raises.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from enum import Enum, auto
from functools import partial
from typing import TypeVar

from emmc_rig.bench.hardware import Rig
from emmc_rig.bench.registration import LEAST_LIKENESS
from emmc_rig.captures.between import Between
from emmc_rig.captures.by_hand import WrongPlaceError
from emmc_rig.captures.control import Control, uninterrupted
from emmc_rig.captures.engine import Engine, Facts
from emmc_rig.captures.events import RunEnd
from emmc_rig.captures.faults import Budget, mending, refuse_impossible
from emmc_rig.captures.film import FilmRun
from emmc_rig.captures.metering import Exposures
from emmc_rig.captures.plan import Plan
from emmc_rig.captures.recorder import Recorder
from emmc_rig.captures.schedule import pace_of
from emmc_rig.drivers.errors import DriverError
from emmc_rig.errors import AppError, StopCapture
from emmc_rig.model.json_text import one_line
from emmc_rig.progress import Watcher
from emmc_rig.session.journal import (
    ComparedEntry,
    FocusEntry,
    HaltEntry,
    ResumedEntry,
    RetryEntry,
    RunEntry,
)
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session, wall_time
from emmc_rig.store.results import command_line, versions

REMAINING_TIME_INTERVAL_S = 1.0
"""Least time between two reports of the remaining time."""
ALL_TAKEN = "all frames are taken: finish, or take some once more"
Choose = Callable[[Callable[[], float]], tuple[PlannedFrame, ...]]
"""What to take next, asked again once that is on the disk; it gets the seconds of the run."""
T = TypeVar("T")


class State(Enum):
    """States of a run; a step in each returns the next.

        SETUP ──▶ CHOOSE ◀───────────────────────────┐
                  │ │  │ ◀──▶ PAUSED ◀──▶ ┐          │
                  │ │  │                  │          │
     nothing left │ │  └── frames ──────▶ TAKE ──▶ VERIFY
                  │ │                    ▲ │
                  │ └─ the first ▶ HOME ─┘ │ somebody stops it
                  ▼                        │
              TEARDOWN ◀───────────────────┘

    A fault in HOME or TAKE is mended, and the frame tried again, within a budget. What cannot be
    mended raises, and the run ends, with all stored frames kept.
    """

    SETUP = auto()
    """The run is noted, damaged frames count as missing, impossible frames are refused."""
    CHOOSE = auto()
    """The next frames to take are chosen."""
    PAUSED = auto()
    """The run waits for whoever controls it."""
    HOME = auto()
    """The stage is homed, and the bench compared with the last good frame; once a run."""
    TAKE = auto()
    """A frame is taken, or a segment of a film."""
    VERIFY = auto()
    """Stored frames are read back; a damaged frame counts as missing."""
    TEARDOWN = auto()
    """The hook is called once more, the session is noted as complete where it is."""
    DONE = auto()


class Sequencer:
    """A run over a session; `run` once.

    choose: by default all that is missing. between: the plan's hook. wall: the time of day.
    """

    def __init__(
        self,
        session: Session,
        plan: Plan,
        rig: Rig,
        watcher: Watcher | None = None,
        control: Control | None = None,
        choose: Choose | None = None,
        between: Between | None = None,
        wall: Callable[[], str] = wall_time,
    ) -> None:
        self._session, self._plan, self._rig = session, plan, rig
        self._control = control or Control()
        self._choose = choose or (lambda now_s: session.missing())
        self._hook = between
        self._recorder = Recorder(session, watcher or Watcher())
        self._exposures = Exposures(plan, session)
        self._engine = Engine(
            session, plan, rig, self._recorder, self._exposures, self._control, between, wall
        )
        self._film = None
        if plan.film is not None:
            self._film = FilmRun(self._engine, self._take_frame, self._count_taken)
        self._pace = pace_of(rig, plan)
        self._remaining_reported_s = -REMAINING_TIME_INTERVAL_S
        self._budget = Budget(plan.retries)
        # The latest choice of frames, and the rest of this choice that is still to be taken.
        self._chosen: tuple[PlannedFrame, ...] = ()
        self._left: list[PlannedFrame] = []
        self._is_homed = self._is_all_taken = False
        # Whether the hook is called after the last frame: not again for a complete session.
        self._ends_by_hook = False
        self._taken = 0
        # How many frames were taken when the scene was focused.
        self._focused_at: int | None = None

    def run(self) -> RunEnd:
        """Take what is missing.

        Raises AppError with one line, a `DriverError` that mending cannot cure, `OSError` of the
        disk, or `KeyboardInterrupt`; stored frames are kept in each case.
        """
        steps = {
            State.SETUP: self._set_up,
            State.CHOOSE: self._choose_frames,
            State.PAUSED: self._pause,
            State.HOME: self._home,
            State.TAKE: self._take,
            State.VERIFY: self._verify,
            State.TEARDOWN: self._tear_down,
        }
        recorder, state = self._recorder, State.SETUP
        with recorder, self._bench_left_safe():
            try:
                while state is not State.DONE:
                    state = steps[state]()
            except StopCapture as end:
                assert self._hook is not None
                reason = f"{self._hook.name} ended the capture: {one_line(end)}"
                recorder.note(HaltEntry(kind="stopped", reason=reason), reason)
            missing = recorder.close()
        return RunEnd(not missing, self._taken, missing, self._budget.spent, recorder.now_s())

    # The steps.

    def _set_up(self) -> State:
        session, hook = self._session, self._hook
        self._recorder.begin(
            RunEntry(
                versions=versions(),
                command=command_line(),
                resumed=bool(session.stored),
                environment={
                    source.config.name: source.config.unit for source in self._rig.sources
                },
                between={} if hook is None else hook.facts(),
                **self._engine.devices.facts(),
            )
        )
        refuse_impossible(self._rig, session.missing())
        self._ends_by_hook = hook is not None and not session.is_complete
        return State.CHOOSE

    def _choose_frames(self) -> State:
        """Choose what to take next; where the run stays when all is taken, the lamp goes off."""
        if self._control.stopping:
            return State.TEARDOWN
        if self._control.paused:
            return State.PAUSED
        self._discard_retakes()
        self._chosen = self._choose(self._recorder.now_s)
        self._left = list(self._chosen)
        if self._left:
            return State.TAKE if self._is_homed else State.HOME
        if not self._control.stays or self._session.missing():
            return State.TEARDOWN
        if self._engine.devices.sent.lamp is not None:
            self._engine.devices.set_lamp("off")
        self._is_all_taken = True
        return State.PAUSED

    def _discard_retakes(self) -> None:
        """Count the frames that are wanted once more as not taken; those of a film stay."""
        film = {frame.id for frame in self._session.frames if frame.film is not None}
        wanted = [name for name in self._control.pop_again() if name in self._session.stored]
        if film & set(wanted):
            self._recorder.tell("frames of a film cannot be taken again: their time is over")
        if ids := [name for name in wanted if name not in film]:
            self._recorder.discard_for_retake(ids)
            # A simulated frame may come out as it was before.
            self._engine.before = None

    def _pause(self) -> State:
        """Wait while somebody wants it, or all is taken and nobody wants more."""
        control, recorder = self._control, self._recorder

        def reason() -> str:
            if control.paused:
                return "somebody asked for it"
            return ALL_TAKEN if self._is_all_taken and not control.again else ""

        why = reason()
        if why and not control.stopping:
            began_s = recorder.now_s()
            recorder.note(HaltEntry(kind="paused", reason=why))
            recorder.emit("pause", reason=why)
            while why and not control.stopping:
                control.wait()
                why = reason()
            seconds = recorder.now_s() - began_s
            recorder.note(ResumedEntry(seconds=seconds))
            recorder.emit("resume", seconds=round(seconds, 3))
        self._is_all_taken = False
        if control.stopping:
            return State.TEARDOWN
        return State.TAKE if self._left else State.CHOOSE

    def _home(self) -> State:
        self._retrying("home", lambda attempt: self._engine.devices.home())
        self._is_homed = True
        self._compare_with_last_good()
        return State.TAKE

    def _compare_with_last_good(self) -> None:
        """Take the last good whiteboard once more; raises AppError when the bench has shifted.

        Without a whiteboard the last shot of the scene serves; without that either, nothing does.
        """
        session = self._session
        by_id = {frame.id: frame for frame in session.frames}
        latest = [by_id[name] for name in reversed(session.stored) if name in by_id]
        # The scene of a film may be another one by now.
        candidates = [
            *(frame for frame in latest if frame.kind == "whiteboard"),
            *(frame for frame in latest if frame.is_still_shot),
        ]
        if not candidates:
            return
        planned = candidates[0]
        entry = session.stored[planned.id]
        shift = self._retrying(planned.id, lambda attempt: self._engine.shift_since(planned, entry))
        limit_px = self._plan.checks.registration_px
        alike = shift.likeness >= LEAST_LIKENESS
        good = alike and shift.length_px <= limit_px
        facts = {"id": planned.id, **asdict(shift), "limit_px": limit_px}
        self._recorder.note(ComparedEntry(kind="registered" if good else "refused", **facts))
        if good:
            return
        what = (
            f"is shifted by {shift.length_px:.2f} px ({shift.x_px:+.2f}, {shift.y_px:+.2f})"
            if alike
            else f"looks different (correlation {shift.likeness:.2f})"
        )
        raise AppError(
            f"the bench has changed: frame {planned.id}, captured again, {what}; put "
            "the masks back and check lamp and board, or begin another session"
        )

    def _take(self) -> State:
        """Take the next frame that is left, or a segment of the film.

        Frames that are left are chosen anew where metering the scene asks for more.
        """
        control, left = self._control, self._left
        if not left:
            return State.VERIFY
        if control.stopping:
            return State.TEARDOWN
        if control.paused:
            return State.PAUSED
        planned = left[0]
        if control.again or (planned.is_exposed_as_shots and self._decide_exposures()):
            return State.VERIFY
        self._engine.prepared = None
        if self._focus_is_due(planned) and not self._focus(planned):
            return State.TEARDOWN
        if planned.film is None:
            self._take_frame(planned)
            left.pop(0)
        else:
            film = self._film
            assert film is not None
            self._retrying(planned.id, lambda attempt: film.take_segment(left))
            if not left or control.stopping:
                self._recorder.count_planned()
        return State.TAKE

    def _verify(self) -> State:
        """Read back what was written; a damaged frame is spent from the budget and taken again."""
        self._recorder.flush()
        damaged = self._recorder.discard_damaged(frame.id for frame in self._chosen)
        for name, fault in damaged.items():
            self._budget.spend(name, DriverError(fault), 1)
        return State.CHOOSE

    def _tear_down(self) -> State:
        if self._ends_by_hook and not self._session.missing():
            if not self._is_homed:
                self._retrying("home", lambda attempt: self._engine.devices.home())
            self._engine.prepare(None)
        return State.DONE

    # Within TAKE.

    def _decide_exposures(self) -> bool:
        """Decide once by what metered shots are exposed; returns whether frames were added."""
        if self._exposures.decided is not None:
            return False
        entry = self._exposures.decide(self._engine.devices.camera.exposure_limits_s)
        self._recorder.note(entry)
        self._recorder.flush()
        self._recorder.tell(str(entry))
        self._remaining_reported_s = -REMAINING_TIME_INTERVAL_S
        if entry.asked:
            self._recorder.count_shots()
            self._recorder.count_planned()
        return bool(entry.asked)

    def _focus_is_due(self, planned: PlannedFrame) -> bool:
        """Return whether the plan wants the scene focused before a frame; a recording is not."""
        asked = self._plan.focus
        if asked is None or planned.kind != "shot" or self._rig.recorded_s:
            return False
        taken = None if self._focused_at is None else self._taken - self._focused_at
        return taken is None or (asked.every is not None and taken >= asked.every)

    def _focus(self, planned: PlannedFrame) -> bool:
        """Focus on the scene of a frame; returns False when the capture was asked to stop.

        Where no peak is seen the axis is left where it stood, which is told.
        """
        assert self._plan.focus is not None
        began_s, from_um = self._recorder.now_s(), list[float]()
        span_um = self._plan.focus.span_um
        found = self._retrying(
            planned.id, lambda attempt: self._engine.focus(planned, span_um, from_um)
        )
        if found is None:
            return False
        self._focused_at = self._taken
        entry = FocusEntry(
            id=planned.id,
            from_um=from_um[0],
            place_um=None if isinstance(found, str) else found.place_um,
            deviation_um=None if isinstance(found, str) else found.deviation_um,
            fault=found if isinstance(found, str) else "",
            at_s=began_s,
            seconds=round(self._recorder.now_s() - began_s, 6),
        )
        self._recorder.note(entry, str(entry))
        return True

    def _take_frame(self, planned: PlannedFrame, about: Callable[[], Facts] = dict) -> None:
        """Take a frame, with as many tries as it needs, and learn from it how long frames take."""
        devices, now_s = self._engine.devices, self._recorder.now_s
        began_s, before_um = now_s(), dict(devices.sent.offsets_um)
        tries = 0

        def attempt(number: int) -> float:
            nonlocal tries
            tries = number
            return self._engine.take(planned, number, about)

        attended_s = self._retrying(planned.id, attempt)
        if tries == 1:
            self._pace.learn(
                now_s() - began_s - attended_s,
                devices.sent.exposure_s or 0.0,
                self._pace.moving_s(planned, before_um),
            )
        self._count_taken(planned)

    def _count_taken(self, planned: PlannedFrame) -> None:
        """Count a frame, and report from time to time how long the rest will take."""
        self._taken += 1
        now_s = self._recorder.now_s()
        if now_s - self._remaining_reported_s < REMAINING_TIME_INTERVAL_S:
            return
        self._remaining_reported_s = now_s
        left = [frame for frame in self._session.missing() if frame.id != planned.id]
        at_um = self._engine.devices.sent.offsets_um
        rest = self._pace.estimate(left, self._exposures.known_s, at_um)
        self._recorder.emit("left", seconds=round(rest.seconds, 3), guessed=rest.guessed)

    # Faults.

    def _retrying(self, name: str, attempt: Callable[[int], T]) -> T:
        """Return what an attempt returns, after as many tries as it needs within the budget.

        attempt: gets its number, from 1. After a fault the devices are mended, which may fail too.
        """
        faults = attempts = 0
        mend: Callable[[], None] | None = None
        while True:
            try:
                if mend is not None:
                    mend()
                mend = None
                attempts += 1
                return attempt(attempts)
            except DriverError as error:
                faults += 1
                at_s = self._recorder.now_s()
                entry = RetryEntry(id=name, fault=str(error), attempt=faults, at_s=at_s)
                self._recorder.note(entry)
                self._budget.spend(name, error, faults)
                self._recorder.tell(f"{name}, try {faults}: {error}")
                if isinstance(error, WrongPlaceError):
                    self._rig.attendant.again(error.axes)
                mend = partial(self._engine.devices.mend, mending(error, faults))

    @contextmanager
    def _bench_left_safe(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            with uninterrupted():
                with suppress(DriverError):
                    self._rig.stage.stop()
                # Where the disk fails, that is reported already.
                if isinstance(error, Exception | KeyboardInterrupt):
                    with suppress(Exception):
                        reason = str(error) or "stopped at once by the user"
                        self._recorder.note(HaltEntry(kind="stopped", reason=reason))
            raise
        finally:
            with uninterrupted():
                self._engine.devices.make_safe()

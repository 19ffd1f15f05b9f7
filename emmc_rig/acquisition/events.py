"""What happens in a capture, as events: for a lab's own code, or as lines of JSON.

| event | facts |
|---|---|
| `begin` | `done`, `planned`: frames |
| `frame.taken` | `id`, `kind`, `shot`, `exposure_s`, `level` (1: white), `saturated` (share) |
| `frame.written` | `id`, `kind`, `shot`, `done`, `planned`: it is on the disk, and counts |
| `shot.done` | `shot`: every frame of it is on the disk |
| `left` | `seconds`, `guessed`: frames whose exposure is not known yet |
| `pause` | `reason` |
| `resume` | `seconds`: how long it stood still |
| `message` | `text`: retries, what metering and `--until` decided |
| `verdict` | `level`, `reasons`: of the exposures, at the end |
| `end` | `complete`, `taken`, `missing`, `retries`, `seconds`, `session` |
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from drivers.raw import RawFrame
from emmc_rig.acquisition.watcher import CaptureWatcher, RunEnd
from emmc_rig.session.brightness import level_of
from emmc_rig.session.exposure import exposure_reasons, shot_exposures
from emmc_rig.session.journal import Figures
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

if TYPE_CHECKING:
    from reconstruction.result import Reconstruction


@dataclass(frozen=True)
class Event:
    """name, facts: see the table above; at_s: seconds since the capture was asked for."""

    name: str
    at_s: float
    facts: Mapping[str, Any]

    def line(self) -> str:
        """Return it as one line of JSON."""
        return json.dumps({"event": self.name, "at_s": self.at_s, **self.facts}, allow_nan=False)


OnEvent = Callable[[Event], None]


class EventWatcher(CaptureWatcher):
    """A `CaptureWatcher` that makes events of what is captured, and calls another watcher too.

    on_event: called from the thread in which it happens, one call at a time. One that raises is
    not called again: a capture does not end for that.
    """

    def __init__(self, on_event: OnEvent, other: CaptureWatcher | None = None) -> None:
        self._on_event: OnEvent | None = on_event
        self._other = other or CaptureWatcher()
        self._began_s = self._asked_s = time.perf_counter()
        self._lock = threading.RLock()
        self._done = self._planned = 0

    def begin(self, done: int, planned: int) -> None:
        """So many frames are there already."""
        self._done, self._planned = done, planned
        self._other.begin(done, planned)
        self._emit("begin", done=done, planned=planned)

    def more(self, planned: int) -> None:
        """So many frames are to be taken in all."""
        self._planned = planned
        self._other.more(planned)

    def step(self, name: str, frame: PlannedFrame) -> None:
        """A step of a frame: no event, there are too many."""
        self._other.step(name, frame)

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """A frame passed its checks."""
        self._other.taken(planned, frame, found)
        self._emit(
            "frame.taken",
            **_named(planned),
            exposure_s=frame.exposure_s,
            level=level_of(frame, found),
            saturated=found.saturated,
        )

    def stored(self, frame: PlannedFrame) -> None:
        """A frame is on the disk."""
        self._done += 1
        self._other.stored(frame)
        self._emit("frame.written", **_named(frame), done=self._done, planned=self._planned)

    def shot_done(self, shot: int) -> None:
        """Every frame of a shot is on the disk."""
        self._other.shot_done(shot)
        self._emit("shot.done", shot=shot)

    def light_field(self, shots: Sequence[int], result: Reconstruction) -> None:
        """What shots give so far: no event, the journal states its figures."""
        self._other.light_field(shots, result)

    def left(self, seconds: float, guessed: int) -> None:
        """How long the rest will take."""
        self._other.left(seconds, guessed)
        self._emit("left", seconds=round(seconds, 3), guessed=guessed)

    def asked(self, what: str) -> None:
        """Somebody has to do something at the bench: a pause."""
        self._other.asked(what)
        if what:
            self._asked_s = time.perf_counter()
            self._emit("pause", reason=f"please {what}")
        else:
            self._emit("resume", seconds=round(time.perf_counter() - self._asked_s, 3))

    def paused(self, reason: str) -> None:
        """The capture waits."""
        self._other.paused(reason)
        self._emit("pause", reason=reason)

    def resumed(self, seconds: float) -> None:
        """It goes on."""
        self._other.resumed(seconds)
        self._emit("resume", seconds=round(seconds, 3))

    def tell(self, message: str) -> None:
        """Something that people should know."""
        self._other.tell(message)
        self._emit("message", text=message)

    def ended(self, session: Session, outcome: RunEnd) -> None:
        """A run is over."""
        self._other.ended(session, outcome)
        reasons = exposure_reasons(shot_exposures(session))
        level = reasons[0].level if reasons else "trust"
        self._emit("verdict", level=level, reasons=[asdict(reason) for reason in reasons])
        self._emit("end", **asdict(outcome), session=str(session.folder))

    def _emit(self, name: str, **facts: Any) -> None:
        with self._lock:
            if self._on_event is None:
                return
            at_s = round(time.perf_counter() - self._began_s, 6)
            try:
                self._on_event(Event(name, at_s, facts))
            except Exception as fault:
                self._on_event = None
                what = f"{type(fault).__name__}: {fault}".partition("\n")[0]
                self._other.tell(f"no more events, on_event failed at {name} ({what})")


def _named(frame: PlannedFrame) -> dict[str, Any]:
    return {"id": frame.id, "kind": frame.kind, "shot": frame.bench.shot}

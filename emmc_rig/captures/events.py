"""Events of a capture: for a lab's own code, as lines of JSON, and for displays of this program.

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

Displays of this program also get objects with some events, and events that no JSON line states:

| event | facts | objects |
|---|---|---|
| `step` | `id`, `step`: attend, move, expose, write, ... begins | `planned` |
| `planned` | `planned`: frames to take in all, at each change | |
| `frame.taken` | see above | `planned`, `frame` |
| `pause`, `resume` | see above | `asked`: the work at the bench that a person is asked for |
| `light field` | `shots`: those reconstructed so far | `result` |
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Container
from dataclasses import asdict, dataclass, replace
from typing import Any

from emmc_rig.progress import Event, Watcher
from emmc_rig.session.brightness import exposure_reasons, shot_exposures
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

OnEvent = Callable[[Event], None]
PUBLIC = frozenset(
    {
        *("begin", "frame.taken", "frame.written", "shot.done", "left", "pause", "resume"),
        *("message", "verdict", "end"),
    }
)
"""Names of the events in the first table."""
DISPLAYED = PUBLIC | {"step", "planned", "light field"}


@dataclass(frozen=True)
class RunEnd:
    """How a run ended: complete, or stopped by whoever controls it."""

    complete: bool
    taken: int
    missing: int
    retries: int
    seconds: float


class Listener(Watcher):
    """Gives the events of a capture to a function, after another watcher had them.

    on_event: called from the thread in which an event happens, for one event at a time. A function
    that raises is not called again, which the other watcher is told: the capture goes on.
    names: of the events to give.
    """

    def __init__(
        self,
        on_event: OnEvent,
        other: Watcher | None = None,
        names: Container[str] = PUBLIC,
    ) -> None:
        self._on_event: OnEvent | None = on_event
        self._other, self._names = other or Watcher(), names
        self._began_s = time.perf_counter()
        self._lock = threading.RLock()

    def tell(self, message: str) -> None:
        """Give a note to the other watcher as such, and to the function as an event."""
        self._other.tell(message)
        self._give(Event("message", {"text": message}))

    def event(self, event: Event) -> None:
        """Give an event to the other watcher and to the function."""
        self._other.event(event)
        self._give(event)

    def _give(self, event: Event) -> None:
        with self._lock:
            if self._on_event is None or event.name not in self._names:
                return
            try:
                at_s = round(time.perf_counter() - self._began_s, 6)
                self._on_event(replace(event, at_s=at_s))
            except Exception as fault:
                self._on_event = None
                what = f"{type(fault).__name__}: {fault}".partition("\n")[0]
                self._other.tell(f"no more events, on_event failed at {event.name} ({what})")


def named(frame: PlannedFrame) -> dict[str, Any]:
    """Return the facts that name a frame in an event."""
    return {"id": frame.id, "kind": frame.kind, "shot": frame.bench.shot}


def emit_end(watcher: Watcher, session: Session, outcome: RunEnd) -> None:
    """Emit the verdict on a session's exposures, and how the run ended."""
    reasons = exposure_reasons(shot_exposures(session))
    level = reasons[0].level if reasons else "trust"
    plain = [asdict(reason) for reason in reasons]
    watcher.event(Event("verdict", {"level": level, "reasons": plain}))
    watcher.event(Event("end", {**asdict(outcome), "session": str(session.folder)}))

"""The one way to observe a long run: stages and steps, notes for people, and events."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from emmc_rig.reconstruction.result import Progress


@dataclass(frozen=True)
class Event:
    """Something that a run makes known, by name.

    facts: plain data. objects: the frame, result or else that the facts describe, for displays of
    this program; not in the JSON line. at_s: seconds since the run was asked for.
    """

    name: str
    facts: Mapping[str, Any] = field(default_factory=dict)
    objects: Mapping[str, Any] = field(default_factory=dict, repr=False)
    at_s: float = 0.0

    def line(self) -> str:
        """Return the event as a line of JSON."""
        return json.dumps({"event": self.name, "at_s": self.at_s, **self.facts}, allow_nan=False)


class Watcher:
    """Observes a long run and shows nothing; a subclass overrides the methods that it needs.

    Runs may call every method from any of their threads.
    """

    def begin(self, stage: str, steps: int | None = None) -> None:
        """Begin a stage, which ends the stage before. steps: their number, None where unknown."""

    def step(self, detail: str = "") -> None:
        """Count a step of the current stage as done."""

    def at(self, done: float, steps: float | None, detail: str = "") -> None:
        """Set the number of steps done in the current stage."""

    def advance(self, progress: Progress) -> None:
        """Set the steps done to those of a solver: its `on_step`."""
        change = progress.relative_change
        self.at(progress.step, progress.total, "" if change is None else f"change {change:.1e}")

    def tell(self, message: str) -> None:
        """Give people a note; by default as the event `message`."""
        self.event(Event("message", {"text": message}))

    def event(self, event: Event) -> None:
        """Take note of an event; the module that emits events lists their names and facts."""


class Notes(Watcher):
    """Passes only notes on to another watcher: of a part of its run, whose steps do not count."""

    def __init__(self, other: Watcher) -> None:
        self._other = other

    def tell(self, message: str) -> None:
        """Give people a note."""
        self._other.tell(message)

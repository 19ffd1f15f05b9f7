"""What shows the progress of a capture: the interface that the sequencer calls, and a silent one.

Its stages and steps are those of every `emmc_rig.progress.Watcher`: a step is a frame on the disk.
"""

from __future__ import annotations

from typing import Protocol

from drivers.raw import RawFrame
from emmc_rig.capture.checks import Figures
from emmc_rig.progress import Silent, Watcher
from emmc_rig.session.planned import PlannedFrame

PHASES = ("attend", "move", "settle", "expose", "read back", "check", "hand over", "write")
"""Of one frame, in order."""


class CaptureWatcher(Watcher, Protocol):
    """Shows a capture; `step` and `phase` may be called from the writer's thread."""

    def begin(self, stage: str, steps: int | None, done: int = 0) -> None:
        """Begin a stage; `done` of its steps were done by an earlier run."""
        ...

    def more(self, planned: int) -> None:
        """Raise the number of steps: more frames are needed than were known."""
        ...

    def phase(self, name: str, frame: PlannedFrame) -> None:
        """Show that a phase of a frame begins: one of PHASES."""
        ...

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """Show a frame that passed its checks."""
        ...

    def notify(self, message: str) -> None:
        """Show a message."""
        ...


class Unwatched(Silent):
    """A watcher of a capture that shows nothing."""

    def begin(self, stage: str, steps: int | None, done: int = 0) -> None:
        """Ignore it."""

    def more(self, planned: int) -> None:
        """Ignore it."""

    def phase(self, name: str, frame: PlannedFrame) -> None:
        """Ignore it."""

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """Ignore it."""

    def notify(self, message: str) -> None:
        """Ignore it."""

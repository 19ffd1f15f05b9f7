"""What shows a capture: the interface that the sequencer calls, and one that shows nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from drivers.raw import RawFrame
from emmc_rig.capture.checks import Figures
from emmc_rig.session.planned import PlannedFrame

if TYPE_CHECKING:
    from emmc_rig.capture.sequencer import RunEnd
    from emmc_rig.session.session import Session

STEPS = ("attend", "move", "settle", "expose", "read back", "check", "hand over", "write")


class CaptureWatcher(Protocol):
    """Whoever shows a capture; `step` and `stored` may be called from the writer's thread."""

    def begin(self, done: int, planned: int) -> None:
        """So many frames are there already."""
        ...

    def more(self, planned: int) -> None:
        """So many frames are to be taken in all, more than were known of."""
        ...

    def step(self, name: str, frame: PlannedFrame) -> None:
        """A step of a frame begins: one of `STEPS`."""
        ...

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """A frame passed its checks."""
        ...

    def stored(self, frame: PlannedFrame) -> None:
        """A frame is on the disk."""
        ...

    def left(self, seconds: float, guessed: int) -> None:
        """So long the rest will take; guessed: frames of which the exposure is not known yet."""
        ...

    def shot_done(self, shot: int) -> None:
        """Every frame of a shot is on the disk."""
        ...

    def paused(self, reason: str) -> None:
        """The capture waits."""
        ...

    def resumed(self, seconds: float) -> None:
        """It goes on after so long."""
        ...

    def tell(self, message: str) -> None:
        """Something that people should know."""
        ...

    def ended(self, session: Session, outcome: RunEnd) -> None:
        """A run is over, complete or not."""
        ...


class Unwatched:
    """A watcher that shows nothing."""

    def begin(self, done: int, planned: int) -> None:
        """Ignore it."""

    def more(self, planned: int) -> None:
        """Ignore it."""

    def step(self, name: str, frame: PlannedFrame) -> None:
        """Ignore it."""

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """Ignore it."""

    def stored(self, frame: PlannedFrame) -> None:
        """Ignore it."""

    def left(self, seconds: float, guessed: int) -> None:
        """Ignore it."""

    def shot_done(self, shot: int) -> None:
        """Ignore it."""

    def paused(self, reason: str) -> None:
        """Ignore it."""

    def resumed(self, seconds: float) -> None:
        """Ignore it."""

    def tell(self, message: str) -> None:
        """Ignore it."""

    def ended(self, session: Session, outcome: RunEnd) -> None:
        """Ignore it."""

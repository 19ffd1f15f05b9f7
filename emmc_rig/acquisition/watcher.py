"""What shows a capture: what the sequencer calls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.raw import RawFrame
from emmc_rig.session.journal import Figures
from emmc_rig.session.planned import PlannedFrame

if TYPE_CHECKING:
    from emmc_rig.session.session import Session
    from reconstruction.result import Reconstruction

STEPS = (
    *("attend", "between", "move", "settle", "expose", "read back", "check"),
    *("hand over", "write"),
)


@dataclass(frozen=True)
class RunEnd:
    """How a run ended: complete, or stopped by whoever controls it."""

    complete: bool
    taken: int
    missing: int
    retries: int
    seconds: float


class CaptureWatcher:
    """Shows nothing; whoever shows a capture overrides what it needs.

    `step` and `stored` may be called from the writer's thread.
    """

    def begin(self, done: int, planned: int) -> None:
        """So many frames are there already."""

    def more(self, planned: int) -> None:
        """So many frames are to be taken in all, more than were known of."""

    def step(self, name: str, frame: PlannedFrame) -> None:
        """A step of a frame begins: one of `STEPS`."""

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """A frame passed its checks."""

    def stored(self, frame: PlannedFrame) -> None:
        """A frame is on the disk."""

    def left(self, seconds: float, guessed: int) -> None:
        """So long the rest will take; guessed: frames of which the exposure is not known yet."""

    def shot_done(self, shot: int) -> None:
        """Every frame of a shot is on the disk."""

    def light_field(self, shots: Sequence[int], result: Reconstruction) -> None:
        """What these shots give so far."""

    def asked(self, what: str) -> None:
        """Somebody has to do this at the bench; "": it is done."""

    def paused(self, reason: str) -> None:
        """The capture waits."""

    def resumed(self, seconds: float) -> None:
        """It goes on after so long."""

    def tell(self, message: str) -> None:
        """Something that people should know."""

    def ended(self, session: Session, outcome: RunEnd) -> None:
        """A run is over, complete or not."""

"""What a capture shows: bar, time left and the brightest readings on a terminal; words elsewhere.

On a terminal p pauses and resumes, and q stops after the current frame.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console, Group
from rich.live import Live
from rich.progress import Progress, TaskID
from rich.text import Text

from drivers.raw import RawFrame
from emmc_rig.acquisition.control import Control, pressed_keys
from emmc_rig.acquisition.watcher import CaptureWatcher
from emmc_rig.commands.output import columns
from emmc_rig.files.results import shown_seconds
from emmc_rig.session.brightness import level_of
from emmc_rig.session.journal import Figures
from emmc_rig.session.planned import PlannedFrame

KEY_POLL_S = 0.1
PAUSE_KEY, STOP_KEY = "p", "q"


class CaptureDisplay(CaptureWatcher):
    """A `CaptureWatcher` of the sequencer."""

    def __init__(self, console: Console, control: Control) -> None:
        self._console, self._control = console, control
        self._progress = Progress(*columns(), console=console)
        self._task: TaskID | None = None
        self._line = Text()
        self._live: Live | None = None
        self._asking = False
        self._left = self._doing = ""

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Draw on the terminal, and listen to its keys, until the block ends."""
        if not self._console.is_terminal:
            yield
            return
        ended = threading.Event()
        with (
            pressed_keys() as pressed,
            Live(console=self._console, get_renderable=self._drawn, refresh_per_second=8) as live,
        ):
            self._live = live
            self._task = self._progress.add_task("open the rig", total=None, detail="")
            listener = threading.Thread(target=self._listen, args=(pressed, ended), name="keys")
            listener.start()
            try:
                yield
            finally:
                ended.set()
                listener.join()
                self._live = None

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Leave the terminal, its keys too, to a question."""
        live = self._live
        self._asking = True
        if live is not None:
            live.stop()
        try:
            yield
        finally:
            if live is not None:
                live.start()
            self._asking = False

    def begin(self, done: int, planned: int) -> None:
        """Start the bar."""
        if self._task is not None:
            self._progress.update(self._task, description="frames", total=planned, completed=done)
        if done:
            self.tell(f"{done} of {planned} frames are captured already")

    def more(self, planned: int) -> None:
        """Lengthen the bar."""
        if self._task is not None:
            self._progress.update(self._task, total=planned)

    def step(self, name: str, frame: PlannedFrame) -> None:
        """Say what is under way."""
        if name != "write":
            paused = "paused (p: go on): " if self._control.paused else ""
            self._doing = f"{paused}{frame.id}: {name}"
            self._update()

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """Show how bright the frame is."""
        if self._live is None:
            return
        self._line = Text(
            f"{planned.id}: {frame.exposure_s or 0:g} s, brightest {level_of(frame, found):.0%} of "
            f"white, saturated {found.saturated:.2%}"
        )

    def stored(self, frame: PlannedFrame) -> None:
        """Advance the bar."""
        if self._task is not None:
            self._progress.update(self._task, advance=1)

    def left(self, seconds: float, guessed: int) -> None:
        """Show how long the rest will take."""
        unknown = f" (excludes {guessed} exposures not metered yet)" if guessed else ""
        self._left = f"about {shown_seconds(seconds)} left{unknown}"
        self._update()

    def paused(self, reason: str) -> None:
        """Say why nothing happens."""
        self.tell(f"waiting: {reason}")

    def resumed(self, seconds: float) -> None:
        """Say that it goes on."""
        self.tell(f"going on after {shown_seconds(seconds)}")

    def tell(self, message: str) -> None:
        """Print a line."""
        self._console.print(f"emmc-rig capture: {message}", highlight=False, soft_wrap=True)

    def _update(self) -> None:
        if self._task is not None:
            detail = "; ".join(filter(None, (self._left, self._doing)))
            self._progress.update(self._task, detail=detail)

    def _drawn(self) -> Group:
        return Group(self._line, self._progress)

    def _listen(self, pressed, ended: threading.Event) -> None:
        while not ended.wait(KEY_POLL_S):
            key = "" if self._asking else pressed()
            if key == PAUSE_KEY:
                if self._control.paused:
                    self._control.resume()
                else:
                    self._control.pause()
                    self.tell("pausing after this frame; press p to go on")
            elif key == STOP_KEY:
                self._control.stop()
                self.tell("stopping after this frame")

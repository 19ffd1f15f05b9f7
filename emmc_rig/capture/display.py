"""What a capture shows: bar, time left and the frame's histogram on a terminal, else plain lines.

On a terminal p pauses and resumes, and q stops after the present frame.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from drivers.raw import RawFrame
from emmc_rig.capture.checks import Figures
from emmc_rig.capture.control import Control
from emmc_rig.capture.keyboard import pressed_keys
from emmc_rig.pages.frame_view import histogram, histogram_text, thinned
from emmc_rig.session.planned import PlannedFrame

KEY_POLL_S = 0.1
PAUSE_KEY, STOP_KEY = "p", "q"


class CaptureDisplay:
    """A `CaptureWatcher` on a terminal."""

    def __init__(self, console: Console, control: Control) -> None:
        self._console, self._control = console, control
        self._progress = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=console,
        )
        self._task: TaskID | None = None
        self._histogram = Text()
        self._line = Text()
        self._live: Live | None = None
        self._done = 0
        self._planned: int | None = None
        self._asking = False

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

    def begin(self, stage: str, steps: int | None, done: int = 0) -> None:
        """Start the bar."""
        self._done, self._planned = done, steps
        self._task = self._progress.add_task(stage, total=steps, completed=done)
        if not self._console.is_terminal and done:
            self.notify(f"{done} of {steps} frames are there already")

    def more(self, planned: int) -> None:
        """Lengthen the bar."""
        self._planned = planned
        if self._task is not None:
            self._progress.update(self._task, total=planned)

    def phase(self, name: str, frame: PlannedFrame) -> None:
        """Show the phase under way."""
        if self._live is not None and self._task is not None and name != "write":
            paused = "paused, p goes on: " if self._control.paused else ""
            self._progress.update(self._task, description=f"{paused}{frame.id}: {name}")

    def taken(self, planned: PlannedFrame, frame: RawFrame, found: Figures) -> None:
        """Show the frame's histogram."""
        span = max(1.0, frame.white_level_dn - float(frame.black_level_dn.mean()))
        line = (
            f"{planned.id}: {frame.exposure_s or 0:g} s, brightest {found.bright_dn / span:.0%} of "
            f"white, saturated {found.saturated:.2%}"
        )
        if self._live is not None:
            few = replace(frame, mosaic=thinned(frame.mosaic))
            self._histogram = histogram_text(histogram(few))
            self._line = Text(line)
        elif not self._console.is_terminal:
            self._console.print(
                f"{time.strftime('%H:%M:%S')} {self._done + 1}/{self._planned} {line}",
                highlight=False,
                soft_wrap=True,
            )
            self._done += 1

    def step(self, detail: str) -> None:
        """Advance the bar."""
        if self._task is not None:
            self._progress.update(self._task, advance=1)

    def notify(self, message: str) -> None:
        """Print a line."""
        self._console.print(f"emmc-rig capture: {message}", highlight=False, soft_wrap=True)

    def _drawn(self) -> Group:
        return Group(self._histogram, self._line, self._progress)

    def _listen(self, pressed, ended: threading.Event) -> None:
        while not ended.wait(KEY_POLL_S):
            key = "" if self._asking else pressed()
            if key == PAUSE_KEY:
                if self._control.paused:
                    self._control.resume()
                else:
                    self._control.pause()
                    self.notify("pausing after this frame; p goes on")
            elif key == STOP_KEY:
                self._control.stop()
                self.notify("stopping after this frame")

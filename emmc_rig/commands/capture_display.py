"""What a capture shows: bar, time left and the brightest readings on a terminal; words elsewhere.

On a terminal p pauses and resumes, and q stops after the current frame.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import Progress, TaskID
from rich.text import Text

from emmc_rig.captures.control import Control, pressed_keys
from emmc_rig.commands.output import columns
from emmc_rig.progress import Event, Watcher
from emmc_rig.store.results import shown_seconds

KEY_POLL_S = 0.1
PAUSE_KEY, STOP_KEY = "p", "q"


class CaptureDisplay(Watcher):
    """Shows a capture and its keys, see `emmc_rig.captures.events`."""

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

    def event(self, event: Event) -> None:
        """Show an event of a capture."""
        facts = event.facts
        match event.name:
            case "begin":
                done, planned = facts["done"], facts["planned"]
                self._set_bar(description="frames", total=planned, completed=done)
                if done:
                    self.tell(f"{done} of {planned} frames are captured already")
            case "planned":
                self._set_bar(total=facts["planned"])
            case "step" if facts["step"] != "write":
                paused = "paused (p: go on): " if self._control.paused else ""
                self._doing = f"{paused}{facts['id']}: {facts['step']}"
                self._set_detail()
            case "frame.taken":
                self._line = Text(
                    f"{facts['id']}: {facts['exposure_s'] or 0:g} s, brightest "
                    f"{facts['level']:.0%} of white, saturated {facts['saturated']:.2%}"
                )
            case "frame.written":
                self._set_bar(advance=1)
            case "left":
                guessed = facts["guessed"]
                unknown = f" (excludes {guessed} exposures not metered yet)" if guessed else ""
                self._left = f"about {shown_seconds(facts['seconds'])} left{unknown}"
                self._set_detail()
            case "pause" if "asked" not in event.objects:
                self.tell(f"waiting: {facts['reason']}")
            case "resume" if "asked" not in event.objects:
                self.tell(f"going on after {shown_seconds(facts['seconds'])}")
            case "message":
                line = f"emmc-rig capture: {facts['text']}"
                self._console.print(line, highlight=False, soft_wrap=True)

    def _set_bar(self, **parts: Any) -> None:
        if self._task is not None:
            self._progress.update(self._task, **parts)

    def _set_detail(self) -> None:
        self._set_bar(detail="; ".join(filter(None, (self._left, self._doing))))

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

"""How a running capture is paused, resumed and stopped: from another thread, a key or a signal."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from emmc_rig.errors import StoppedError

PAUSE_POLL_S = 0.05
ENDING = ("SIGTERM", "SIGBREAK" if sys.platform == "win32" else "SIGHUP")
"""A request to end, and a terminal that closed."""


class Control:
    """Requests to a capture, from any thread or signal handler.

    The sequencer reads them between frames. They are plain flags: a signal handler must not wait
    for a lock, which the interrupted code may hold.

    stays: at the end the capture waits until it is stopped, so that frames may be taken again.
    between_frames: a hook is running, so that nothing is lost by stopping at once.
    answered: a person has done the work at the bench that the capture requested.
    """

    def __init__(self, stays: bool = False) -> None:
        self.paused = False
        self.between_frames = False
        self.stopping = False
        self.stays = stays
        self.answered = False
        self._again: list[str] = []

    def take_again(self, ids: Iterable[str]) -> None:
        """Take these frames once more."""
        self._again += ids

    @property
    def again(self) -> bool:
        """Whether frames are to be taken once more."""
        return bool(self._again)

    @property
    def halting(self) -> bool:
        """Whether somebody wants something else than the next frame."""
        return self.stopping or self.paused or self.again

    def pop_again(self) -> list[str]:
        """Return the frames to take once more, and forget them."""
        ids, self._again = self._again, []
        return list(dict.fromkeys(ids))

    def pause(self) -> None:
        """Begin no further frame until `resume`."""
        self.paused = True

    def resume(self) -> None:
        """Go on."""
        self.paused = False

    def stop(self) -> None:
        """End after the present frame, paused or not."""
        self.stopping = True

    def until_answered(self, pressed: Callable[[], str] = lambda: "") -> None:
        """Wait for the answer to a request at the bench; Enter among the keys pressed answers, too.

        Raises StoppedError if the capture is to stop.
        """
        while not self.answered and pressed() not in ("\n", "\r"):
            if self.stopping:
                raise StoppedError("stopped")
            self.wait()

    def wait(self) -> None:
        """Let a moment pass in which nothing is to be done."""
        time.sleep(PAUSE_POLL_S)


@contextmanager
def interruptible(control: Control, say: Callable[[str], None]) -> Iterator[None]:
    """Let Ctrl-C stop after the present frame, and the second one, or `ENDING`, now.

    Within a hook the first one stops now too. "Now" raises `KeyboardInterrupt` in the main thread.
    Elsewhere than there nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and not control.stopping and not control.between_frames:
            control.stop()
            say("stopping after this frame; Ctrl-C again stops now")
            return
        raise KeyboardInterrupt

    with handled(interrupt, ("SIGINT", *ENDING)):
        yield


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold signals back while the bench is made safe."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with handled(signal.SIG_IGN, ("SIGINT", *ENDING)):
        yield


@contextmanager
def handled(handler: Any, names: Iterable[str]) -> Iterator[None]:
    """Let `handler` take the signals named; main thread only."""
    before = {signal.Signals[name]: signal.signal(signal.Signals[name], handler) for name in names}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextmanager
def signals_interrupt() -> Iterator[None]:
    """Let a request to end, or a closed terminal, act as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    with handled(interrupt, ENDING):
        yield


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the key just pressed, "" for none, or where none can be."""
    if sys.platform == "win32":
        import msvcrt

        yield lambda: msvcrt.getwch() if sys.stdin.isatty() and msvcrt.kbhit() else ""
        return
    import termios
    import tty

    before = None
    with suppress(termios.error, OSError, ValueError):  # where keys come from no terminal
        before = termios.tcgetattr(sys.stdin)
    if before is None:
        yield lambda: ""
        return
    keyboard = sys.stdin.fileno()
    try:
        tty.setcbreak(keyboard)
        yield (
            lambda: (
                os.read(keyboard, 1).decode("ascii", "replace")
                if select.select([keyboard], [], [], 0)[0]
                else ""
            )
        )
    finally:
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)

"""Keys pressed on the terminal, read one at a time without waiting."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the key just pressed, "" for none, or where none can be."""
    before = _terminal_settings()
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


def _terminal_settings() -> list | None:
    """Return how the terminal is set that keys come from; None: no terminal."""
    try:
        return termios.tcgetattr(sys.stdin)
    except (termios.error, OSError, ValueError):
        return None

"""Keys pressed on the terminal, read one at a time without waiting."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

FIRST_OF_TWO = "\x00\xe0"
"""What a Windows console gives before the code of a key without a character."""


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the key just pressed, "" for none, or where none can be."""
    try:
        import msvcrt
    except ImportError:  # not Windows
        pass
    else:
        yield lambda: _console_key(msvcrt) if sys.stdin.isatty() else ""
        return
    before = _terminal_settings()
    if before is None:
        yield lambda: ""
        return
    import termios
    import tty

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


def _console_key(console: Any) -> str:
    """Return the key just pressed in a Windows console; one of two codes, as F1, counts as none."""
    if not console.kbhit():
        return ""
    key = console.getwch()
    if key in FIRST_OF_TWO:
        console.getwch()
        return ""
    return key


def _terminal_settings() -> list | None:
    """Return how the terminal is set that keys come from; None: no terminal."""
    import termios

    try:
        return termios.tcgetattr(sys.stdin)
    except (termios.error, OSError, ValueError):
        return None

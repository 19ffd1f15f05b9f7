"""Signals of the operating system, handled in another way for a while."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

ENDING = ("SIGTERM", "SIGHUP")
"""A request to end, and a terminal that closed; not every system has both."""


@contextmanager
def handled(handler: Any, names: Iterable[str]) -> Iterator[None]:
    """Let `handler` take the signals named, as far as there are such; main thread only."""
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {number: signal.signal(number, handler) for number in numbers}
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

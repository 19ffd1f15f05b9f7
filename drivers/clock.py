"""The time a driver sees: passed in, so that simulated time can stand in for the real one."""

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds from an arbitrary origin that never run backwards, and a way to let them pass."""

    def now_s(self) -> float:
        """Return the time in seconds."""
        ...

    def sleep(self, duration_s: float, /) -> None:
        """Return `duration_s` seconds later."""


class SystemClock:
    """The computer's own monotonic clock."""

    now_s = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)


SYSTEM_CLOCK = SystemClock()

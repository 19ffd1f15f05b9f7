"""Time that passes when someone sleeps, so that a simulated hour costs nothing."""

import threading
import time


class ManualClock:
    """A `drivers.clock.Clock` whose time is moved by `sleep` alone; safe across threads."""

    def __init__(self) -> None:
        self._now_s = 0.0
        self._lock = threading.Lock()

    def now_s(self) -> float:
        """Return the time in seconds since the clock was made."""
        with self._lock:
            return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Let `duration_s` seconds pass at once; raises `ValueError` for a negative duration."""
        if duration_s < 0:
            raise ValueError(f"cannot sleep for {duration_s:g} s")
        with self._lock:
            self._now_s += duration_s


class JumpingClock(ManualClock):
    """As `ManualClock`, but real time passes too: for wires on which bytes really travel.

    `pace` seconds pass in a real one.
    """

    def __init__(self, pace: float = 1.0) -> None:
        super().__init__()
        self.pace = pace
        self._made_s = time.monotonic()

    def now_s(self) -> float:
        """Return the time in seconds since the clock was made."""
        return super().now_s() + self.pace * (time.monotonic() - self._made_s)

"""Time that passes when someone sleeps, so that a simulated hour costs nothing."""

import threading


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

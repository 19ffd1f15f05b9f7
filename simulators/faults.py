"""Faults of simulated devices: armed by name, each strikes a stated number of times."""

from collections import Counter
from collections.abc import Iterable

ALWAYS = 1 << 62


class Faults:
    """The faults one device knows, when each strikes next and how often."""

    def __init__(self, known: Iterable[str]) -> None:
        self.known = tuple(known)
        self._armed: Counter[str] = Counter()
        self._passed_over: Counter[str] = Counter()

    def inject(self, name: str, times: int = 1, after: int = 0) -> None:
        """Arm a fault for the next `times` occasions, `after` so many have passed unharmed.

        Raises `ValueError` for an unknown name.
        """
        if name not in self.known:
            raise ValueError(f"no fault {name!r}: use one of {', '.join(self.known)}")
        self._armed[name] += times
        self._passed_over[name] = after

    def clear(self) -> None:
        """Disarm every fault."""
        self._armed.clear()

    def strikes(self, name: str) -> bool:
        """Return whether the fault strikes now, and count it."""
        if not self._armed[name]:
            return False
        if self._passed_over[name]:
            self._passed_over[name] -= 1
            return False
        self._armed[name] -= 1
        return True

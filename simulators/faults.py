"""Faults of simulated devices: armed by name, each strikes a stated number of times."""

from collections import Counter
from collections.abc import Iterable


class Faults:
    """The faults one device knows, and how often each is still to strike."""

    def __init__(self, known: Iterable[str]) -> None:
        self.known = tuple(known)
        self._armed: Counter[str] = Counter()

    def inject(self, name: str, times: int = 1) -> None:
        """Arm a fault for the next `times` occasions; raises `ValueError` for an unknown name."""
        if name not in self.known:
            raise ValueError(f"no fault {name!r}: use one of {', '.join(self.known)}")
        self._armed[name] += times

    def strikes(self, name: str) -> bool:
        """Return whether the fault strikes now, and count it."""
        if not self._armed[name]:
            return False
        self._armed[name] -= 1
        return True

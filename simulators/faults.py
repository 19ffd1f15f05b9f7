"""Faults of simulated devices: armed by name, each strikes a stated number of times."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

Condition = Callable[[Any], bool]


@dataclass
class _Armed:
    """A fault that waits for its occasion."""

    times: float
    skip: int
    when: Condition | None


class Faults:
    """The known faults of a device, and the armed faults."""

    def __init__(self, known: Iterable[str]) -> None:
        self.known = tuple(known)
        self._armed: dict[str, list[_Armed]] = {name: [] for name in self.known}

    def inject(
        self,
        name: str,
        times: float = 1,
        skip: int = 0,
        when: Condition | None = None,
    ) -> None:
        """Arm a fault for the next `times` occasions (`math.inf`: from then on, always).

        It lets pass whatever `when` does not hold for (it is given what the device states of the
        occasion), then `skip` occasions. Raises `ValueError` for an unknown name.
        """
        if name not in self._armed:
            raise ValueError(f"no fault {name!r}: use one of {', '.join(self.known)}")
        self._armed[name].append(_Armed(times, skip, when))

    def clear(self) -> None:
        """Disarm every fault."""
        for armed in self._armed.values():
            armed.clear()

    def strikes(self, name: str, occasion: Any = None) -> bool:
        """Return whether the fault strikes now, and count it."""
        armed = self._armed[name]
        for fault in armed:
            if fault.when is not None and not fault.when(occasion):
                continue
            if fault.skip:
                fault.skip -= 1
                continue
            fault.times -= 1
            if fault.times <= 0:
                armed.remove(fault)
            return True
        return False

"""Faults of simulated devices: armed by name, each strikes a stated number of times."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from emmc_rig.drivers.clock import Clock

Condition = Callable[[Any], bool]


@dataclass
class _Armed:
    """A fault that waits for its occasion."""

    times: float
    skip: int
    from_s: float
    when: Condition | None


class Faults:
    """The known faults of a device, and the armed faults.

    `clock` is needed for faults that wait for a time.
    """

    def __init__(self, known: Iterable[str], clock: Clock | None = None) -> None:
        self.known = tuple(known)
        self._clock = clock
        self._armed: dict[str, list[_Armed]] = {name: [] for name in self.known}

    def inject(
        self,
        name: str,
        times: float = 1,
        skip: int = 0,
        after_s: float = 0.0,
        when: Condition | None = None,
    ) -> None:
        """Arm a fault for the next `times` occasions (`math.inf`: from then on, always).

        It lets pass what happens within the next `after_s` seconds, then whatever `when` does not
        hold for (it is given what the device states of the occasion), then `skip` occasions.
        Raises `ValueError` for an unknown name, or a time without a clock.
        """
        if name not in self._armed:
            raise ValueError(f"no fault {name!r}: use one of {', '.join(self.known)}")
        from_s = 0.0
        if after_s:
            if self._clock is None:
                raise ValueError(f"fault {name!r} cannot wait: this device was given no clock")
            from_s = self._clock.now_s() + after_s
        self._armed[name].append(_Armed(times, skip, from_s, when))

    def clear(self) -> None:
        """Disarm every fault."""
        for armed in self._armed.values():
            armed.clear()

    def strikes(self, name: str, occasion: Any = None) -> bool:
        """Return whether the fault strikes now, and count it."""
        armed = self._armed[name]
        for fault in armed:
            if fault.from_s and self._clock is not None and self._clock.now_s() < fault.from_s:
                continue
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

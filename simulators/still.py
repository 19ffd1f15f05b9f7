"""A stage without physics, at the target as soon as a move ends.

For measurements and tests around devices: a move takes no time, or exactly the stated time.
"""

from collections.abc import Iterable, Mapping

from emmc_rig.drivers.camera import Limits
from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import LimitExceededError, NotHomedError
from emmc_rig.drivers.stage import Stage

TRAVEL_UM = (0.0, 100_000.0)


class StillStage(Stage):
    """A stage whose moves take `move_s` on its clock, however far they go."""

    axes: tuple[str, ...] = ()

    def __init__(
        self,
        axes: Iterable[str],
        clock: Clock,
        move_s: float = 0.0,
        travel_um: Limits = TRAVEL_UM,
    ) -> None:
        self.axes = tuple(axes)
        self._travel_um = travel_um
        self.moves = 0
        self.stops = 0
        self._at_um: dict[str, float] = {}
        self._clock, self._move_s = clock, move_s

    def home(self, axes: Iterable[str] | None = None) -> None:
        """Stand at zero."""
        self._at_um |= dict.fromkeys(self.axes if axes is None else axes, 0.0)

    def is_homed(self, axis: str) -> bool:
        """Whether the axis was homed."""
        return axis in self._at_um

    def move_to_um(self, targets_um: Mapping[str, float]) -> dict[str, float]:
        """Be there; raises `LimitExceededError` or `NotHomedError`."""
        for axis, target_um in targets_um.items():
            if axis not in self._at_um:
                raise NotHomedError(axis)
            if not self._travel_um[0] <= target_um <= self._travel_um[1]:
                raise LimitExceededError(axis, target_um, self._travel_um)
        if self._move_s:
            self._clock.sleep(self._move_s)
        self._at_um |= targets_um
        self.moves += 1
        return dict(targets_um)

    def position_um(self, axis: str) -> float:
        """Where the axis is; raises `NotHomedError`."""
        if axis not in self._at_um:
            raise NotHomedError(axis)
        return self._at_um[axis]

    def limits_um(self, axis: str) -> tuple[float, float]:
        """The travel."""
        return self._travel_um

    def speed_um_s(self, axis: str) -> float:
        """A speed to reckon with."""
        return 1000.0

    def top_speed_um_s(self, axis: str) -> float:
        """The same: it has one speed."""
        return self.speed_um_s(axis)

    def set_speed_um_s(self, axis: str, speed_um_s: float) -> None:
        """Take no notice."""

    def stop(self, axes: Iterable[str] | None = None) -> None:
        """Count it."""
        self.stops += 1

    def wait_until_settled(self, axes: Iterable[str] | None = None) -> None:
        """Stand already."""

    def reconnect(self, wait_s: float = 10.0) -> None:
        """Forget where the axes are."""
        self._at_um.clear()

    def close(self) -> None:
        """Keep nothing open."""

"""Several stages combined: a command to an axis goes to the stage with that axis."""

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from typing import Any

from emmc_rig.drivers.errors import UnknownAxisError
from emmc_rig.drivers.stage import Direction, Stage, StageIdentity, check_within_limits


class CombinedStage(Stage):
    """A stage of several, or of none; their axes have different names.

    Stages move one after the other. Whatever one raises stops them all.
    """

    def __init__(self, stages: Iterable[Stage]) -> None:
        """Take the stages; raises `ValueError` for an axis that two of them have."""
        self._stages = tuple(stages)
        self._of: dict[str, Stage] = {}
        for stage in self._stages:
            for axis in stage.axes:
                if axis in self._of:
                    raise ValueError(f"two stages have an axis {axis}: give one another name")
                self._of[axis] = stage

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes, stage by stage."""
        return tuple(self._of)

    def home(self, axes: Iterable[str] | None = None) -> None:
        """Find the reference of the given axes (all by default), and wait until they stand."""
        for stage, own in self._by_stage(self.axes if axes is None else axes):
            stage.home(own)

    def identity(self, axis: str) -> StageIdentity:
        """Return who made the controller of an axis, where its stage says."""
        return getattr(self._stage(axis), "identity", lambda axis: StageIdentity())(axis)

    def temperatures_c(self) -> dict[str, float]:
        """Return the temperatures that the stages tell."""
        return {
            f"stage {number} {name}": celsius
            for number, stage in enumerate(self._stages, 1)
            for name, celsius in getattr(stage, "temperatures_c", dict)().items()
        }

    def pressed_switches(self) -> dict[str, Direction | None]:
        """Return the axes on a limit switch, of the stages that report it; see `GrblStage`."""
        return {
            axis: away
            for stage in self._stages
            for axis, away in getattr(stage, "pressed_switches", dict)().items()
        }

    def move_off_switch(self, axis: str, away: Direction, step_um: float) -> bool:
        """As `GrblStage.move_off_switch`, of the stage that reports the switch as pressed."""
        for stage in self._stages:
            if axis in getattr(stage, "pressed_switches", dict)():
                reporting: Any = stage
                return reporting.move_off_switch(axis, away, step_um)
        return True

    def is_homed(self, axis: str) -> bool:
        """Return whether the axis knows where it is."""
        return self._stage(axis).is_homed(axis)

    def move_to_um(self, targets_um: Mapping[str, float]) -> dict[str, float]:
        """Move the axes, wait until they stand, and return where they read to be.

        Raises what the stages raise; a target beyond a limit before any of them moves.
        """
        for axis, target_um in targets_um.items():
            check_within_limits(axis, target_um, self.limits_um(axis))
        reached_um: dict[str, float] = {}
        try:
            for stage, own in self._by_stage(targets_um):
                reached_um |= stage.move_to_um({axis: targets_um[axis] for axis in own})
        except BaseException:
            self.stop()
            raise
        return reached_um

    def position_um(self, axis: str) -> float:
        """Return where the axis reads to be; raises `NotHomedError` while it does not know."""
        return self._stage(axis).position_um(axis)

    def limits_um(self, axis: str) -> tuple[float, float]:
        """Return the lowest and highest target that `move_to_um` accepts."""
        return self._stage(axis).limits_um(axis)

    def speed_um_s(self, axis: str) -> float:
        """Return the speed of a move."""
        return self._stage(axis).speed_um_s(axis)

    def top_speed_um_s(self, axis: str) -> float:
        """Return the fastest speed that `set_speed_um_s` accepts."""
        return self._stage(axis).top_speed_um_s(axis)

    def set_speed_um_s(self, axis: str, speed_um_s: float) -> None:
        """Choose the speed of the moves that follow."""
        self._stage(axis).set_speed_um_s(axis, speed_um_s)

    def stop(self, axes: Iterable[str] | None = None) -> None:
        """Stop the given axes (all by default) at once; each is tried, whatever another raises."""
        with ExitStack() as stopping:
            for stage, own in self._by_stage(self.axes if axes is None else axes):
                stopping.callback(stage.stop, own)

    def wait_until_settled(self, axes: Iterable[str] | None = None) -> None:
        """Return when the given axes (all by default) stand and their vibration has died down."""
        for stage, own in self._by_stage(self.axes if axes is None else axes):
            stage.wait_until_settled(own)

    def reconnect(self, wait_s: float = 10.0) -> None:
        """Open the ports again after an unplug; every axis must be homed before its next move."""
        for stage in self._stages:
            stage.reconnect(wait_s)

    def close(self) -> None:
        """Close the ports; nothing is moved or stopped."""
        with ExitStack() as closing:
            for stage in self._stages:
                closing.callback(stage.close)

    def _stage(self, axis: str) -> Stage:
        if axis not in self._of:
            raise UnknownAxisError(axis, self.axes)
        return self._of[axis]

    def _by_stage(self, axes: Iterable[str]) -> list[tuple[Stage, list[str]]]:
        found: dict[int, tuple[Stage, list[str]]] = {}
        for axis in axes:
            stage = self._stage(axis)
            found.setdefault(id(stage), (stage, []))[1].append(axis)
        return list(found.values())

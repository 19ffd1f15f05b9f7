"""A positioning stage in micrometres: what every stage offers, and the care all of them take.

A protocol (Zaber, Grbl, APT) fills in the primitives of `HostStage`; the order of checks, the
approach from one side, the time limits and the read-back are written once, here.
"""

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from drivers.clock import Clock
from drivers.errors import (
    DriverError,
    GarbledReplyError,
    LimitExceededError,
    MoveTimeoutError,
    NotHomedError,
    PositionMismatchError,
    TransportTimeoutError,
    UnknownAxisError,
)

_log = logging.getLogger(__name__)

MOVE_TIME_FACTOR = 1.5
MOVE_TIME_EXTRA_S = 2.0
"""Acceleration and polling; short moves are all acceleration."""
HOMING_TIME_FACTOR = 4.0
"""Homing crosses the travel slower than a move does, and backs off from its switch."""


class Stage(Protocol):
    """Named axes that are homed, moved and read in micrometres."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        ...

    def home(self, axes: Iterable[str] | None = None) -> None:
        """Find the reference of the given axes (all by default), and wait until they stand."""
        ...

    def is_homed(self, axis: str) -> bool:
        """Return whether the axis knows where it is."""
        ...

    def move_to_um(self, targets_um: Mapping[str, float]) -> dict[str, float]:
        """Move the axes together, wait until they stand, and return where they read to be."""
        ...

    def move_by_um(self, steps_um: Mapping[str, float]) -> dict[str, float]:
        """As `move_to_um`, relative to where the axes read to be."""
        ...

    def position_um(self, axis: str) -> float:
        """Return where the axis reads to be."""
        ...

    def limits_um(self, axis: str) -> tuple[float, float]:
        """Return the lowest and highest target that `move_to_um` accepts."""
        ...

    def stop(self, axes: Iterable[str] | None = None) -> None:
        """Stop the given axes (all by default) at once."""
        ...

    def wait_until_settled(self, axes: Iterable[str] | None = None) -> None:
        """Return when the given axes (all by default) stand and their vibration has died down."""
        ...


@dataclass(frozen=True)
class StageSettings:
    """How carefully a stage moves.

    `approach_um`: every move ends with at least this travel upwards, so that backlash is always
    taken up on the same side; 0 switches it off. It narrows the lower limit.
    `tolerance_um`: largest difference between command and read-back.
    `settle_s`: pause between standing still and being used.
    `soft_limits_um`: limits by axis, narrower than the device's own.
    """

    approach_um: float = 10.0
    tolerance_um: float = 1.0
    settle_s: float = 0.05
    poll_s: float = 0.02
    soft_limits_um: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise `ValueError` for settings no stage can work with."""
        if self.approach_um < 0 or self.settle_s < 0:
            raise ValueError("approach_um and settle_s must not be negative")
        if self.tolerance_um <= 0 or self.poll_s <= 0:
            raise ValueError("tolerance_um and poll_s must be positive")


DEFAULT_SETTINGS = StageSettings()


def move_time_limit_s(distance_um: float, speed_um_s: float) -> float:
    """Return how long a move may take before something must be wrong."""
    return MOVE_TIME_FACTOR * abs(distance_um) / speed_um_s + MOVE_TIME_EXTRA_S


def needs_approach(start_um: float, target_um: float, approach_um: float) -> bool:
    """Return whether a direct move would end with less than `approach_um` of upward travel."""
    return target_um - start_um < approach_um


def check_within_limits(axis: str, target_um: float, limits_um: tuple[float, float]) -> None:
    """Raise `LimitExceededError` for a target outside the limits, or not a number."""
    low_um, high_um = limits_um
    if not (math.isfinite(target_um) and low_um <= target_um <= high_um):
        raise LimitExceededError(axis, target_um, limits_um)


def check_arrived(axis: str, commanded_um: float, read_um: float, tolerance_um: float) -> None:
    """Raise `PositionMismatchError` when the axis is not where it was sent."""
    if abs(read_um - commanded_um) > tolerance_um:
        raise PositionMismatchError(axis, commanded_um, read_um, tolerance_um)


class HostStage(ABC):
    """The host's side of a stage, over the primitives of one protocol.

    No move is ever sent twice: when the answer to one is lost, the position decides whether it
    was carried out. Any exception during a move, Ctrl-C included, stops the axes that move.
    """

    def __init__(self, axes: Iterable[str], clock: Clock, settings: StageSettings) -> None:
        self._axes = tuple(axes)
        self._clock = clock
        self._settings = settings
        for axis in settings.soft_limits_um:
            self._require_axis(axis)

    @abstractmethod
    def is_homed(self, axis: str) -> bool:
        """Return whether the axis knows where it is."""

    @abstractmethod
    def position_um(self, axis: str) -> float:
        """Return where the axis reads to be."""

    @abstractmethod
    def _start_home(self, axis: str) -> None:
        """Send the homing command and return at once."""

    @abstractmethod
    def _start_move(self, axis: str, target_um: float) -> None:
        """Send an absolute move and return at once."""

    @abstractmethod
    def _stop_axis(self, axis: str) -> None:
        """Stop the axis."""

    @abstractmethod
    def _is_moving(self, axis: str) -> bool:
        """Return whether the axis moves; raises when it reports a fault."""

    @abstractmethod
    def _travel_um(self, axis: str) -> tuple[float, float]:
        """Return the device's own limits."""

    @abstractmethod
    def _speed_um_s(self, axis: str) -> float:
        """Return the speed of a move."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return self._axes

    def limits_um(self, axis: str) -> tuple[float, float]:
        """Return the lowest and highest target that `move_to_um` accepts.

        The approach from below needs room too: the lower limit stands that much above the end of
        the travel.
        """
        self._require_axis(axis)
        low_um, high_um = self._travel_um(axis)
        soft_low_um, soft_high_um = self._settings.soft_limits_um.get(axis, (low_um, high_um))
        return max(low_um, soft_low_um) + self._settings.approach_um, min(high_um, soft_high_um)

    def home(self, axes: Iterable[str] | None = None) -> None:
        """Find the reference of the given axes (all by default), and wait until they stand.

        Raises `NotHomedError` when an axis still has no reference, and what a move raises.
        """
        chosen = self._choose(axes)
        with self._stopped_on_error(chosen):
            for axis in chosen:
                self._start(axis, partial(self._start_home, axis))
            self._wait_until_idle(
                {axis: HOMING_TIME_FACTOR * self._full_travel_time_s(axis) for axis in chosen}
            )
        for axis in chosen:
            if not self.is_homed(axis):
                raise NotHomedError(axis)

    def move_to_um(self, targets_um: Mapping[str, float]) -> dict[str, float]:
        """Move the axes together, wait until they settle, and return where they read to be.

        Raises `UnknownAxisError`, `LimitExceededError` or `NotHomedError` before anything moves;
        afterwards `PositionMismatchError`, `StalledError`, `AxisFaultError`, `MoveTimeoutError`
        or an error of the transport, with the axes stopped.
        """
        for axis, target_um in targets_um.items():
            check_within_limits(axis, target_um, self.limits_um(axis))
        start_um = self._positions_when_homed_um(targets_um)
        waypoints_um = {
            axis: target_um - self._settings.approach_um
            for axis, target_um in targets_um.items()
            if needs_approach(start_um[axis], target_um, self._settings.approach_um)
        }
        with self._stopped_on_error(targets_um):
            reached_um = start_um | self._travel(start_um, waypoints_um)
            arrived_um = self._travel(reached_um, targets_um)
            self._clock.sleep(self._settings.settle_s)
        return arrived_um

    def move_by_um(self, steps_um: Mapping[str, float]) -> dict[str, float]:
        """As `move_to_um`, relative to where the axes read to be; they must be homed too."""
        start_um = self._positions_when_homed_um(steps_um)
        return self.move_to_um({axis: start_um[axis] + step for axis, step in steps_um.items()})

    def stop(self, axes: Iterable[str] | None = None) -> None:
        """Stop the given axes (all by default) at once.

        Every axis is tried before the first error is raised.
        """
        errors: list[DriverError] = []
        for axis in self._choose(axes):
            try:
                self._stop_axis(axis)
            except DriverError as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def wait_until_settled(self, axes: Iterable[str] | None = None) -> None:
        """Return when the given axes (all by default) stand and their vibration has died down.

        Raises `MoveTimeoutError` when an axis moves longer than its whole travel takes.
        """
        self._wait_until_idle({axis: self._full_travel_time_s(axis) for axis in self._choose(axes)})
        self._clock.sleep(self._settings.settle_s)

    def _require_axis(self, axis: str) -> None:
        if axis not in self._axes:
            raise UnknownAxisError(axis, self._axes)

    def _choose(self, axes: Iterable[str] | None) -> tuple[str, ...]:
        chosen = self._axes if axes is None else tuple(axes)
        for axis in chosen:
            self._require_axis(axis)
        return chosen

    def _positions_when_homed_um(self, axes: Iterable[str]) -> dict[str, float]:
        chosen = self._choose(axes)
        for axis in chosen:
            if not self.is_homed(axis):
                raise NotHomedError(axis)
        return {axis: self.position_um(axis) for axis in chosen}

    def _full_travel_time_s(self, axis: str) -> float:
        low_um, high_um = self._travel_um(axis)
        return move_time_limit_s(high_um - low_um, self._speed_um_s(axis))

    def _start(self, axis: str, send: Callable[[], None]) -> None:
        """Send a command that must not be repeated; the position tells later if it arrived."""
        try:
            send()
        except (TransportTimeoutError, GarbledReplyError) as error:
            _log.warning(
                "%s: no answer to a motion command, its position will tell: %s", axis, error
            )

    def _travel(
        self, start_um: Mapping[str, float], targets_um: Mapping[str, float]
    ) -> dict[str, float]:
        for axis, target_um in targets_um.items():
            self._start(axis, partial(self._start_move, axis, target_um))
        self._wait_until_idle(
            {
                axis: move_time_limit_s(target_um - start_um[axis], self._speed_um_s(axis))
                for axis, target_um in targets_um.items()
            }
        )
        reached_um = {axis: self.position_um(axis) for axis in targets_um}
        for axis, target_um in targets_um.items():
            check_arrived(axis, target_um, reached_um[axis], self._settings.tolerance_um)
        return reached_um

    def _wait_until_idle(self, time_limits_s: Mapping[str, float]) -> None:
        started_s = self._clock.now_s()
        for axis, time_limit_s in time_limits_s.items():
            while self._is_moving(axis):
                if self._clock.now_s() - started_s > time_limit_s:
                    raise MoveTimeoutError(axis, time_limit_s)
                self._clock.sleep(self._settings.poll_s)

    @contextmanager
    def _stopped_on_error(self, axes: Iterable[str]) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            for axis in axes:
                try:
                    self._stop_axis(axis)
                except DriverError as stop_error:
                    error.add_note(f"{axis} could not be stopped: {stop_error}")
            raise

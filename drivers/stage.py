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
from enum import StrEnum
from functools import partial
from itertools import chain
from typing import NamedTuple, Protocol, Self, TypeVar

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import (
    AxisFaultError,
    DriverError,
    GarbledReplyError,
    LimitExceededError,
    LostPositionError,
    MoveTimeoutError,
    NotHomedError,
    PortError,
    PositionMismatchError,
    SpeedLimitError,
    TransportTimeoutError,
    UnknownAxisError,
)

_log = logging.getLogger(__name__)

Answer = TypeVar("Answer")

MOVE_TIME_FACTOR = 1.5
MOVE_TIME_EXTRA_S = 2.0
"""Acceleration and polling; short moves are all acceleration."""
HOMING_TIME_FACTOR = 4.0
"""Homing crosses the travel slower than a move does, and backs off from its switch."""
START_GRACE_S = 0.5
"""An axis that stands still away from its target may not have begun yet, for this long."""
STOP_TIME_S = 5.0
READINGS_TRIED = 3
RECONNECT_POLL_S = 0.1


class Stage(Protocol):
    """Named axes that are homed, moved and read in micrometres."""

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        ...

    def home(self, axes: Iterable[str] | None = None) -> None:
        """Find the reference of the given axes (all by default), and wait until they stand."""

    def is_homed(self, axis: str) -> bool:
        """Return whether the axis knows where it is."""
        ...

    def move_to_um(self, targets_um: Mapping[str, float]) -> dict[str, float]:
        """Move the axes together, wait until they stand, and return where they read to be."""
        ...

    def move_by_um(self, steps_um: Mapping[str, float]) -> dict[str, float]:
        """As `move_to_um`, relative to where the axes read to be; they must be homed too."""
        return self.move_to_um({a: self.position_um(a) + step for a, step in steps_um.items()})

    def position_um(self, axis: str) -> float:
        """Return where the axis reads to be; raises `NotHomedError` while it does not know."""
        ...

    def limits_um(self, axis: str) -> tuple[float, float]:
        """Return the lowest and highest target that `move_to_um` accepts."""
        ...

    def speed_um_s(self, axis: str) -> float:
        """Return the speed of a move."""
        ...

    def top_speed_um_s(self, axis: str) -> float:
        """Return the fastest speed that `set_speed_um_s` accepts."""
        ...

    def set_speed_um_s(self, axis: str, speed_um_s: float) -> None:
        """Choose the speed of the moves that follow, also after a reconnect."""

    def stop(self, axes: Iterable[str] | None = None) -> None:
        """Stop the given axes (all by default) at once, and return when they stand."""

    def wait_until_settled(self, axes: Iterable[str] | None = None) -> None:
        """Return when the given axes (all by default) stand and their vibration has died down."""

    def reconnect(self, wait_s: float = 10.0) -> None:
        """Open the ports again after an unplug; every axis must be homed before its next move."""

    def close(self) -> None:
        """Close the ports; nothing is moved or stopped."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


@dataclass(frozen=True)
class StageIdentity:
    """Who made the controller of an axis; "" where it does not say."""

    maker: str = ""
    model: str = ""
    serial: str = ""
    firmware: str = ""


@dataclass(frozen=True)
class StageSettings:
    """How carefully a stage moves.

    `approach_um`: every move ends with at least this travel upwards, so that backlash is always
    taken up on the same side; 0 switches it off. It narrows the lower limit.
    `tolerance_um`: largest difference between command and read-back.
    `settle_s`: pause between standing still and being used.
    `soft_limits_um`: limits by axis, narrower than the device's own.
    `speeds_um_s`: speed by axis, instead of the device's own; restored after every reconnect.
    `top_speeds_um_s`: highest speed by axis, from the data sheet, below what the device allows.
    """

    approach_um: float = 10.0
    tolerance_um: float = 1.0
    settle_s: float = 0.05
    poll_s: float = 0.02
    soft_limits_um: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    speeds_um_s: Mapping[str, float] = field(default_factory=dict)
    top_speeds_um_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise `ValueError` for settings no stage can work with."""
        if self.approach_um < 0 or self.settle_s < 0:
            raise ValueError("approach_um and settle_s must not be negative")
        if self.tolerance_um <= 0 or self.poll_s <= 0:
            raise ValueError("tolerance_um and poll_s must be positive")


DEFAULT_SETTINGS = StageSettings()


class Direction(StrEnum):
    """A direction along an axis: up leads to larger positions."""

    UP = "up"
    DOWN = "down"

    @property
    def sign(self) -> int:
        """1 up, -1 down."""
        return 1 if self is Direction.UP else -1

    @property
    def opposite(self) -> "Direction":
        """The other direction."""
        return Direction.DOWN if self is Direction.UP else Direction.UP


class Reading(NamedTuple):
    """An axis's report: its position, whether homing gave the reference, and whether it moves."""

    position_um: float
    homed: bool
    moving: bool


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


def check_tolerance(axis: str, tolerance_um: float, resolution_um: float) -> None:
    """Raise `ValueError` for a tolerance that rounding alone exceeds."""
    if tolerance_um < resolution_um / 2:
        raise ValueError(
            f"tolerance_um {tolerance_um:g} is finer than half a step of {axis} "
            f"({resolution_um:g} um): loosen it"
        )


class Link(Protocol):
    """What leads to a device: a port, or a library that holds it."""

    def reopen(self) -> None:
        """Open it again, wherever it is now; raises a `PortError`."""

    def close(self) -> None:
        """Close it; closing twice is allowed."""


class HostStage(Stage, ABC):
    """The host's side of a stage, over the primitives of one protocol.

    No move is ever sent twice: when the answer to one is lost, the position decides whether it
    was carried out. Any exception during a move, Ctrl-C included, stops the axes that move.
    A protocol's constructor ends with `_start_up`; `_configure` and `_apply_speed` fill in the
    speeds of moves, and of homing where it differs.
    """

    def __init__(
        self,
        axes: Iterable[str],
        transports: Iterable[Link],
        clock: Clock,
        settings: StageSettings,
    ) -> None:
        self._axes = tuple(axes)
        self._transports = tuple(dict.fromkeys(transports))
        self._clock = clock
        self._settings = settings
        self._speeds_um_s = dict(settings.speeds_um_s)
        self._unknown_because: dict[str, str] = {}
        self._move_speeds_um_s: dict[str, float] = {}
        self._home_speeds_um_s: dict[str, float] = {}
        chosen = (settings.soft_limits_um, settings.speeds_um_s, settings.top_speeds_um_s)
        for axis in chain.from_iterable(chosen):
            self._require_axis(axis)

    @abstractmethod
    def _configure(self) -> None:
        """Bring a device on a freshly opened port into a known state; moves nothing."""

    @abstractmethod
    def _read(self, axis: str) -> Reading:
        """Ask the device where the axis is, and whether it is homed."""

    @abstractmethod
    def _start_home(self, axes: tuple[str, ...]) -> None:
        """Send the homing command and return at once."""

    @abstractmethod
    def _start_moves(self, targets_um: Mapping[str, float], start_um: Mapping[str, float]) -> None:
        """Send absolute moves, each once, and return at once."""

    @abstractmethod
    def _stop_axis(self, axis: str) -> None:
        """Send the stop command."""

    @abstractmethod
    def _is_moving(self, axis: str) -> bool:
        """Return whether the axis moves; raises `AxisFaultError` when it reports a fault."""

    @abstractmethod
    def _travel_um(self, axis: str) -> tuple[float, float]:
        """Return the device's own limits."""

    @abstractmethod
    def _apply_speed(self, axis: str, speed_um_s: float) -> None:
        """Make the axis move at this speed from now on."""

    @abstractmethod
    def _top_speed_um_s(self, axis: str) -> float:
        """Return the fastest speed that the device can give the axis."""

    def speed_um_s(self, axis: str) -> float:
        """Return the speed of a move."""
        self._require_axis(axis)
        return self._move_speeds_um_s[axis]

    def _is_homing(self, axis: str) -> bool:
        """Return whether the homing that was started still goes on; raises as `_is_moving`."""
        return self._is_moving(axis)

    def _homing_speed_um_s(self, axis: str) -> float:
        """Return the speed at which the axis looks for its reference."""
        return self._home_speeds_um_s.get(axis) or self.speed_um_s(axis)

    def _homed_together(self, axes: tuple[str, ...]) -> tuple[str, ...]:
        """Return the axes that are homed when these are to be."""
        return axes

    def _readings_are_checked(self, axis: str) -> bool:
        """Return whether a checksum protects what `_read` reads."""
        return False

    def _why_short(self, axis: str) -> DriverError | None:
        """Return why the axis stands away from its target, where the device reports it."""
        return None

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return self._axes

    def close(self) -> None:
        """Close the ports; nothing is moved or stopped."""
        for transport in self._transports:
            transport.close()

    def reconnect(self, wait_s: float = 10.0) -> None:
        """Open the ports again after an unplug, wherever they are now; nothing moves.

        Waits up to `wait_s` for each port, stops what still moves, restores the settings, and
        marks every position as unknown: an axis must be homed before its next move. Raises a
        `PortError` when a port stays away, and what talking to the device raises.
        """
        self._mark_unknown(self._axes, "the connection was lost")
        for transport in self._transports:
            self._reopen(transport, self._clock.now_s() + wait_s)
        for axis in self._axes:
            self._stop_axis(axis)
        self._start_up()

    def identity(self, axis: str) -> StageIdentity:
        """Return who made the controller of an axis, as far as it says; it is asked now."""
        self._require_axis(axis)
        return self._identity(axis)

    def _identity(self, axis: str) -> StageIdentity:
        return StageIdentity()

    def temperatures_c(self) -> dict[str, float]:
        """Return the controllers' temperatures, by the name of the sensor's place."""
        return {}

    def is_homed(self, axis: str) -> bool:
        """Return whether the axis knows where it is."""
        self._require_axis(axis)
        return axis not in self._unknown_because and self._marking_lost(axis, self._read).homed

    def position_um(self, axis: str) -> float:
        """Return where the axis reads to be; raises `NotHomedError` while it does not know.

        Where no checksum protects the reply, two readings in a row must agree; an axis that
        moves may be further by the second. Raises `GarbledReplyError` when they never do.
        """
        self._require_axis(axis)
        self._require_known_position(axis)
        before_s = self._clock.now_s()
        reading = self._marking_lost(axis, self._read)
        if not self._readings_are_checked(axis):
            reading = self._confirmed(axis, reading, before_s)
        self._require_known_position(axis)
        if not reading.homed:
            raise NotHomedError(axis)
        return reading.position_um

    def limits_um(self, axis: str) -> tuple[float, float]:
        """Return the lowest and highest target that `move_to_um` accepts.

        The approach from below needs room too: the lower limit stands that much above the end of
        the travel.
        """
        self._require_axis(axis)
        low_um, high_um = self._travel_um(axis)
        soft_low_um, soft_high_um = self._settings.soft_limits_um.get(axis, (low_um, high_um))
        return max(low_um, soft_low_um) + self._settings.approach_um, min(high_um, soft_high_um)

    def top_speed_um_s(self, axis: str) -> float:
        """Return the fastest speed that `set_speed_um_s` accepts: the device's, or the stated."""
        self._require_axis(axis)
        stated_um_s = self._settings.top_speeds_um_s.get(axis, math.inf)
        return min(self._top_speed_um_s(axis), stated_um_s)

    def set_speed_um_s(self, axis: str, speed_um_s: float) -> None:
        """Choose the speed of the moves that follow, also after a reconnect.

        Raises `SpeedLimitError` before anything is sent, or `CommandRefusedError`.
        """
        top_um_s = self.top_speed_um_s(axis)
        if not (math.isfinite(speed_um_s) and 0 < speed_um_s <= top_um_s):
            raise SpeedLimitError(axis, speed_um_s, top_um_s)
        self._apply_speed(axis, speed_um_s)
        self._speeds_um_s[axis] = speed_um_s

    def home(self, axes: Iterable[str] | None = None) -> None:
        """Find the reference of the given axes (all by default), and wait until they stand.

        Firmware that cannot home a single axis homes all; the log says so before they move.
        Raises `NotHomedError` when an axis still has no reference, and what a move raises.
        """
        chosen = self._homed_together(self._choose(axes))
        with self._stopped_on_error(chosen):
            self._mark_unknown(chosen, "its homing did not finish")
            self._start_home(chosen)
            started_s = self._clock.now_s()
            limits_s = {
                axis: HOMING_TIME_FACTOR * self._travel_time_s(axis, self._homing_speed_um_s(axis))
                for axis in chosen
            }
            self._wait_until_idle(limits_s, started_s, self._is_homing)
            for axis in chosen:
                if not self._read(axis).homed:
                    raise NotHomedError(axis, self._unknown_because[axis])
        for axis in chosen:
            self._unknown_because.pop(axis, None)

    def move_to_um(self, targets_um: Mapping[str, float]) -> dict[str, float]:
        """Move the axes together, wait until they settle, and return where they read to be.

        Raises `UnknownAxisError`, `LimitExceededError` or `NotHomedError` before anything moves;
        afterwards `PositionMismatchError`, `AxisFaultError` (a stall, a limit switch, an
        emergency stop, a lost position), `MoveTimeoutError` or an error of the transport, with
        the axes stopped.
        """
        for axis, target_um in targets_um.items():
            check_within_limits(axis, target_um, self.limits_um(axis))
        start_um = {axis: self.position_um(axis) for axis in self._choose(targets_um)}
        approach_um = self._settings.approach_um
        waypoints_um = {
            axis: target_um - approach_um
            for axis, target_um in targets_um.items()
            if approach_um and needs_approach(start_um[axis], target_um, approach_um)
        }
        with self._stopped_on_error(targets_um):
            reached_um = start_um | self._travel(start_um, waypoints_um)
            arrived_um = self._travel(reached_um, targets_um)
            self._clock.sleep(self._settings.settle_s)
        return arrived_um

    def stop(self, axes: Iterable[str] | None = None) -> None:
        """Stop the given axes (all by default) at once, and return when they stand.

        Every axis is tried before the first error is raised. An axis that reports a fault counts
        as standing: the next move reports it.
        """
        chosen = self._choose(axes)
        errors: list[DriverError] = []
        for axis in chosen:
            try:
                self._stop_axis(axis)
            except DriverError as error:
                errors.append(error)
        if errors:
            raise errors[0]
        limits_s = dict.fromkeys(chosen, STOP_TIME_S)
        self._wait_until_idle(limits_s, self._clock.now_s(), self._is_moving_without_fault)

    def wait_until_settled(self, axes: Iterable[str] | None = None) -> None:
        """Return when the given axes (all by default) stand and their vibration has died down.

        Raises `MoveTimeoutError` when an axis moves longer than its whole travel takes.
        """
        limits_s = {
            axis: self._travel_time_s(axis, self.speed_um_s(axis)) for axis in self._choose(axes)
        }
        self._wait_until_idle(limits_s, self._clock.now_s(), self._is_moving)
        self._clock.sleep(self._settings.settle_s)

    def _start_up(self) -> None:
        self._configure()
        for axis in self._settings.top_speeds_um_s:
            if self.speed_um_s(axis) > self.top_speed_um_s(axis):
                self._apply_speed(axis, self.top_speed_um_s(axis))
        for axis, speed_um_s in self._speeds_um_s.items():
            self.set_speed_um_s(axis, speed_um_s)

    def _reopen(self, transport: Link, deadline_s: float) -> None:
        while True:
            try:
                transport.reopen()
                return
            except PortError:
                if self._clock.now_s() >= deadline_s:
                    raise
                self._clock.sleep(RECONNECT_POLL_S)

    def _require_axis(self, axis: str) -> None:
        if axis not in self._axes:
            raise UnknownAxisError(axis, self._axes)

    def _require_known_position(self, axis: str) -> None:
        if axis in self._unknown_because:
            raise NotHomedError(axis, self._unknown_because[axis])

    def _mark_unknown(self, axes: Iterable[str], why: str) -> None:
        self._unknown_because.update(dict.fromkeys(axes, why))

    def _choose(self, axes: Iterable[str] | None) -> tuple[str, ...]:
        chosen = self._axes if axes is None else tuple(axes)
        for axis in chosen:
            self._require_axis(axis)
        return chosen

    def _confirmed(self, axis: str, reading: Reading, before_s: float) -> Reading:
        for _ in range(READINGS_TRIED):
            again = self._marking_lost(axis, self._read)
            possible_um = self._settings.tolerance_um
            if reading.moving or again.moving:
                possible_um += self.speed_um_s(axis) * (self._clock.now_s() - before_s)
            if (
                again.homed == reading.homed
                and abs(again.position_um - reading.position_um) <= possible_um
            ):
                return again
            _log.warning("%s: read %s, then %s", axis, reading, again)
            reading, before_s = again, self._clock.now_s()
        raise GarbledReplyError(b"", f"{axis} never reads the same twice").about(
            axis=axis, command="position"
        )

    def _travel_time_s(self, axis: str, speed_um_s: float) -> float:
        low_um, high_um = self._travel_um(axis)
        return move_time_limit_s(high_um - low_um, speed_um_s)

    def _is_moving_without_fault(self, axis: str) -> bool:
        try:
            return self._is_moving(axis)
        except AxisFaultError as fault:
            _log.warning("%s: %s", axis, fault)
            return False

    def _send_once(self, axes: Iterable[str], send: Callable[[], object]) -> None:
        """Send a command that must not be repeated; the position shows later if it arrived."""
        try:
            send()
        except (TransportTimeoutError, GarbledReplyError) as error:
            _log.warning(
                "%s: no answer to a motion command, the position will show it: %s",
                ", ".join(axes),
                error,
            )

    def _travel(
        self, start_um: Mapping[str, float], targets_um: Mapping[str, float]
    ) -> dict[str, float]:
        """Move, wait, and return the positions read; all within the tolerance."""
        if not targets_um:
            return {}
        self._send_once(targets_um, partial(self._start_moves, targets_um, start_um))
        started_s = self._clock.now_s()
        slowest_s = max(
            move_time_limit_s(target_um - start_um[axis], self.speed_um_s(axis))
            for axis, target_um in targets_um.items()
        )
        limits_s = dict.fromkeys(targets_um, slowest_s)
        while True:
            moved_s = self._wait_until_idle(limits_s, started_s, self._is_moving)
            reached_um = self._positions_after_move_um(targets_um)
            short = [
                axis
                for axis, target_um in targets_um.items()
                if abs(reached_um[axis] - target_um) > self._settings.tolerance_um
            ]
            if not short:
                return reached_um
            if self._clock.now_s() - moved_s > START_GRACE_S:
                axis = short[0]
                raise self._why_short(axis) or PositionMismatchError(
                    axis, targets_um[axis], reached_um[axis], self._settings.tolerance_um
                )
            self._clock.sleep(self._settings.poll_s)

    def _positions_after_move_um(self, axes: Iterable[str]) -> dict[str, float]:
        positions_um = {}
        for axis in axes:
            try:
                positions_um[axis] = self.position_um(axis)
            except NotHomedError as error:
                raise LostPositionError(axis, f"position lost during a move, {error}") from error
        return positions_um

    def _wait_until_idle(
        self,
        limits_s: Mapping[str, float],
        started_s: float,
        is_moving: Callable[[str], bool],
    ) -> float:
        """Return when the axes stand; the value is when one was last seen to move.

        `limits_s` count from `started_s`. Raises `MoveTimeoutError`.
        """
        moved_s = started_s
        for axis, limit_s in limits_s.items():
            while self._marking_lost(axis, is_moving):
                moved_s = self._clock.now_s()
                if moved_s - started_s > limit_s:
                    raise MoveTimeoutError(axis, limit_s)
                self._clock.sleep(self._settings.poll_s)
        return moved_s

    def _marking_lost(self, axis: str, ask: Callable[[str], Answer]) -> Answer:
        """Return what `ask` returns; an error that loses the position marks it as unknown."""
        try:
            return ask(axis)
        except DriverError as error:
            self._mark_lost(error)
            raise

    def _mark_lost(self, error: DriverError) -> None:
        if error.loses_position:
            lost = (error.axis,) if error.axis in self._axes else self._axes
            self._mark_unknown(lost, error.what)

    @contextmanager
    def _stopped_on_error(self, axes: Iterable[str]) -> Iterator[None]:
        """Stop every axis when anything goes wrong, Ctrl-C included, and note what is now unknown.

        Nothing, a second Ctrl-C neither, keeps an axis from being stopped.
        """
        try:
            yield
        except BaseException as error:
            if isinstance(error, DriverError):
                self._mark_lost(error)
            for axis in axes:
                try:
                    self._stop_axis(axis)
                except BaseException as stop_error:
                    error.add_note(f"{axis} could not be stopped: {stop_error}")
            raise

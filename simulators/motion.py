"""A motor on a lead screw: true position, motion, and counted position."""

import math
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import cached_property

from emmc_rig.drivers.clock import Clock


@dataclass(frozen=True)
class AxisSpec:
    """A lead-screw axis from 0 to `travel_um`, which stands at `start_um` at power-up.

    `backlash_um` is the play of the nut: moving up it sits on the screw's own position, moving
    down it lags that much above.
    """

    travel_um: float = 25_400.0
    microstep_um: float = 0.047625
    max_speed_um_s: float = 7_000.0
    acceleration_um_s2: float = 200_000.0
    start_um: float = 3_210.0
    backlash_um: float = 3.0


@dataclass(frozen=True)
class Motion:
    """A move from rest to rest with constant acceleration up to a top speed."""

    start_um: float
    end_um: float
    start_s: float
    speed_um_s: float
    acceleration_um_s2: float

    @cached_property
    def peak_um_s(self) -> float:
        """Fastest speed reached; a short move never reaches its top speed."""
        distance_um = abs(self.end_um - self.start_um)
        return min(self.speed_um_s, math.sqrt(distance_um * self.acceleration_um_s2))

    @property
    def duration_s(self) -> float:
        """Time from rest to rest."""
        distance_um = abs(self.end_um - self.start_um)
        if distance_um == 0:
            return 0.0
        return distance_um / self.peak_um_s + self.peak_um_s / self.acceleration_um_s2

    def position_um(self, now_s: float) -> float:
        """Return where the motor is."""
        elapsed_s, left_s, ramp_s = self._times_s(now_s)
        distance_um = abs(self.end_um - self.start_um)
        if elapsed_s < ramp_s:
            covered_um = self.acceleration_um_s2 * elapsed_s**2 / 2
        elif left_s < ramp_s:
            covered_um = distance_um - self.acceleration_um_s2 * left_s**2 / 2
        else:
            covered_um = self.peak_um_s * (elapsed_s - ramp_s / 2)
        return self.start_um + math.copysign(covered_um, self.end_um - self.start_um)

    def velocity_um_s(self, now_s: float) -> float:
        """Return how fast the motor goes, negative downwards."""
        elapsed_s, left_s, _ = self._times_s(now_s)
        ramped_um_s = self.acceleration_um_s2 * min(elapsed_s, left_s)
        return math.copysign(min(ramped_um_s, self.peak_um_s), self.end_um - self.start_um)

    def _times_s(self, now_s: float) -> tuple[float, float, float]:
        """Return the time since the start, until the end, and of one ramp."""
        elapsed_s = min(max(now_s - self.start_s, 0.0), self.duration_s)
        return elapsed_s, self.duration_s - elapsed_s, self.peak_um_s / self.acceleration_um_s2


class End(Enum):
    """How a motion ended."""

    ARRIVED = auto()
    BRAKED = auto()
    STALLED = auto()
    AT_END_OF_TRAVEL = auto()


class Motor:
    """A motor with its true position, the position of its nut, and the counted position.

    true_um, nut_um: of the motor, and of the nut with its load, at the last `advance`.
    busy_forever: the motor reports motion although it stands. drift_um: a shift that is not
    counted, at the end of the next move.
    """

    def __init__(self, spec: AxisSpec, clock: Clock) -> None:
        self.spec = spec
        self.busy_forever = False
        self.drift_um = 0.0
        self._clock = clock
        self.true_um = spec.start_um
        self.nut_um = spec.start_um
        self._counted_from_um = spec.start_um
        self._course: Motion | None = None
        self._end = End.ARRIVED

    @property
    def moving(self) -> bool:
        """Whether the motor reports motion."""
        begun = self._course is not None and self._course.start_s <= self._clock.now_s()
        return begun or self.busy_forever

    @property
    def counted_um(self) -> float:
        """Where the motor believes to be, as of the last `advance`."""
        return self.true_um - self._counted_from_um

    @property
    def ends_s(self) -> float | None:
        """When the motion under way will end."""
        return None if self._course is None else self._course.start_s + self._course.duration_s

    def velocity_um_s(self) -> float:
        """Return how fast it goes now."""
        return 0.0 if self._course is None else self._course.velocity_um_s(self._clock.now_s())

    def go(
        self,
        counted_target_um: float,
        speed_um_s: float,
        acceleration_um_s2: float,
        stalls: bool = False,
        start_s: float | None = None,
    ) -> None:
        """Begin a move to a counted position; the end of the travel stops it short."""
        wanted_um = self._counted_from_um + counted_target_um
        end_um = min(max(wanted_um, 0.0), self.spec.travel_um)
        self._end = End.ARRIVED if abs(end_um - wanted_um) < 1e-6 else End.AT_END_OF_TRAVEL
        if stalls:
            end_um = (self.true_um + end_um) / 2
            self._end = End.STALLED
        start_s = self._clock.now_s() if start_s is None else start_s
        self._course = Motion(self.true_um, end_um, start_s, speed_um_s, acceleration_um_s2)

    def seek(
        self,
        true_um: float,
        speed_um_s: float,
        acceleration_um_s2: float,
        start_s: float | None = None,
    ) -> None:
        """Begin a move to a true position, as homing to a switch does."""
        counted_um = true_um - self._counted_from_um
        self.go(counted_um, speed_um_s, acceleration_um_s2, start_s=start_s)
        self._end = End.ARRIVED

    def brake(self, acceleration_um_s2: float) -> None:
        """Come to rest as the second half of a move does whose top speed is the speed now."""
        if self._course is None:
            return
        now_s = self._clock.now_s()
        velocity_um_s = self._course.velocity_um_s(now_s)
        ramp_s = abs(velocity_um_s) / acceleration_um_s2
        half_um = velocity_um_s * ramp_s / 2
        start_um, end_um = self.true_um - half_um, self.true_um + half_um
        speed_um_s = abs(velocity_um_s)
        self._course = Motion(start_um, end_um, now_s - ramp_s, speed_um_s, acceleration_um_s2)
        self._end = End.BRAKED

    def halt(self) -> None:
        """Stand at once."""
        self._course = None

    def count_from_here(self, counted_um: float = 0.0) -> None:
        """Believe from now on to be at this position."""
        self._counted_from_um = self.true_um - counted_um

    def drift(self, distance_um: float) -> None:
        """Move without counting it."""
        self.true_um += distance_um
        self.nut_um += distance_um
        self._counted_from_um += distance_um

    def restarted(self) -> "Motor":
        """Return the motor as it comes up after power was lost where it is now."""
        self.advance()
        return Motor(replace(self.spec, start_um=self.true_um), self._clock)

    def advance(self) -> End | None:
        """Advance to the time of the clock; return how its motion ended, if it did just now."""
        if self._course is None:
            return None
        now_s = self._clock.now_s()
        self.true_um = self._course.position_um(now_s)
        highest_um = self.true_um + self.spec.backlash_um
        self.nut_um = min(max(self.nut_um, self.true_um), highest_um)
        if now_s < self._course.start_s + self._course.duration_s:
            return None
        self._course = None
        self.drift(self.drift_um)
        self.drift_um = 0.0
        return self._end

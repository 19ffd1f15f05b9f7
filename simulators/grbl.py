"""Firmware of a Grbl 1.1 controller: G-code lines and real-time bytes in, `ok` and reports out.

Simplified: every move of the queue starts and ends at rest; homing takes all its axes to their
switches together, pulls off, touches the switch again slowly and pulls off; the receive buffer is
never full. Both ends of an axis's travel have a switch, on one input, and stop the axis: homing
from the switch at the far end fails, and drives no deeper. What is not modelled (arcs, probing,
work offsets, spindle, check mode, ...) is refused as an unsupported command, and logged. The axes
have no encoders: a stall loses steps unnoticed.
Source of the messages: Grbl v1.1 documentation, "Interface", "Commands", "Jogging", "Realtime
commands"; the order of a report's fields and its counters from report.c.
"""

import logging
import math
import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Self

from emmc_rig.drivers import grbl_codec as codec
from emmc_rig.drivers.clock import Clock
from emmc_rig.simulators.firmware import SimulatedController, earliest_s
from emmc_rig.simulators.motion import AxisSpec, End, Motor

LETTERS = codec.AXIS_LETTERS
SMALL_AXIS = AxisSpec(microstep_um=0.3125, max_speed_um_s=8_000.0, backlash_um=3.0)
BENCH_AXES = {"X": SMALL_AXIS, "Y": SMALL_AXIS, "Z": SMALL_AXIS}
AS_SHIPPED, WITH_SINGLE_AXIS_HOMING = "V", "VH"
"""Options that `$I` states: of Grbl's default config.h, and with option H compiled in."""
VERSION = "1.1h"
BUILD = "20190825"
PLANNER_BLOCKS = 15
RX_BUFFER = 128
OFFSET_EVERY = {True: 30, False: 10}
OVERRIDES_EVERY = {True: 20, False: 10}
"""Reports between two with WCO and Ov, while moving and while not (config.h)."""
PULL_OFF_MM = 1.0
LOCATE_MM_MIN = 25.0
SILENT_WORDS = {"G": (4, 17, 40, 49, 54, 61, 80, 94), "M": (0, 2, 5, 9, 30)}
"""Words that are accepted and change nothing here."""
_log = logging.getLogger(__name__)
_WORD = re.compile(r"([A-Z])(-?\d+\.?\d*|-?\.\d+)")
_SETTING_LINE = re.compile(r"\$(\d{1,3})=(-?\d+\.?\d*)")


class _RefusedError(Exception):
    """A line the firmware answers with this error number."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class _Block:
    """One straight move of the queue: where each axis goes, in steps of the counter's mm."""

    targets_mm: Mapping[str, float]
    feed_mm_min: float
    jog: bool


@dataclass
class _Modes:
    """What the G-code parser remembers from line to line."""

    motion: str = "G0"
    absolute: bool = True
    inches: bool = False
    feed_mm_min: float = 0.0


class GrblController(SimulatedController):
    """One controller, its axes by letter; machine position 0 is at the upper end of the travel.

    options: `AS_SHIPPED` or other letters of `$I`. work_offset_mm: where G54 begins, which a user
    may set.
    Faults as `SimulatedController`'s, and `door`: the safety door opens at the next line.
    """

    def __init__(
        self,
        clock: Clock,
        axes: Mapping[str, AxisSpec] = BENCH_AXES,
        options: str = AS_SHIPPED,
        settings: Mapping[int, float] | None = None,
    ) -> None:
        super().__init__(clock, ("door",))
        self.axes = dict(axes)
        self.options = options
        self.settings = _default_settings(axes) | dict(settings or {})
        self.work_offset_mm = dict.fromkeys(axes, 0.0)
        self._motors = {letter: Motor(spec, clock) for letter, spec in axes.items()}
        self._boot()

    def position_um(self, letter: str) -> float:
        """Return where the axis really is: um from the lower end of its travel."""
        with self._lock:
            self._advance()
            return self._motors[letter].nut_um

    def power_cycle(self) -> None:
        """Switch off and on: the axes stay in place and lose their reference."""
        with self._lock:
            self._motors = {letter: motor.restarted() for letter, motor in self._motors.items()}
            self._boot()

    def _boot(self) -> None:
        self._state = "Alarm" if self.settings[codec.HOMING] else "Idle"
        self._waits_for_reset = False
        self._restart()

    def _restart(self) -> None:
        """What a start and a soft reset have in common; the position survives a reset."""
        for motor in self._motors.values():
            motor.halt()
        self._line = bytearray()
        self._lines: deque[str] = deque()
        self._blocks: deque[_Block] = deque()
        self._block: _Block | None = None
        self._ends: dict[str, End] = {}
        self._homing: deque[dict[str, tuple[float, float]]] = deque()
        self._homing_letters: tuple[str, ...] = ()
        self._releasing: set[str] = set()
        """Axes that a move takes off their limit switch; its change is an alarm, as a press is."""
        self._held = False
        self._modes = _Modes()
        self._reports_to_offset = 0
        self._reports_to_overrides = 1
        self._status_asked = False
        self._say(f"\r\nGrbl {VERSION} ['$' for help]")
        if self._state == "Alarm":
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _receive(self, data: bytes) -> None:
        for value in data:
            byte = bytes([value])
            if act := self._realtime.get(byte):
                act(self)
            elif value >= 0x80 or byte == b"~":
                continue  # overrides, and the end of a hold
            elif byte in b"\r\n":
                self._end_line()
                self._execute_lines()
            else:
                self._line.append(value)
        self._execute_lines()

    def _ask_status(self) -> None:
        self._status_asked = True
        self._command = codec.STATUS_QUERY
        self._report_if_asked()

    def _end_line(self) -> None:
        line, self._line = bytes(self._line), bytearray()
        if self._waits_for_reset or (line and self._dropped(line)):
            return
        text = re.sub(r"\(.*?\)|;.*", "", line.decode("ascii", "replace"))
        if len(line) >= codec.LINE_LENGTH:
            text = "overflow"
        self._lines.append("".join(text.split()).upper())

    def _advance(self) -> None:
        """Advance motors, queue and homing to the time of the clock, move by move."""
        while True:
            ended_s = self._next_event_s()
            for letter, motor in self._motors.items():
                end = motor.advance()
                if end is not None:
                    self._ends[letter] = end
            if self._block is None and not self._homing_letters:
                break
            hit = End.AT_END_OF_TRAVEL in self._ends.values()
            hit |= not self._releasing.isdisjoint(self._ends)
            if hit and self.settings[codec.HARD_LIMITS] and not self._homing_letters:
                self._alarm(1)
                break
            if self._next_event_s() is not None:
                break
            if self._homing_letters:
                self._next_homing_step(ended_s)
            else:
                self._end_block(ended_s)
        self._execute_lines()
        self._report_if_asked()

    def _next_event_s(self) -> float | None:
        return earliest_s(motor.ends_s for motor in self._motors.values())

    def _end_block(self, ended_s: float | None) -> None:
        block, self._block = self._block, None
        assert block is not None
        if self._held:
            self._blocks.appendleft(block)
            self._state = "Hold"
            return
        for letter, target_mm in block.targets_mm.items():
            if self._ends.get(letter) in (End.STALLED, End.AT_END_OF_TRAVEL):
                self._motors[letter].count_from_here(target_mm * 1e3)
        if self.faults.strikes("drift", self._command):
            for letter in block.targets_mm:
                self._motors[letter].drift(self.drift_um)
        if self._blocks:
            self._start_block(ended_s)
        elif not any(motor.busy_forever for motor in self._motors.values()):
            self._state = "Idle"

    def _start_block(self, start_s: float | None) -> None:
        """Move every axis in a straight line, none beyond its own speed and acceleration."""
        self._block = block = self._blocks.popleft()
        self._ends = {}
        start_mm = self._machine_mm()
        steps_mm = {
            letter: target_mm - start_mm[letter] for letter, target_mm in block.targets_mm.items()
        }
        length_mm = math.hypot(*steps_mm.values())
        if length_mm == 0:
            self._state = "Idle"
            self._block = None
            return
        parts = {letter: abs(step_mm) / length_mm for letter, step_mm in steps_mm.items()}
        speed_mm_min = block.feed_mm_min
        acceleration_mm_s2 = math.inf
        for letter, part in parts.items():
            if part:
                top_mm_min = self._setting(codec.MAX_RATE, letter)
                speed_mm_min = min(speed_mm_min, top_mm_min / part)
                most_mm_s2 = self._setting(codec.ACCELERATION, letter)
                acceleration_mm_s2 = min(acceleration_mm_s2, most_mm_s2 / part)
        stalls = self.faults.strikes("stall", self._command)
        forever = self.faults.strikes("busy_forever", self._command)
        self._releasing = {letter for letter in self._pressed() if parts.get(letter)}
        for letter, part in parts.items():
            if part:
                target_mm = block.targets_mm[letter]
                if letter in self._releasing and self.settings[codec.HARD_LIMITS]:
                    step_mm = self.axes[letter].microstep_um / 1e3
                    target_mm = start_mm[letter] + math.copysign(step_mm, steps_mm[letter])
                self._motors[letter].go(
                    target_mm * 1e3,
                    speed_mm_min * part / 60 * 1e3,
                    acceleration_mm_s2 * part * 1e3,
                    stalls,
                    start_s,
                )
                self._motors[letter].busy_forever |= forever
        self._state = "Jog" if block.jog else "Run"

    def _brake(self) -> None:
        for letter, motor in self._motors.items():
            motor.brake(self._setting(codec.ACCELERATION, letter) * 1e3)

    def _cancel_jog(self) -> None:
        if self._state == "Jog":
            self._blocks.clear()
            self._brake()

    def _feed_hold(self) -> None:
        self._cancel_jog()
        if self._state == "Run":
            self._held = True
            self._brake()
        elif self._state == "Idle":
            self._held = True
            self._state = "Hold"

    def _soft_reset(self) -> None:
        self._advance()
        homing = bool(self._homing_letters)
        moving = any(motor.ends_s is not None for motor in self._motors.values())
        if homing or moving:
            self._state = "Alarm"
            self._say("ALARM:6" if homing else "ALARM:3")
        elif self._state in ("Hold", "Door"):
            self._state = "Idle"
        self._waits_for_reset = False
        self._restart()

    def _alarm(self, code: int) -> None:
        """A limit switch, or a target beyond the soft limits, stops all until a reset."""
        for motor in self._motors.values():
            motor.halt()
        self._blocks.clear()
        self._lines.clear()
        self._block = None
        self._releasing = set()
        self._state = "Alarm"
        self._waits_for_reset = True
        self._say(f"ALARM:{code}")
        self._say("[MSG:Reset to continue]")

    def _execute_lines(self) -> None:
        while (
            self._lines
            and not self._waits_for_reset
            and not self._homing_letters
            and len(self._blocks) < PLANNER_BLOCKS
        ):
            line = self._lines.popleft()
            if self.faults.strikes("door", line):
                self._state = "Door"
            try:
                self._execute(line)
            except _RefusedError as refusal:
                self._say(f"error:{refusal.code}")

    def _execute(self, line: str) -> None:
        if line == "OVERFLOW":
            raise _RefusedError(11)
        if not line:
            self._say("ok")
            return
        if line.startswith("$"):
            self._execute_system(line)
        elif self._state in ("Alarm", "Jog", "Door"):
            raise _RefusedError(9)
        else:
            self._execute_gcode(line)
            if self._waits_for_reset:
                return
        if not self._homing_letters:
            self._say("ok")

    def _execute_system(self, line: str) -> None:
        if line.startswith("$J"):
            self._execute_jog(line)
            return
        in_motion = line in ("$G", "$X") or (line == "$$" and self._state not in ("Run", "Hold"))
        if not in_motion and self._state not in ("Idle", "Alarm"):
            raise _RefusedError(8)
        if handle := self._commands.get(line):
            handle(self)
        elif line.startswith("$H"):
            self._execute_home(line[2:])
        else:
            self._execute_setting(line)

    def _list_modes(self) -> None:
        modes = self._modes
        units, distance = ("G20", "G21")[not modes.inches], ("G91", "G90")[modes.absolute]
        self._say(
            f"[GC:{modes.motion} G54 G17 {units} {distance} G94 M5 M9 T0 F{modes.feed_mm_min:g} S0]"
        )

    def _unlock(self) -> None:
        if self._state == "Alarm":
            self._say("[MSG:Caution: Unlocked]")
            self._state = "Idle"

    def _list_settings(self) -> None:
        for number, value in sorted(self.settings.items()):
            self._say(f"${number}={value:.3f}" if number >= 100 else f"${number}={value:g}")

    def _list_build(self) -> None:
        self._say(f"[VER:{VERSION}.{BUILD}:]")
        self._say(f"[OPT:{self.options},{PLANNER_BLOCKS},{RX_BUFFER}]")

    def _list_offsets(self) -> None:
        zero_mm = dict.fromkeys(self.axes, 0.0)
        for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30", "G92"):
            offset_mm = self.work_offset_mm if name == "G54" else zero_mm
            self._say(f"[{name}:{self._coordinates(offset_mm, 1.0)}]")
        self._say("[TLO:0.000]")
        self._say(f"[PRB:{self._coordinates(zero_mm, 1.0)}:0]")

    def _execute_setting(self, line: str) -> None:
        match = _SETTING_LINE.fullmatch(line)
        if match is None or int(match[1]) not in self.settings:
            raise _RefusedError(3)
        number, value = int(match[1]), float(match[2])
        if value < 0:
            raise _RefusedError(4)
        if number == codec.SOFT_LIMITS and value and not self.settings[codec.HOMING]:
            raise _RefusedError(10)
        self.settings[number] = value

    def _execute_home(self, letter: str) -> None:
        if not self.settings[codec.HOMING]:
            raise _RefusedError(5)
        if letter and ("H" not in self.options or letter not in self.axes):
            raise _RefusedError(3)
        letters = (letter,) if letter else tuple(self.axes)
        seek = self.settings[codec.HOMING_SEEK] / 60 * 1e3
        locate = self.settings[codec.HOMING_FEED] / 60 * 1e3
        pull_off_um = self.settings[codec.HOMING_PULL_OFF] * 1e3
        directions = int(self.settings[codec.HOMING_DIRECTIONS])
        at_and_off_um: dict[str, tuple[float, float]] = {}
        for axis in letters:
            travel_um = self.axes[axis].travel_um
            at_and_off_um[axis] = travel_um, travel_um - pull_off_um
            if directions >> LETTERS.index(axis) & 1:
                at_and_off_um[axis] = 0.0, pull_off_um
        self._homing = deque(
            {axis: (at_and_off_um[axis][off], speed) for axis in letters}
            for speed in (seek, locate)
            for off in (0, 1)
        )
        self._homing_letters = letters
        self._state = "Home"
        far_ends_um = {
            axis: 0.0 if at_um else self.axes[axis].travel_um
            for axis, (at_um, _) in at_and_off_um.items()
        }
        if self.faults.strikes("stall", self._command):
            self._fail_homing(9)
        elif any(self._motors[axis].true_um == um for axis, um in far_ends_um.items()):
            self._fail_homing(8)
        else:
            self._next_homing_step(None)

    def _next_homing_step(self, start_s: float | None) -> None:
        if not self._homing:
            for letter in self._homing_letters:
                motor = self._motors[letter]
                motor.count_from_here(motor.true_um - self.axes[letter].travel_um)
            self._homing_letters = ()
            self._state = "Idle"
            self._say("ok")
            return
        for letter, (place_um, speed_um_s) in self._homing.popleft().items():
            acceleration_um_s2 = self._setting(codec.ACCELERATION, letter) * 1e3
            self._motors[letter].seek(place_um, speed_um_s, acceleration_um_s2, start_s)

    def _fail_homing(self, code: int) -> None:
        self._homing_letters = ()
        self._state = "Alarm"
        self._say(f"ALARM:{code}")
        self._restart()

    def _execute_jog(self, line: str) -> None:
        if self._state not in ("Idle", "Jog"):
            raise _RefusedError(8)
        if not line.startswith("$J="):
            raise _RefusedError(16)
        words = _words(line[3:])
        inches, absolute = self._modes.inches, self._modes.absolute
        machine = False
        for letter, value in words:
            word = f"{letter}{value:g}"
            if letter == "G":
                if word not in ("G20", "G21", "G53", "G90", "G91"):
                    raise _RefusedError(16)
                inches = {"G20": True, "G21": False}.get(word, inches)
                absolute = {"G90": True, "G91": False}.get(word, absolute)
                machine = machine or word == "G53"
            elif letter not in self.axes and letter not in "FN":
                raise _RefusedError(16)
        feeds = [value for letter, value in words if letter == "F"]
        if not feeds or feeds[0] <= 0:
            raise _RefusedError(22)
        unit = codec.MM_PER_INCH if inches else 1.0
        targets_mm = self._targets_mm(words, unit, absolute, machine)
        if not targets_mm:
            raise _RefusedError(26)
        if self._beyond_travel(targets_mm):
            raise _RefusedError(15)
        self._queue(_Block(targets_mm, feeds[0] * unit, jog=True))

    def _execute_gcode(self, line: str) -> None:
        words = _words(line)
        modes, machine, motion = self._modes, False, None
        for letter, value in words:
            word = f"{letter}{value:g}"
            if word in ("G0", "G1"):
                motion = modes.motion = word
            elif word in ("G20", "G21"):
                modes.inches = word == "G20"
            elif word in ("G90", "G91"):
                modes.absolute = word == "G90"
            elif word == "G53":
                machine = True
            elif letter in SILENT_WORDS:
                if value not in SILENT_WORDS[letter]:
                    raise _not_modelled(line)
            elif letter not in "FSTNP" and letter not in self.axes:
                raise _not_modelled(line)
        unit = codec.MM_PER_INCH if modes.inches else 1.0
        for letter, value in words:
            if letter == "F":
                modes.feed_mm_min = value * unit
        targets_mm = self._targets_mm(words, unit, modes.absolute, machine)
        if not targets_mm:
            return
        rapid = (motion or modes.motion) == "G0"
        if not rapid and modes.feed_mm_min <= 0:
            raise _RefusedError(22)
        if self._beyond_travel(targets_mm):
            self._alarm(2)
            return
        fastest = max(self._setting(codec.MAX_RATE, letter) for letter in self.axes) * 10
        self._queue(_Block(targets_mm, fastest if rapid else modes.feed_mm_min, jog=False))

    def _targets_mm(
        self, words: list[tuple[str, float]], unit: float, absolute: bool, machine: bool
    ) -> dict[str, float]:
        """Return the machine coordinates that a line asks for."""
        planned_mm = self._planned_mm()
        targets_mm = {}
        for letter, value in words:
            if letter in self.axes:
                if not absolute:
                    targets_mm[letter] = planned_mm[letter] + value * unit
                else:
                    offset_mm = 0.0 if machine else self.work_offset_mm[letter]
                    targets_mm[letter] = value * unit + offset_mm
        return targets_mm

    def _beyond_travel(self, targets_mm: Mapping[str, float]) -> bool:
        if not self.settings[codec.SOFT_LIMITS]:
            return False
        return any(
            not -self._setting(codec.TRAVEL, letter) <= target_mm <= 0
            for letter, target_mm in targets_mm.items()
        )

    def _queue(self, block: _Block) -> None:
        self._blocks.append(block)
        if self._block is None:
            self._start_block(self._start_s())

    def _planned_mm(self) -> dict[str, float]:
        """Return where the axes will be when all that is queued is done."""
        planned_mm = self._machine_mm()
        for block in (self._block, *self._blocks):
            if block is not None:
                planned_mm.update(block.targets_mm)
        return planned_mm

    def _machine_mm(self) -> dict[str, float]:
        """Return the machine position in whole steps, as the firmware counts them."""
        position_mm = {}
        for letter, motor in self._motors.items():
            steps = round(motor.counted_um / self.axes[letter].microstep_um)
            position_mm[letter] = steps * self.axes[letter].microstep_um / 1e3
        return position_mm

    def _pressed(self) -> list[str]:
        """Return the letters of the axes that stand at an end of their travel."""
        return [
            letter
            for letter, motor in self._motors.items()
            if not 0 < motor.true_um < self.axes[letter].travel_um
        ]

    def _setting(self, first: int, letter: str) -> float:
        return self.settings[first + LETTERS.index(letter)]

    def _report_if_asked(self) -> None:
        """Report, unless it homes or waits for a reset; asking twice is answered once."""
        if not self._status_asked or self._homing_letters or self._waits_for_reset:
            return
        self._status_asked = False
        if self._dropped(codec.STATUS_QUERY):
            return
        unit = codec.MM_PER_INCH if self.settings[codec.REPORT_INCHES] else 1.0
        state = self._state
        if state == "Hold":
            state = "Hold:0"
        elif self._held and self._block is not None:
            state = "Hold:1"
        elif state == "Door":
            state = "Door:1"
        machine_mm = self._machine_mm()
        if int(self.settings[codec.REPORT_MASK]) & codec.REPORTS_MACHINE_POSITION:
            fields = [state, f"MPos:{self._coordinates(machine_mm, unit)}"]
        else:
            work_mm = {axis: mm - self.work_offset_mm[axis] for axis, mm in machine_mm.items()}
            fields = [state, f"WPos:{self._coordinates(work_mm, unit)}"]
        velocities = [motor.velocity_um_s() for motor in self._motors.values()]
        decimals = 0 if unit == 1 else 1
        fields.append(f"FS:{math.hypot(*velocities) * 60 / 1e3 / unit:.{decimals}f},0")
        if pressed := self._pressed():
            fields.append(f"Pn:{''.join(pressed)}")
        moving = self._state not in ("Idle", "Alarm")
        if self._reports_to_offset:
            self._reports_to_offset -= 1
        else:
            self._reports_to_offset = OFFSET_EVERY[moving] - 1
            fields.append(f"WCO:{self._coordinates(self.work_offset_mm, unit)}")
        if self._reports_to_overrides:
            self._reports_to_overrides -= 1
        else:
            self._reports_to_overrides = OVERRIDES_EVERY[moving] - 1
            fields.append("Ov:100,100,100")
        self._say(f"<{'|'.join(fields)}>")

    def _coordinates(self, position_mm: Mapping[str, float], unit: float) -> str:
        places = 4 if unit != 1.0 else 3
        return ",".join(f"{position_mm[letter] / unit:.{places}f}" for letter in self.axes)

    def _say(self, text: str) -> None:
        self._send(text.encode("ascii") + b"\r\n")

    _realtime: Mapping[bytes, Callable[[Self], None]] = {
        codec.SOFT_RESET: _soft_reset,
        codec.STATUS_QUERY: _ask_status,
        codec.FEED_HOLD: _feed_hold,
        codec.JOG_CANCEL: _cancel_jog,
    }
    """What is carried out at once, whatever line it comes in."""
    _commands: Mapping[str, Callable[[Self], None]] = {
        "$G": _list_modes,
        "$X": _unlock,
        "$$": _list_settings,
        "$I": _list_build,
        "$#": _list_offsets,
    }


def _not_modelled(line: str) -> _RefusedError:
    """Return the refusal of what a real controller may know, having logged it."""
    _log.warning("not modelled, refused: %s", line)
    return _RefusedError(20)


def _default_settings(axes: Mapping[str, AxisSpec]) -> dict[int, float]:
    settings: dict[int, float] = {
        0: 10,
        1: 25,
        2: 0,
        3: 0,
        4: 0,
        5: 0,
        6: 0,
        codec.REPORT_MASK: codec.REPORTS_MACHINE_POSITION,
        11: 0.01,
        12: 0.002,
        codec.REPORT_INCHES: 0,
        codec.SOFT_LIMITS: 1,
        codec.HARD_LIMITS: 1,
        codec.HOMING: 1,
        codec.HOMING_DIRECTIONS: 0,
        codec.HOMING_FEED: LOCATE_MM_MIN,
        codec.HOMING_SEEK: 300,
        codec.HOMING_DEBOUNCE: 250,
        codec.HOMING_PULL_OFF: PULL_OFF_MM,
        30: 1000,
        31: 0,
        32: 0,
    }
    for letter, spec in axes.items():
        index = LETTERS.index(letter)
        settings[codec.STEPS_PER_MM + index] = 1e3 / spec.microstep_um
        settings[codec.MAX_RATE + index] = spec.max_speed_um_s * 60 / 1e3
        settings[codec.ACCELERATION + index] = spec.acceleration_um_s2 / 1e3
        settings[codec.TRAVEL + index] = spec.travel_um / 1e3
    return settings


def _words(line: str) -> list[tuple[str, float]]:
    """Return letters and values of a line of G-code."""
    words = []
    place = 0
    while place < len(line):
        match = _WORD.match(line, place)
        if match is None:
            raise _RefusedError(2 if line[place].isalpha() else 1)
        words.append((match[1], float(match[2])))
        place = match.end()
    return words

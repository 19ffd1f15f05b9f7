"""Grbl 1.1 stages: named axes of one controller, moved by jogs in machine coordinates."""

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial

from emmc_rig.drivers import grbl_codec as codec
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import (
    ALL_AXES,
    AxisFaultError,
    CommandRefusedError,
    DriverError,
    FirmwareError,
    GarbledReplyError,
    LimitSwitchError,
    LostPositionError,
    MoveTimeoutError,
    PositionMismatchError,
    PressedSwitchError,
    ScaleError,
    StalledError,
    TransportTimeoutError,
)
from emmc_rig.drivers.stage import (
    DEFAULT_SETTINGS,
    Direction,
    HostStage,
    Reading,
    StageIdentity,
    StageSettings,
    check_tolerance,
    move_time_limit_s,
)
from emmc_rig.drivers.transport import Transport, repeated, turns

_log = logging.getLogger(__name__)

LINES_TOLERATED = 200
"""Lines read for one answer; `$$` has about forty."""
BOOT_S = 4.0
"""Opening the port resets an Arduino, which answers after its boot loader."""
REPORTS_UNTIL_OFFSET = 40
"""Grbl reports the work offset in every 30th report at the latest ("Interface", WCO)."""
POLL_S = 0.05
RESETS = 2
OFF_SWITCH_SPEED_UM_S = 1000.0
"""Of a step off a limit switch: half a millimetre takes half a second, in which a hand is at the
power switch."""
SWITCH_CHANGES = 4
"""Alarms in one step off a switch: of its release, and of a contact that bounces."""
REPORT_STEP_UM = 1.0
"""Reports have three decimals of a millimetre."""
FACTORY_STEPS_PER_MM = 250.0
"""What `$100` to `$105` hold before anybody has set them (Grbl's defaults.h, generic)."""
SCALES_AGREE = 1e-3
"""Relative; Grbl shows three decimals of steps per millimetre."""
SINGLE_AXIS_HOMING = "H"
"""Among the options of `$I`; a compile-time option, off by default (Grbl's config.h)."""
REFUSAL_ADVICE = {
    5: "switch homing on ($22=1) and wire its limit switches",
    8: "the controller is busy, wait until the axes stand",
    9: "home it",
    13: "close the safety door",
    15: "check the travel ($130 to $132) and the limits",
    22: "check the speed",
}
FAULTS_BY_ALARM: Mapping[int, type[AxisFaultError]] = {
    1: LimitSwitchError,
    3: LostPositionError,
    8: LimitSwitchError,
    9: StalledError,
}
ALARMS_UNTIL_RESET = {1, 2}
"""After these Grbl answers nothing but a reset ("Interface", Alarm message)."""
POSITION_KEPT = 2
ALARM_ADVICE = {
    9: "see that nothing is in the way, and that every axis that Grbl homes has a switch: as it is "
    "shipped Z, too (config.h, HOMING_CYCLE_0); then home the axes",
}


class GrblStage(HostStage):
    """Axes of one controller, `axes` mapping names to letters; positions are machine positions.

    The travel lies below zero, as Grbl has it, and ends short of the homing switches. Grbl does
    not report whether it was homed, and is idle as well after `$X`, so every axis must be homed
    after connecting. Firmware without option H in `$I`, as it is shipped, homes all axes together.
    From a pressed limit switch no homing is begun: Grbl takes every pressed switch for the home
    switch, and from the far end of the travel its pull-off leads deeper (limits.c, limits_go_home).
    The scale is the controller's `$100` and following; `steps_per_mm`, by name of an axis, states
    the expected scale, without which the firmware's default counts as never set. Construction
    waits up to BOOT_S for the controller to start; it moves nothing. Raises `ScaleError`, or
    `TransportTimeoutError` when the controller does not answer.
    Source: Grbl v1.1 documentation, "Interface", "Commands", "Jogging", "Configuration".
    """

    def __init__(
        self,
        transport: Transport,
        axes: Mapping[str, str],
        clock: Clock = SYSTEM_CLOCK,
        settings: StageSettings = DEFAULT_SETTINGS,
        steps_per_mm: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(axes, (transport,), clock, settings)
        for letter in axes.values():
            if letter not in codec.AXIS_LETTERS:
                known = ", ".join(codec.AXIS_LETTERS)
                raise ValueError(f"axis letter {letter!r}: use one of {known}")
        self._transport = transport
        self._letters = dict(axes)
        self._headings: dict[str, Direction] = {}
        """Where the axes were sent by the motion under way, by letter."""
        self._away: dict[str, Direction] = {}
        """By letter of an axis that ran into a limit switch: the direction that it came from."""
        self._stated_steps_per_mm = dict(steps_per_mm or {})
        for axis in self._stated_steps_per_mm:
            self._require_axis(axis)
        self._start_up()

    def steps_per_mm(self, axis: str) -> float:
        """Return what the controller takes for a millimetre, its `$100` and following."""
        self._require_axis(axis)
        return self._positive(codec.STEPS_PER_MM, axis)

    def _identity(self, axis: str) -> StageIdentity:
        """Return the identity, with the text that a user wrote by `$I=` as the serial number."""
        firmware, _, written = self._build.get("VER", "").partition(":")
        return StageIdentity("", "Grbl", written, firmware)

    def home(self, axes: Iterable[str] | None = None) -> None:
        """As `HostStage.home`; raises `PressedSwitchError` before an axis on a switch moves."""
        with self._naming_switches():
            super().home(axes)
        self._away.clear()

    def move_to_um(self, targets_um: Mapping[str, float]) -> dict[str, float]:
        """As `HostStage.move_to_um`; raises `PressedSwitchError` where a move ends on a switch."""
        with self._naming_switches():
            return super().move_to_um(targets_um)

    def pressed_switches(self) -> dict[str, Direction | None]:
        """Return the axes on a limit switch, each with the direction that leads off it.

        None where the direction is unknown: Grbl does not report at which end an axis stands, so
        that only a move of this object which ended on the switch shows it. A letter of
        the controller without a name on this stage stands for itself. A controller in alarm, which
        may report nothing, is reset; it stands.
        """
        self._controller.leave_alarm()
        pressed = self._controller.status().pressed
        return {self._name(letter): self._away.get(letter) for letter in pressed}

    def move_off_switch(self, axis: str, away: Direction, step_um: float) -> bool:
        """Move an axis off its limit switch by one slow step; return whether it is released.

        axis: as `pressed_switches` names it. The axis must be homed before its next move. A switch
        that is released raises the alarm of a hard limit too (limits.c); the step then goes on.
        Raises `PressedSwitchError` when the switch of another axis is pressed on the way,
        `PositionMismatchError` when the step falls short, and what a move raises.
        """
        letter = self._letters.get(axis, axis)
        before = self.pressed_switches()
        self._mark_unknown(self._axes, "it was moved off a limit switch")
        index = codec.AXIS_LETTERS.index(letter)
        target_mm = self._controller.machine_position_mm()[1][index] + away.sign * step_um / 1e3
        top_um_s = self._controller.setting(codec.MAX_RATE + index) / 60 * 1e3
        speed_um_s = min(OFF_SWITCH_SPEED_UM_S, top_um_s)
        line = codec.jog({letter: target_mm}, speed_um_s * 60 / 1e3)
        limits_s = {axis: move_time_limit_s(step_um, speed_um_s)}
        with self._soft_limits_off(), self._stopped_on_error((axis,)):
            for _ in range(SWITCH_CHANGES):
                self._controller.unlock()
                try:
                    self._controller.command(line, axis)
                    self._wait_until_idle(limits_s, self._clock.now_s(), self._is_moving)
                except (LimitSwitchError, MoveTimeoutError) as fault:
                    _log.debug("on the way off the switch, the position decides: %s", fault)
                pressed = self.pressed_switches()
                if newly := sorted(pressed.keys() - before.keys()):
                    raise PressedSwitchError(newly[0])
                at_um = self._controller.machine_position_mm()[1][index] * 1e3
                if abs(at_um - target_mm * 1e3) <= self._settings.tolerance_um:
                    return axis not in pressed
        raise PositionMismatchError(axis, target_mm * 1e3, at_um, self._settings.tolerance_um)

    @contextmanager
    def _soft_limits_off(self) -> Iterator[None]:
        """Switch off `$20`, by which Grbl refuses jogs outside the travel, also back into it."""
        stated = self._controller.settings[codec.SOFT_LIMITS].text
        if not self._controller.setting(codec.SOFT_LIMITS):
            yield
            return
        self._controller.command(f"${codec.SOFT_LIMITS}=0")
        try:
            yield
        finally:
            self._controller.leave_alarm()
            self._controller.command(f"${codec.SOFT_LIMITS}={stated}")

    @contextmanager
    def _naming_switches(self) -> Iterator[None]:
        """Raise `PressedSwitchError` for a `LimitSwitchError` after which a switch is pressed."""
        self._headings = {}
        try:
            yield
        except PressedSwitchError:
            raise
        except LimitSwitchError as fault:
            self._away = {letter: way.opposite for letter, way in self._headings.items()}
            try:
                pressed = self.pressed_switches()
            except DriverError as silent:
                _log.warning("the switches cannot be read: %s", silent)
                raise fault from None
            for axis, away in pressed.items():
                raise PressedSwitchError(axis, away or "", fault.reply) from None
            raise

    def stop(self, axes: Iterable[str] | None = None) -> None:
        """As `HostStage.stop`; all axes stop together, and a program that runs is held."""
        self._choose(axes)
        self._stop_axis(self._axes[0])
        if self._controller.status().state == "Run":
            self._transport.write(codec.FEED_HOLD)
        super().stop(axes)

    def _configure(self) -> None:
        mark_all_unknown = partial(self._mark_unknown, self._axes)
        self._controller = _Controller(self._transport, self._clock, mark_all_unknown)
        self._controller.wait_for_boot()
        self._build = self._controller.command("$I")
        self._options = self._build.get("OPT", "").split(",")[0]
        self._controller.command("$$")
        mark_all_unknown("no homing since the connection was opened")
        self._away.clear()
        self._move_speeds_um_s = {axis: self._top_speed_um_s(axis) for axis in self._axes}
        for axis in self._axes:
            self._check_scale(axis)
            step_um = 1e3 / self.steps_per_mm(axis)
            check_tolerance(axis, self._settings.tolerance_um, step_um + REPORT_STEP_UM)

    def _read(self, axis: str) -> Reading:
        status, position_mm = self._controller.machine_position_mm()
        index = self._index(axis)
        if index >= len(position_mm):
            raise _no_such_axis(axis, "?", f"{len(position_mm)} axes")
        moving = status.state not in ("Idle", "Alarm")
        return Reading(position_mm[index] * 1e3, status.state != "Alarm", moving)

    def _homed_together(self, axes: tuple[str, ...]) -> tuple[str, ...]:
        if SINGLE_AXIS_HOMING in self._options or set(axes) == set(self._axes):
            return axes
        _log.warning("this Grbl homes all axes together: %s", ", ".join(self._axes))
        return self._axes

    def _start_home(self, axes: tuple[str, ...]) -> None:
        some = set(axes) != set(self._axes)
        lines = [f"$H{self._letters[axis]}" for axis in axes] if some else ["$H"]
        pressed = self.pressed_switches()
        moved = set(axes) if some else pressed.keys()
        for axis in sorted(moved & pressed.keys()):
            raise PressedSwitchError(axis, pressed[axis] or "")
        for axis in axes:
            way = Direction.DOWN if self._homes_downwards(axis) else Direction.UP
            self._headings[self._letters[axis]] = way
        self._controller.start_homing(lines)

    def _is_homing(self, axis: str) -> bool:
        return self._controller.is_homing()

    def _start_moves(self, targets_um: Mapping[str, float], start_um: Mapping[str, float]) -> None:
        """Send one jog, so fast that no axis leaves its own speed and all arrive together."""
        distances_um = {axis: abs(um - start_um[axis]) for axis, um in targets_um.items()}
        slowest_s = max(um / self.speed_um_s(axis) for axis, um in distances_um.items())
        length_um = math.hypot(*distances_um.values())
        speed_um_s = length_um / slowest_s if slowest_s else self.speed_um_s(next(iter(targets_um)))
        targets_mm = {self._letters[axis]: um / 1e3 for axis, um in targets_um.items()}
        self._headings = {
            self._letters[axis]: Direction.UP if um > start_um[axis] else Direction.DOWN
            for axis, um in targets_um.items()
            if um != start_um[axis]
        }
        line = codec.jog(targets_mm, speed_um_s * 60 / 1e3)
        self._controller.command(line, ", ".join(targets_um))

    def _stop_axis(self, axis: str) -> None:
        """Cancel the jog, which keeps the position; homing can only be reset, which loses it."""
        if self._controller.homing_lines:
            self._controller.abandon_homing()
        else:
            self._transport.write(codec.JOG_CANCEL)

    def _is_moving(self, axis: str) -> bool:
        status = self._controller.status()
        if status.state in ("Run", "Jog", "Home") or (status.state, status.substate) == ("Hold", 1):
            return True
        if status.state != "Idle":
            self._controller.raise_alarm()
            raise AxisFaultError(axis, f"the controller is in the state {status.state}")
        return False

    def _travel_um(self, axis: str) -> tuple[float, float]:
        """Return the travel, short of the switch by as much as homing pulled off."""
        travel_um = self._positive(codec.TRAVEL, axis) * 1e3
        pull_off_um = self._controller.setting(codec.HOMING_PULL_OFF) * 1e3
        if not self._homes_downwards(axis):
            return -travel_um, -pull_off_um
        if "Z" in self._options:
            return pull_off_um, travel_um
        return -travel_um + pull_off_um, 0.0

    def _homes_downwards(self, axis: str) -> bool:
        directions = int(self._controller.setting(codec.HOMING_DIRECTIONS))
        return bool(directions >> self._index(axis) & 1)

    def _apply_speed(self, axis: str, speed_um_s: float) -> None:
        self._move_speeds_um_s[axis] = speed_um_s

    def _top_speed_um_s(self, axis: str) -> float:
        return self._positive(codec.MAX_RATE, axis) / 60 * 1e3

    def _homing_speed_um_s(self, axis: str) -> float:
        seek_um_s = self._controller.setting(codec.HOMING_SEEK) / 60 * 1e3
        top_um_s = self._top_speed_um_s(axis)
        return min(seek_um_s, top_um_s) if seek_um_s > 0 else top_um_s

    def _check_scale(self, axis: str) -> None:
        steps_per_mm, stated = self.steps_per_mm(axis), self._stated_steps_per_mm.get(axis)
        setting = f"${codec.STEPS_PER_MM + self._index(axis)}"
        if stated is None and steps_per_mm == FACTORY_STEPS_PER_MM:
            raise ScaleError(
                axis,
                f"{setting}={steps_per_mm:g} steps per mm is the firmware's default",
                f"set {setting} to what motor and screw make, or confirm it as steps_per_mm in "
                "the stage's YAML file",
            )
        if stated is not None and abs(stated / steps_per_mm - 1) > SCALES_AGREE:
            raise ScaleError(
                axis,
                f"{stated:g} steps per mm were stated, but the controller has "
                f"{setting}={steps_per_mm:g}",
                f"send it `{setting}={stated:g}`, or correct steps_per_mm",
            )

    def _index(self, axis: str) -> int:
        return codec.AXIS_LETTERS.index(self._letters[axis])

    def _name(self, letter: str) -> str:
        """Return the axis of a letter, or the letter where no axis of this stage has it."""
        names = {letter: axis for axis, letter in self._letters.items()}
        return names.get(letter, letter)

    def _positive(self, first: int, axis: str) -> float:
        number = first + self._index(axis)
        if number not in self._controller.settings:
            version = self._build.get("VER", "").rstrip(":") or "unknown"
            advice = "install Grbl 1.1 or grblHAL, which state scale, speed and travel of axes"
            if version.startswith("1.1"):
                advice = f"it has no axis {self._letters[axis]}, choose another letter"
            raise FirmwareError(
                f"firmware of version {version} does not state ${number}, of {axis}", advice
            )
        value = self._controller.setting(number)
        if not value > 0:
            raise _no_such_axis(axis, "$$", f"${number}={value:g}")
        return value


class _Controller:
    """Lines and real-time commands to a Grbl, and its answers and unasked messages.

    `on_lost` is called with the reason whenever the position became unknown. homing_lines: the
    commands of a homing under way that have no `ok` yet.
    """

    def __init__(self, transport: Transport, clock: Clock, on_lost: Callable[[str], None]) -> None:
        self.settings: dict[int, codec.Setting] = {}
        self._transport = transport
        self._clock = clock
        self._on_lost = on_lost
        self._alarm: codec.Alarm | None = None
        self._restarted = False
        self.homing_lines: list[str] = []
        self._rests = False
        self._offset_mm: tuple[float, ...] | None = None

    def setting(self, number: int) -> float:
        """Return a setting, 0 where it is not stated; raises `GarbledReplyError`."""
        stated = self.settings.get(number)
        return 0.0 if stated is None else stated.value

    def status(self) -> codec.Status:
        """Ask for a report, a few times if need be.

        Raises an `AxisFaultError` when the controller restarted, or was stopped by an alarm so
        severe that it no longer reports.
        """
        return repeated(self._ask_status, "'?'")

    def _ask_status(self) -> codec.Status:
        try:
            with self._transport.lock:
                self._take_waiting()
                self._transport.write(codec.STATUS_QUERY)
                for _ in turns(self._clock, LINES_TOLERATED):
                    status = self._read_message()
                    if isinstance(status, codec.Status):
                        break
                    self._note(status)
                    if self._waits_for_reset() and isinstance(status, codec.Feedback):
                        self.raise_alarm()  # it said "Reset to continue", and reports no more
                else:
                    raise GarbledReplyError(b"", "no report among what came")
        except (TransportTimeoutError, GarbledReplyError) as error:
            self._drain()
            self.raise_alarm()
            self._raise_restart()
            error.about(command="?")
            raise
        self._raise_restart()
        return status

    def machine_position_mm(self) -> tuple[codec.Status, tuple[float, ...]]:
        """Return a report and MPos, from WPos and the work offset where a report has only these."""
        unit = codec.MM_PER_INCH if self.setting(codec.REPORT_INCHES) else 1.0
        for _ in range(REPORTS_UNTIL_OFFSET):
            status = self.status()
            if status.offset is not None:
                self._offset_mm = tuple(offset * unit for offset in status.offset)
            if status.machine is not None:
                return status, tuple(position * unit for position in status.machine)
            if status.work is not None and self._offset_mm is not None:
                pairs = zip(status.work, self._offset_mm, strict=False)
                return status, tuple(work * unit + offset for work, offset in pairs)
        raise GarbledReplyError(b"", "no report states the work offset").about(command="?")

    def command(self, line: str, axis: str = "the controller") -> dict[str, str]:
        """Send a line once and return the feedback before its `ok`, by kind."""
        feedback: dict[str, str] = {}
        try:
            with self._transport.lock:
                self._take_waiting()
                self._transport.write(codec.encode_line(line))
                for _ in turns(self._clock, LINES_TOLERATED):
                    message = self._read_message()
                    if isinstance(message, codec.Ok):
                        self._raise_restart()
                        return feedback
                    if isinstance(message, codec.Refusal):
                        raise _refused(line, message, axis)
                    if isinstance(message, codec.Feedback):
                        feedback[message.kind] = message.text
                    self.raise_alarm()
                raise GarbledReplyError(b"", "no ok among what came")
        except (TransportTimeoutError, GarbledReplyError) as error:
            self.raise_alarm()
            error.about(axis=axis, command=line)
            raise

    def start_homing(self, lines: list[str]) -> None:
        """Send the homing commands; the controller answers each command at its end."""
        with self._transport.lock:
            self._take_waiting()
            self._rests = False
            self.homing_lines = list(lines)
            for line in lines:
                self._transport.write(codec.encode_line(line))

    def is_homing(self) -> bool:
        """Wait for the next line, and return whether homing goes on.

        Homing ends with an `ok` for every line sent. Grbl reports no state while it homes: a report
        of rest without a following `ok` means that homing never began, or that its end is unknown.
        """
        if not self.homing_lines:
            return False
        line = self.homing_lines[0]
        with self._transport.lock:
            try:
                message = self._read_message()
            except TransportTimeoutError:
                if self._rests:
                    self.homing_lines.clear()
                    raise LostPositionError(ALL_AXES, "homing ended without an answer").about(
                        command=line
                    ) from None
                self._transport.write(codec.STATUS_QUERY)
                return True
            except GarbledReplyError as error:
                _log.warning("dropped: %s", error)
                return True
            if isinstance(message, codec.Refusal):
                self.homing_lines.clear()
                raise _refused(line, message, ALL_AXES)
            self._note(message)
            self.raise_alarm()
            self._raise_restart()
        return bool(self.homing_lines)

    def abandon_homing(self) -> None:
        """Reset a controller during homing, which stops the axes at once."""
        self.homing_lines.clear()
        self._on_lost("its homing was stopped")
        self._transport.write(codec.SOFT_RESET)

    def leave_alarm(self) -> None:
        """Reset a controller that waits for it, or is held; it stands, so nothing is lost."""
        self.homing_lines.clear()
        state = ""
        if not self._waits_for_reset():
            with suppress(TransportTimeoutError, AxisFaultError):
                state = self.status().state
        if state not in ("Idle", "Alarm"):
            self._reset()
        self._alarm, self._restarted = None, False

    def unlock(self) -> None:
        """Let a controller in alarm move again, not homed."""
        if self.status().state == "Alarm":
            self.command("$X")

    def wait_for_boot(self) -> None:
        """Return when the controller answers; one that stays silent is reset once."""
        try:
            self.wait_for_status()
        except (TransportTimeoutError, GarbledReplyError):
            self._reset()
            self.wait_for_status()
        self._alarm, self._restarted = None, False

    def raise_alarm(self) -> None:
        """Raise the alarm that was received, if any; it stays until the next homing."""
        if self._alarm is None:
            return
        self.homing_lines.clear()
        alarm = self._alarm
        fault = FAULTS_BY_ALARM.get(alarm.code, AxisFaultError)
        advice = ALARM_ADVICE.get(alarm.code, "")
        error = fault(ALL_AXES, f"alarm {alarm.code} ({alarm.meaning})", advice)
        error.loses_position = alarm.code != POSITION_KEPT
        if error.loses_position:
            self._on_lost(alarm.meaning)
        raise error.about(reply=f"ALARM:{alarm.code}")

    def _waits_for_reset(self) -> bool:
        return self._alarm is not None and self._alarm.code in ALARMS_UNTIL_RESET

    def _raise_restart(self) -> None:
        if self._restarted:
            self._restarted = False
            self.homing_lines.clear()
            raise LostPositionError(ALL_AXES, "the controller restarted")

    def wait_for_status(self) -> None:
        """Return when it answers and stands; one that moves on is left to be found out later."""
        deadline_s = self._clock.now_s() + BOOT_S
        while True:
            try:
                self._alarm, self._restarted = None, False
                if self.status().state in ("Idle", "Alarm") or self._clock.now_s() >= deadline_s:
                    return
                self._clock.sleep(POLL_S)
            except AxisFaultError as fault:
                _log.debug("while starting: %s", fault)
            except (TransportTimeoutError, GarbledReplyError):
                if self._clock.now_s() >= deadline_s:
                    raise

    def _reset(self) -> None:
        """Reset the controller, again without its banner: an alarm drops a reset that comes early.

        Source: protocol.c, `protocol_exec_rt_system`.
        """
        with self._transport.lock:
            for _ in range(RESETS):
                self._restarted = False
                self._transport.write(codec.SOFT_RESET)
                self._drain()
                if self._restarted:
                    break
        self._alarm, self._restarted = None, False

    def _drain(self) -> None:
        """Take everything off the wire until nothing comes any more."""
        with self._transport.lock:
            for _ in range(LINES_TOLERATED):
                try:
                    self._note(self._read_message())
                except TransportTimeoutError:
                    self._transport.discard_input()
                    return
                except GarbledReplyError as error:
                    _log.warning("dropped: %s", error)
            self._transport.discard_until_quiet()

    def _take_waiting(self) -> None:
        """Take off the wire what came unasked."""
        for _ in range(LINES_TOLERATED):
            if not self._transport.waiting():
                return
            try:
                self._note(self._read_message())
            except (TransportTimeoutError, GarbledReplyError) as error:
                _log.warning("dropped: %s", error)
                self._transport.discard_input()

    def _note(self, message: codec.Message | None) -> None:
        """Remember what an unasked message says about homing."""
        if isinstance(message, codec.Ok) and self.homing_lines:
            self.homing_lines.pop(0)
        elif isinstance(message, codec.Status):
            self._rests = message.state in ("Idle", "Alarm")

    def _read_message(self) -> codec.Message | None:
        """Read one line, and take note of an alarm, a restart or a setting."""
        message = codec.decode_line(self._transport.read_until(codec.TERMINATOR))
        if isinstance(message, codec.Alarm):
            _log.warning("alarm %d: %s", message.code, message.meaning)
            self._alarm = message
        elif isinstance(message, codec.Banner):
            if message.version.startswith("0."):
                raise FirmwareError(f"Grbl {message.version} answers", codec.NEWER_FIRMWARE)
            self._restarted = True
            self._on_lost("the controller restarted")
        elif isinstance(message, codec.Setting):
            self.settings[message.number] = message
        elif message is not None and not isinstance(message, codec.Ok | codec.Status):
            _log.debug("%r", message)
        return message


def identify(transport: Transport, clock: Clock = SYSTEM_CLOCK) -> str:
    """Return version and options of the Grbl on a port; moves nothing, and resets nothing.

    Raises `TransportTimeoutError` or `GarbledReplyError` when no Grbl is there, `FirmwareError`
    when a Grbl is there whose status cannot be read.
    """
    controller = _Controller(transport, clock, _log.info)
    try:
        controller.wait_for_status()
        options = controller.command("$I")
    except GarbledReplyError as fault:
        if not fault.raw.startswith(codec.REPORT_BEGINS):
            raise
        about = {"axis": fault.axis, "command": fault.command, "reply": fault.reply}
        raise FirmwareError(fault.what, fault.advice).about(**about) from fault
    return f"version {options.get('VER', 'unknown')}, options {options.get('OPT', 'unknown')}"


def _refused(line: str, refusal: codec.Refusal, axis: str) -> CommandRefusedError:
    advice = REFUSAL_ADVICE.get(refusal.code, "see Grbl's table of errors")
    reply = f"error:{refusal.code} ({refusal.meaning})"
    return CommandRefusedError(line, reply, axis, advice)


def _no_such_axis(axis: str, command: str, reply: str) -> CommandRefusedError:
    return CommandRefusedError(command, reply, axis, "this controller has no such axis")

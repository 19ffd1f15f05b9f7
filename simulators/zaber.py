"""Firmware of a chain of Zaber devices: ASCII commands in, replies out, axes that take time.

Simplified: a stop and a new move halt the axis at once; homing is one move onto the switch at 0
and sets the counter there; settings are not kept over a power cycle; commands longer than the
packet size are accepted. Source of the messages: Zaber ASCII Protocol Manual.
"""

import math
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from drivers.clock import Clock
from drivers.zaber_codec import SPEED_SCALE, lrc
from simulators.faults import Faults
from simulators.wire import MemoryTransport

ACCELERATION_SCALE = SPEED_SCALE / 1e4
PACKET_SIZE = 80
FLAGS_BY_SEVERITY = ("FS", "WR", "WH", "NI")
FAULTS = ("drop_command", "drop_reply", "garble_reply", "stall", "unplug")

_COMMAND = re.compile(rb"/([^:]*)(?::([0-9A-Fa-f]{2}))?")


@dataclass(frozen=True)
class AxisSpec:
    """A lead-screw axis: 0 is the home switch, `start_um` where it stands at power-up.

    `backlash_um` is the play of the nut: moving up it sits on the screw's own position, moving
    down it lags that much above.
    """

    travel_um: float = 25_400.0
    microstep_um: float = 0.047625
    max_speed_um_s: float = 7_000.0
    acceleration_um_s2: float = 200_000.0
    start_um: float = 3_210.0
    backlash_um: float = 3.0


BENCH_AXES = {(device, axis): AxisSpec() for device in (1, 2) for axis in (1, 2)}


@dataclass(frozen=True)
class Motion:
    """A move from rest to rest with constant acceleration up to a top speed."""

    start_um: float
    end_um: float
    start_s: float
    speed_um_s: float
    acceleration_um_s2: float

    @property
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
        elapsed_s = min(max(now_s - self.start_s, 0.0), self.duration_s)
        left_s = self.duration_s - elapsed_s
        ramp_s = self.peak_um_s / self.acceleration_um_s2
        distance_um = abs(self.end_um - self.start_um)
        if elapsed_s < ramp_s:
            covered_um = self.acceleration_um_s2 * elapsed_s**2 / 2
        elif left_s < ramp_s:
            covered_um = distance_um - self.acceleration_um_s2 * left_s**2 / 2
        else:
            covered_um = self.peak_um_s * (elapsed_s - ramp_s / 2)
        return self.start_um + math.copysign(covered_um, self.end_um - self.start_um)


class _RefusedError(Exception):
    """A command the firmware answers with RJ and this reason."""


class _Axis:
    """One motor: its true position, its step counter and its flags."""

    def __init__(self, spec: AxisSpec, clock: Clock) -> None:
        self.spec = spec
        self.flags = {"WR", "WH"}
        self.settings = {
            "maxspeed": round(spec.max_speed_um_s / spec.microstep_um * SPEED_SCALE),
            "accel": round(spec.acceleration_um_s2 / spec.microstep_um * ACCELERATION_SCALE),
            "limit.min": 0,
            "limit.max": math.floor(spec.travel_um / spec.microstep_um),
        }
        self._clock = clock
        self._motor_um = spec.start_um
        self._nut_um = spec.start_um
        self._counter_origin_um = spec.start_um
        self._motion: Motion | None = None
        self._homing = False
        self._blocked = False

    def advance(self) -> bool:
        """Bring the axis to the present; return whether a move ended since the last time."""
        if self._motion is None:
            return False
        now_s = self._clock.now_s()
        self._motor_um = self._motion.position_um(now_s)
        self._nut_um = min(
            max(self._nut_um, self._motor_um), self._motor_um + self.spec.backlash_um
        )
        if now_s < self._motion.start_s + self._motion.duration_s:
            return False
        self._motion = None
        if self._blocked:
            self.flags |= {"FS", "WR"}
        elif self._homing:
            self._counter_origin_um = 0.0
            self.flags -= {"WR", "WH"}
        return True

    @property
    def busy(self) -> bool:
        return self._motion is not None

    @property
    def nut_um(self) -> float:
        return self._nut_um

    @property
    def counter(self) -> int:
        """Position in microsteps from where the counter believes 0 to be."""
        return round((self._motor_um - self._counter_origin_um) / self.spec.microstep_um)

    def move_abs(self, target: int, stalls: bool) -> None:
        if not self.settings["limit.min"] <= target <= self.settings["limit.max"]:
            raise _RefusedError("BADDATA")
        self._go(self._counter_origin_um + target * self.spec.microstep_um, False, stalls)

    def home(self, stalls: bool) -> None:
        self._go(0.0, True, stalls)

    def stop(self) -> None:
        if self._motion is not None:
            self._motion = None
            self.flags.add("NI")

    def clear_warnings(self) -> None:
        self.flags = {flag for flag in self.flags if flag.startswith("W")}

    def restarted(self) -> "_Axis":
        """Return the axis as it comes up after power was lost where it is now."""
        self.advance()
        axis = _Axis(replace(self.spec, start_um=self._motor_um), self._clock)
        axis._nut_um = self._nut_um
        return axis

    def _go(self, target_um: float, homing: bool, stalls: bool) -> None:
        interrupts = self.busy
        self.clear_warnings()
        if interrupts:
            self.flags.add("NI")
        end_um = min(max(target_um, 0.0), self.spec.travel_um)
        self._blocked = stalls or end_um != target_um
        self._homing = homing
        self._motion = Motion(
            start_um=self._motor_um,
            end_um=(self._motor_um + end_um) / 2 if stalls else end_um,
            start_s=self._clock.now_s(),
            speed_um_s=self.settings["maxspeed"] * self.spec.microstep_um / SPEED_SCALE,
            acceleration_um_s2=self.settings["accel"] * self.spec.microstep_um / ACCELERATION_SCALE,
        )


class _Device:
    """One controller: its axes, numbered from 1, and its own settings."""

    def __init__(self, axes: list[_Axis]) -> None:
        self.axes = axes
        self.settings = {"comm.checksum": 1, "comm.alert": 0}
        self.constants = {
            "comm.packet.size.max": PACKET_SIZE,
            "system.axiscount": len(axes),
        }


class ZaberChain:
    """Devices on one chain, keyed by (device address, axis number).

    Faults, armed with `faults.inject`: `drop_command` and `drop_reply` lose one message,
    `garble_reply` flips a bit of one, `stall` blocks the next move half way, `unplug` pulls the
    cable at the next byte.
    """

    def __init__(self, clock: Clock, axes: Mapping[tuple[int, int], AxisSpec] = BENCH_AXES) -> None:
        self.faults = Faults(FAULTS)
        self._clock = clock
        self._devices = {
            address: _Device([_Axis(axes[key], clock) for key in sorted(axes) if key[0] == address])
            for address in sorted({device for device, _ in axes})
        }
        self._lock = threading.Lock()
        self._unplugged = False
        self._unread = bytearray()

    def transport(self, timeout_s: float = 0.5) -> MemoryTransport:
        """Return a wire in memory that ends in this chain."""
        return MemoryTransport(self, self._clock, timeout_s)

    @property
    def unplugged(self) -> bool:
        """Whether the cable has been pulled."""
        return self._unplugged

    def position_um(self, device: int, axis: int) -> float:
        """Return where the axis really is, whatever its counter says: um from the home switch."""
        with self._lock:
            one = self._devices[device].axes[axis - 1]
            one.advance()
            return one.nut_um

    def power_cycle(self) -> None:
        """Switch the chain off and on: the axes stay where they are and forget where that is."""
        with self._lock:
            for device in self._devices.values():
                device.axes = [axis.restarted() for axis in device.axes]

    def feed(self, data: bytes) -> bytes:
        """Take bytes from the host and return the replies, and alerts that fell due, if any."""
        with self._lock:
            if self._unplugged or self.faults.strikes("unplug"):
                self._unplugged = True
                return b""
            self._unread += data.replace(b"\r", b"\n")
            *lines, rest = self._unread.split(b"\n")
            self._unread = bytearray(rest)
            return b"".join(self._answer(bytes(line)) for line in lines)

    def _answer(self, line: bytes) -> bytes:
        answer = b"".join(self._due_alerts())
        match = _COMMAND.fullmatch(line[max(line.find(b"/"), 0) :])
        if match is None or self.faults.strikes("drop_command"):
            return answer
        body, checksum = match.groups()
        if checksum is not None and int(checksum, 16) != lrc(body):
            return answer
        address, axis_number, message_id, words = _parse(body.decode("ascii", "replace"))
        for device_address, device in self._devices.items():
            if address in (0, device_address):
                reply = self._reply(device, device_address, axis_number, message_id, words)
                answer += self._on_the_wire(reply)
        return answer

    def _due_alerts(self) -> list[bytes]:
        alerts = []
        for address, device in self._devices.items():
            for number, axis in enumerate(device.axes, start=1):
                if axis.advance() and device.settings["comm.alert"]:
                    text = f"{address:02d} {number} IDLE {_flag([axis])}"
                    alerts.append(_encode("!", text, device))
        return alerts

    def _on_the_wire(self, reply: bytes) -> bytes:
        if self.faults.strikes("drop_reply"):
            return b""
        if self.faults.strikes("garble_reply"):
            middle = len(reply) // 2
            return reply[:middle] + bytes([reply[middle] ^ 1]) + reply[middle + 1 :]
        return reply

    def _reply(
        self,
        device: _Device,
        address: int,
        axis_number: int,
        message_id: int | None,
        words: list[str],
    ) -> bytes:
        axes = device.axes
        try:
            if axis_number > len(device.axes):
                raise _RefusedError("BADAXIS")
            if axis_number:
                axes = [device.axes[axis_number - 1]]
            name = words[0] if words else ""
            if name not in self._commands:
                raise _RefusedError("BADCOMMAND")
            data = self._commands[name](self, device, axes, axis_number, words[1:])
            outcome = "OK"
        except _RefusedError as refusal:
            outcome, data = "RJ", str(refusal)
        status = "BUSY" if any(axis.busy for axis in axes) else "IDLE"
        label = "" if message_id is None else f"{message_id:02d} "
        text = f"{address:02d} {axis_number} {label}{outcome} {status} {_flag(axes)} {data}"
        return _encode("@", text, device)

    def _poll(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        return "0"

    def _home(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        for axis in axes:
            axis.home(self.faults.strikes("stall"))
        return "0"

    def _move(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        if len(words) != 2 or words[0] not in ("abs", "rel"):
            raise _RefusedError("BADCOMMAND")
        amount = _integer(words[1])
        for axis in axes:
            origin = axis.counter if words[0] == "rel" else 0
            axis.move_abs(origin + amount, self.faults.strikes("stall"))
        return "0"

    def _stop(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        for axis in axes:
            axis.stop()
        return "0"

    def _warnings(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        flags = _flags(axes)
        if words == ["clear"]:
            for axis in axes:
                axis.clear_warnings()
        elif words:
            raise _RefusedError("BADCOMMAND")
        return " ".join([f"{len(flags):02d}", *flags])

    def _get(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        if len(words) != 1:
            raise _RefusedError("BADCOMMAND")
        (setting,) = words
        if setting == "pos":
            return " ".join(str(axis.counter) for axis in axes)
        if setting in axes[0].settings:
            return " ".join(str(axis.settings[setting]) for axis in axes)
        whole = device.settings | device.constants
        if setting not in whole:
            raise _RefusedError("BADCOMMAND")
        if number:
            raise _RefusedError("DEVICEONLY")
        return str(whole[setting])

    def _set(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        if len(words) != 2:
            raise _RefusedError("BADCOMMAND")
        setting, value = words[0], _integer(words[1])
        if setting in axes[0].settings:
            if setting in ("maxspeed", "accel") and value < 1:
                raise _RefusedError("BADDATA")
            for axis in axes:
                axis.settings[setting] = value
        elif setting not in device.settings:
            raise _RefusedError("BADCOMMAND")
        elif number:
            raise _RefusedError("DEVICEONLY")
        elif value not in (0, 1):
            raise _RefusedError("BADDATA")
        else:
            device.settings[setting] = value
        return "0"

    _commands: Mapping[str, Callable[..., str]] = {
        "": _poll,
        "home": _home,
        "move": _move,
        "stop": _stop,
        "warnings": _warnings,
        "get": _get,
        "set": _set,
    }


def _parse(body: str) -> tuple[int, int, int | None, list[str]]:
    """Return device, axis, message id and the words of a command; numbers left out are 0."""
    words = body.split()
    numbers = []
    while words and len(numbers) < 3 and words[0].isdigit():
        numbers.append(int(words.pop(0)))
    message_id = numbers[2] if len(numbers) == 3 else None
    device, axis = [*numbers[:2], 0, 0][:2]
    return device, axis, message_id, words


def _integer(word: str) -> int:
    try:
        return int(word)
    except ValueError as error:
        raise _RefusedError("BADDATA") from error


def _flags(axes: list[_Axis]) -> list[str]:
    raised = {flag for axis in axes for flag in axis.flags}
    return [flag for flag in FLAGS_BY_SEVERITY if flag in raised]


def _flag(axes: list[_Axis]) -> str:
    return next(iter(_flags(axes)), "--")


def _encode(kind: str, text: str, device: _Device) -> bytes:
    body = text.encode("ascii")
    checksum = b":%02X" % lrc(body) if device.settings["comm.checksum"] else b""
    return kind.encode("ascii") + body + checksum + b"\r\n"

"""Firmware of a chain of Zaber devices: ASCII commands in, replies out, axes that take time.

Simplified: a new move starts from where the axis is, at rest; homing is one move onto the switch
at 0 and sets the counter there; settings are not kept over a power cycle; commands longer than
the packet size are accepted. A command or setting of real firmware that is not modelled (`move
vel`, `estop`, ...) is refused as an unknown one, and logged.
Source of the messages: Zaber ASCII Protocol Manual.
"""

import logging
import math
import re
from collections.abc import Callable, Collection, Mapping

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.zaber_codec import DEFAULT_RESOLUTION, FLAG_MEANINGS, SPEED_SCALE, lrc
from emmc_rig.simulators.firmware import SimulatedController, earliest_s
from emmc_rig.simulators.motion import AxisSpec, End, Motor

__all__ = ["BENCH_AXES", "AxisSpec", "ZaberChain"]

ACCELERATION_SCALE = SPEED_SCALE / 1e4
PACKET_SIZE = 80
NO_MODEL = 65_535
"""A device id that no table has: a driver needs its scale in the settings."""
FIRMWARE = "7.38"
FIRST_SERIAL_NUMBER = 73_001
DRIVER_OFF = "FH"

TOP_SPEED_PER_RESOLUTION = 16_384
"""`maxspeed` ends at this many times the resolution."""
FINEST_RESOLUTION = 256
TEMPERATURE_C = "31.4"
OLD_NAMES = {"deviceid": "device.id", "peripheralid": "peripheral.id"}
"""What firmware 6 called them; firmware 7 answers to both."""

_log = logging.getLogger(__name__)
_COMMAND = re.compile(rb"/([^:]*)(?::([0-9A-Fa-f]{2}))?")

BENCH_AXES = {(device, axis): AxisSpec() for device in (1, 2) for axis in (1, 2)}


class _RefusedError(Exception):
    """A command the firmware answers with RJ and this reason."""


class _Axis:
    """A motor with its settings and warning flags."""

    def __init__(self, motor: Motor, peripheral_id: int | None) -> None:
        self.motor = motor
        self.spec = spec = motor.spec
        self.peripheral_id = peripheral_id
        self.flags = {"WR", "WH"}
        self.driver_enabled = True
        self.settings = {
            "maxspeed": round(spec.max_speed_um_s / spec.microstep_um * SPEED_SCALE),
            "limit.approach.maxspeed": round(
                spec.max_speed_um_s / 2 / spec.microstep_um * SPEED_SCALE
            ),
            "accel": round(spec.acceleration_um_s2 / spec.microstep_um * ACCELERATION_SCALE),
            "limit.min": 0,
            "limit.max": math.floor(spec.travel_um / spec.microstep_um),
            "resolution": DEFAULT_RESOLUTION,
        }
        self._homing = False

    def advance(self) -> bool:
        """Advance to the time of the clock; return whether a move ended since the last time."""
        end = self.motor.advance()
        if end is None:
            return False
        if end in (End.STALLED, End.AT_END_OF_TRAVEL):
            self.flags |= {"FS", "WR"}
        elif end is End.ARRIVED and self._homing:
            self.motor.count_from_here()
            self.flags -= {"WR", "WH"}
        return True

    @property
    def busy(self) -> bool:
        return self.motor.moving

    @property
    def counter(self) -> int:
        """Position in microsteps from where the counter believes 0 to be."""
        return round(self.motor.counted_um / self.microstep_um)

    @property
    def microstep_um(self) -> float:
        """Length of a microstep; that of the specification is at the default resolution."""
        return self.spec.microstep_um * DEFAULT_RESOLUTION / self.settings["resolution"]

    @property
    def top_speed(self) -> int:
        """Highest value of a speed."""
        return TOP_SPEED_PER_RESOLUTION * self.settings["resolution"]

    def set_resolution(self, resolution: int) -> None:
        """Count finer or coarser; every setting in microsteps follows."""
        if not 1 <= resolution <= FINEST_RESOLUTION:
            raise _RefusedError("BADDATA")
        if self.busy:
            raise _RefusedError("STATUSBUSY")
        ratio = resolution / self.settings["resolution"]
        self.settings = {name: round(value * ratio) for name, value in self.settings.items()}
        self.settings["resolution"] = resolution

    def move_abs(self, target: int, stalls: bool, start_s: float) -> None:
        """Go to a position at `maxspeed`."""
        if not self.settings["limit.min"] <= target <= self.settings["limit.max"]:
            raise _RefusedError("BADDATA")
        self._begin(False)
        self.motor.go(target * self.microstep_um, *self._pace(), stalls, start_s)

    def home(self, stalls: bool) -> None:
        self._begin(True)
        speed_um_s, acceleration_um_s2 = self._pace()
        approach = self.settings["limit.approach.maxspeed"] / SPEED_SCALE
        speed_um_s = min(speed_um_s, approach * self.microstep_um)
        if stalls:
            self.motor.go(self.motor.counted_um / 2, speed_um_s, acceleration_um_s2, stalls)
        else:
            self.motor.seek(0.0, speed_um_s, acceleration_um_s2)

    def stop(self) -> None:
        if self.motor.moving:
            self.motor.brake(self._pace()[1])
            self.flags.add("NI")

    def cut_power(self) -> None:
        """What the emergency stop does: the motor stands and its driver is off."""
        self.motor.halt()
        self.driver_enabled = False
        self.flags |= {DRIVER_OFF, "WR"}

    def enable(self) -> None:
        self.driver_enabled = True
        self.flags.discard(DRIVER_OFF)

    def clear_warnings(self) -> None:
        kept = ("W", DRIVER_OFF)
        self.flags = {flag for flag in self.flags if flag.startswith(kept)} - {"WM"}

    def restarted(self) -> "_Axis":
        """Return the axis as it comes up after power was lost where it is now."""
        return _Axis(self.motor.restarted(), self.peripheral_id)

    def _pace(self) -> tuple[float, float]:
        """Return speed and acceleration in um/s and um/s^2."""
        return (
            self.settings["maxspeed"] * self.microstep_um / SPEED_SCALE,
            self.settings["accel"] * self.microstep_um / ACCELERATION_SCALE,
        )

    def _begin(self, homing: bool) -> None:
        if not self.driver_enabled:
            raise _RefusedError("DRIVERDISABLED")
        interrupts = self.motor.moving
        self.clear_warnings()
        if interrupts:
            self.flags.add("NI")
        self._homing = homing


class _Device:
    """One controller: its axes, numbered from 1, and its own settings."""

    def __init__(self, address: int, axes: list[_Axis], model: int, modified: bool) -> None:
        self.axes = axes
        self.settings = {"comm.checksum": 1, "comm.alert": 0}
        self.constants = {
            "comm.packet.size.max": str(PACKET_SIZE),
            "system.axiscount": str(len(axes)),
            "system.serial": str(FIRST_SERIAL_NUMBER + address),
            "device.id": str(model),
            "device.hw.modified": str(int(modified)),
            "version": FIRMWARE,
            "system.temperature": TEMPERATURE_C,
        }


class ZaberChain(SimulatedController):
    """Devices on one chain, keyed by (device address, axis number).

    `models`: device ids by address; `peripherals`: peripheral ids of the axes of controllers.
    `modified`: addresses of devices that have other mechanics than their id states. The microstep
    of an axis is its specification's at the default resolution, whatever its ids.
    Faults as `SimulatedController`'s, and `emergency_stop`: the power of every motor is cut at
    the next command.
    """

    def __init__(
        self,
        clock: Clock,
        axes: Mapping[tuple[int, int], AxisSpec] = BENCH_AXES,
        models: Mapping[int, int] | None = None,
        peripherals: Mapping[tuple[int, int], int] | None = None,
        modified: Collection[int] = (),
    ) -> None:
        super().__init__(clock, ("emergency_stop",))
        models, peripherals = models or {}, peripherals or {}
        self._devices = {
            address: _Device(
                address,
                [
                    _Axis(Motor(axes[key], clock), peripherals.get(key))
                    for key in sorted(axes)
                    if key[0] == address
                ],
                models.get(address, NO_MODEL),
                address in modified,
            )
            for address in sorted({device for device, _ in axes})
        }
        self._unread = bytearray()

    def position_um(self, device: int, axis: int) -> float:
        """Return where the axis really is, whatever its counter says: um from the home switch."""
        with self._lock:
            found = self._devices[device].axes[axis - 1]
            found.advance()
            return found.motor.nut_um

    def displace(self, device: int, axis: int, distance_um: float) -> None:
        """Push an axis that stands; its encoder notices."""
        with self._lock:
            found = self._devices[device].axes[axis - 1]
            found.motor.drift(distance_um)
            found.flags.add("WM")

    def power_cycle(self) -> None:
        """Switch the chain off and on: the axes stay in place and lose their reference."""
        with self._lock:
            for device in self._devices.values():
                device.axes = [axis.restarted() for axis in device.axes]

    def _receive(self, data: bytes) -> None:
        self._unread += data.replace(b"\r", b"\n")
        *lines, rest = self._unread.split(b"\n")
        self._unread = bytearray(rest)
        for line in lines:
            self._answer(bytes(line))

    def _advance(self) -> None:
        for address, device in self._devices.items():
            for number, axis in enumerate(device.axes, start=1):
                if axis.advance() and device.settings["comm.alert"]:
                    text = f"{address:02d} {number} IDLE {_flag([axis])}"
                    self._send(_encode("!", text, device))

    def _next_event_s(self) -> float | None:
        devices = self._devices.values()
        return earliest_s(axis.motor.ends_s for device in devices for axis in device.axes)

    def _answer(self, line: bytes) -> None:
        self._advance()
        match = _COMMAND.fullmatch(line[max(line.find(b"/"), 0) :])
        if match is None or self._dropped(line):
            return
        if self.faults.strikes("emergency_stop", line):
            for device in self._devices.values():
                for axis in device.axes:
                    axis.cut_power()
        body, checksum = match.groups()
        if checksum is not None and int(checksum, 16) != lrc(body):
            return
        address, axis_number, message_id, words = _parse(body.decode("ascii", "replace"))
        for device_address, device in self._devices.items():
            if address in (0, device_address):
                self._send(self._reply(device, device_address, axis_number, message_id, words))

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
            if name in self._commands:
                data = self._commands[name](self, device, axes, axis_number, words[1:])
            else:
                raise _not_modelled(words)
            outcome = "OK"
        except _RefusedError as refusal:
            outcome, data = "RJ", str(refusal)
        status = "BUSY" if any(axis.busy for axis in axes) else "IDLE"
        label = "" if message_id is None else f"{message_id:02d} "
        text = f"{address:02d} {axis_number} {label}{outcome} {status} {_flag(axes)} {data or '0'}"
        return _encode("@", text, device)

    def _poll(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> None:
        """Answer with the status alone."""

    def _stop(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> None:
        for axis in axes:
            axis.stop()

    def _home(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> None:
        for axis in axes:
            axis.home(self._stalls(axis.motor))

    def _move(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> None:
        if words[:1] != ["abs"]:
            raise _not_modelled(["move", *words])
        if len(words) != 2:
            raise _RefusedError("BADCOMMAND")
        for axis in axes:
            axis.move_abs(_integer(words[1]), self._stalls(axis.motor), self._start_s())

    def _driver(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> None:
        if words != ["enable"]:
            raise _RefusedError("BADCOMMAND")
        for axis in axes:
            axis.enable()

    def _warnings(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        flags = _flags(axes)
        if words == ["clear"]:
            for axis in axes:
                axis.clear_warnings()
        elif words:
            raise _not_modelled(["warnings", *words])
        return " ".join([f"{len(flags):02d}", *flags])

    def _get(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> str:
        if len(words) != 1:
            raise _RefusedError("BADCOMMAND")
        setting = OLD_NAMES.get(words[0], words[0])
        if setting == "pos":
            return " ".join(str(axis.counter) for axis in axes)
        if setting in ("peripheral.id", "peripheral.hw.modified"):
            ids = [axis.peripheral_id for axis in axes if axis.peripheral_id is not None]
            if not ids:
                raise _RefusedError("BADCOMMAND")
            return " ".join(str(i) if setting == "peripheral.id" else "0" for i in ids)
        if setting in axes[0].settings:
            return " ".join(str(axis.settings[setting]) for axis in axes)
        whole = device.settings | device.constants
        if setting not in whole:
            raise _not_modelled(["get", setting])
        if number:
            raise _RefusedError("DEVICEONLY")
        return str(whole[setting])

    def _set(self, device: _Device, axes: list[_Axis], number: int, words: list[str]) -> None:
        if len(words) != 2:
            raise _RefusedError("BADCOMMAND")
        setting, value = words[0], _integer(words[1])
        if setting == "resolution":
            for axis in axes:
                axis.set_resolution(value)
        elif setting in axes[0].settings:
            if not setting.startswith("limit.m") and value < 1:
                raise _RefusedError("BADDATA")
            for axis in axes:
                if setting.endswith("maxspeed") and value > axis.top_speed:
                    raise _RefusedError("BADDATA")
                axis.settings[setting] = value
        elif setting not in device.settings:
            raise _not_modelled(["set", *words])
        elif number:
            raise _RefusedError("DEVICEONLY")
        elif value not in (0, 1):
            raise _RefusedError("BADDATA")
        else:
            device.settings[setting] = value

    _commands: Mapping[str, Callable[..., str | None]] = {
        "": _poll,
        "stop": _stop,
        "home": _home,
        "move": _move,
        "driver": _driver,
        "warnings": _warnings,
        "get": _get,
        "set": _set,
    }


def _not_modelled(words: list[str]) -> _RefusedError:
    """Return the refusal of a command, having logged that it may exist on a real device."""
    _log.warning("not modelled, refused: %s", " ".join(words))
    return _RefusedError("BADCOMMAND")


def _parse(body: str) -> tuple[int, int, int | None, list[str]]:
    """Return device, axis, message id and the words of a command; numbers left out are 0."""
    words = body.split()
    numbers = []
    while words and len(numbers) < 3 and words[0].isdecimal():
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
    return [flag for flag in FLAG_MEANINGS if flag in raised]


def _flag(axes: list[_Axis]) -> str:
    return next(iter(_flags(axes)), "--")


def _encode(kind: str, text: str, device: _Device) -> bytes:
    body = text.encode("ascii")
    checksum = b":%02X" % lrc(body) if device.settings["comm.checksum"] else b""
    return kind.encode("ascii") + body + checksum + b"\r\n"

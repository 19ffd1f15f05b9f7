"""Zaber stages: named axes of the devices on one chain, over the ASCII protocol."""

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import cycle

from drivers import zaber_codec as codec
from drivers.clock import SYSTEM_CLOCK, Clock
from drivers.errors import (
    AxisFaultError,
    CommandRefusedError,
    DriverError,
    EmergencyStopError,
    GarbledReplyError,
    LimitSwitchError,
    LostPositionError,
    StalledError,
    TransportTimeoutError,
)
from drivers.stage import DEFAULT_SETTINGS, HostStage, Reading, StageSettings, check_tolerance
from drivers.transport import Transport

_log = logging.getLogger(__name__)

QUERY_ATTEMPTS = 3
FOREIGN_MESSAGES_TOLERATED = 64
EXCHANGE_LIMIT_S = 2.0
"""Longest wait for one answer among messages that are none."""
REFERENCE_FLAGS = {"WR", "WH"}
DRIVER_OFF_FLAGS = {"FH", "FO", "FD"}
FAULTS_BY_FLAG: Mapping[str, type[AxisFaultError]] = {
    "FH": EmergencyStopError,
    "FO": EmergencyStopError,
    "FD": EmergencyStopError,
    "FS": StalledError,
    "FE": LimitSwitchError,
    "WL": LimitSwitchError,
    "FQ": LostPositionError,
    "FI": LostPositionError,
    "FA": LostPositionError,
    "WM": LostPositionError,
}
REFUSAL_ADVICE = {
    "BADDATA": "the value is out of range, check units and limits",
    "BADCOMMAND": "this device does not know the command, check its model and firmware",
    "BADAXIS": "the device has no such axis, check the axis numbers",
    "STATUSBUSY": "it is moving, stop it or wait",
    "PARKED": "it is parked, unpark it",
    "DRIVERDISABLED": "its motor driver is off, release the emergency stop and home it",
    "INACTIVE": "nothing is connected to this axis, check its cable",
    "REMOTE": "another program controls the device over its network port, close that",
}

_NUMBER = re.compile(r"-?\d{1,15}(\.\d+)?")


@dataclass(frozen=True)
class ZaberDevice:
    """One controller found on a chain."""

    address: int
    axis_count: int
    device_id: str
    serial_number: str
    firmware: str


class ZaberStage(HostStage):
    """Axes of one chain, `axes` mapping names to (device address, axis number).

    `microstep_um` is the length of a microstep, one for all axes or by name. Construction asks
    every axis for its limits and speed, so that a missing one shows at once; it moves nothing.
    Raises `TransportTimeoutError` for a device that does not answer.
    Source: Zaber ASCII Protocol Manual (commands `home`, `move abs`, `stop`, `warnings`,
    `driver enable`; settings `pos`, `limit.min`, `limit.max`, `maxspeed`, `comm.checksum`,
    `limit.approach.maxspeed`).
    """

    def __init__(
        self,
        transport: Transport,
        axes: Mapping[str, tuple[int, int]],
        microstep_um: float | Mapping[str, float],
        clock: Clock = SYSTEM_CLOCK,
        settings: StageSettings = DEFAULT_SETTINGS,
    ) -> None:
        super().__init__(axes, (transport,), clock, settings)
        self._chain = _Chain(transport, clock)
        self._addresses = dict(axes)
        if isinstance(microstep_um, Mapping):
            self._microstep_um = dict(microstep_um)
        else:
            self._microstep_um = dict.fromkeys(axes, microstep_um)
        for axis in axes:
            check_tolerance(axis, settings.tolerance_um, self._microstep_um[axis])
        self._start_up()

    def speed_um_s(self, axis: str) -> float:
        """Return the speed of a move, as the device last said it."""
        self._require_axis(axis)
        return self._move_speeds_um_s[axis]

    def _configure(self) -> None:
        self._chain.checksummed = frozenset()
        self._chain.checksummed = frozenset(
            device for device, _ in self._addresses.values() if self._enable_checksum(device)
        )
        axes = self._axes
        self._limits_um = {
            axis: (self._length_um(axis, "limit.min"), self._length_um(axis, "limit.max"))
            for axis in axes
        }
        self._move_speeds_um_s = {axis: self._speed_setting_um_s(axis, "maxspeed") for axis in axes}
        self._home_speeds_um_s = {axis: self._approach_speed_um_s(axis) for axis in axes}

    def _read(self, axis: str) -> Reading:
        reply = self._query(axis, "get pos")
        if reply.flag in (codec.NO_FLAG, *REFERENCE_FLAGS) or reply.flag.startswith("N"):
            homed = reply.flag not in REFERENCE_FLAGS
        else:
            flags = self._warnings(axis)
            self._raise_fault(axis, flags, LostPositionError)
            homed = REFERENCE_FLAGS.isdisjoint(flags)
        return Reading(self._number(axis, reply) * self._microstep_um[axis], homed, reply.busy)

    def _start_home(self, axes: tuple[str, ...]) -> None:
        """Home every axis; repeated when the answer is lost, for homing twice does no harm."""
        for axis in axes:
            if DRIVER_OFF_FLAGS.intersection(self._warnings(axis)):
                self._query(axis, "driver enable")
            self._query(axis, "warnings clear")
            self._query(axis, "home")

    def _start_moves(self, targets_um: Mapping[str, float], start_um: Mapping[str, float]) -> None:
        for axis, target_um in targets_um.items():
            target = round(target_um / self._microstep_um[axis])
            self._send_once((axis,), lambda axis=axis, target=target: self._move(axis, target))

    def _move(self, axis: str, target: int) -> None:
        device, number = self._addresses[axis]
        self._chain.ask(device, number, f"move abs {target}", axis)

    def _stop_axis(self, axis: str) -> None:
        self._query(axis, "stop")

    def _is_moving(self, axis: str) -> bool:
        reply = self._query(axis, "")
        if reply.flag != codec.NO_FLAG and not reply.flag.startswith("N"):
            self._raise_fault(axis, self._warnings(axis), AxisFaultError)
        return reply.busy

    def _travel_um(self, axis: str) -> tuple[float, float]:
        return self._limits_um[axis]

    def _apply_speed(self, axis: str, speed_um_s: float) -> None:
        wanted = max(1, round(speed_um_s / self._microstep_um[axis] * codec.SPEED_SCALE))
        self._query(axis, f"set maxspeed {wanted}")
        self._move_speeds_um_s[axis] = self._speed_setting_um_s(axis, "maxspeed")

    def _homing_speed_um_s(self, axis: str) -> float:
        return self._home_speeds_um_s[axis]

    def _readings_are_checked(self, axis: str) -> bool:
        return self._addresses[axis][0] in self._chain.checksummed

    def _warnings(self, axis: str) -> list[str]:
        """Return the flags raised, the most severe first; the device's reply counts them too."""
        reply = self._query(axis, "warnings")
        count, *flags = reply.data.split() or [""]
        if not (count.isdigit() and int(count) == len(flags)):
            raise GarbledReplyError(reply.data.encode("ascii"), f"no list of warnings of {axis}")
        return flags

    def _raise_fault(self, axis: str, flags: list[str], kind: type[AxisFaultError]) -> None:
        """Raise the most severe fault of a kind among the flags, if there is one."""
        for flag in flags:
            if flag.startswith("F") or flag in FAULTS_BY_FLAG:
                fault = FAULTS_BY_FLAG.get(flag, AxisFaultError)
                if issubclass(fault, kind):
                    meaning = codec.FLAG_MEANINGS.get(flag, "see the protocol manual")
                    raise fault(axis, f"{flag} ({meaning})").about(reply=flag)

    def _length_um(self, axis: str, setting: str) -> float:
        return self._number(axis, self._query(axis, f"get {setting}")) * self._microstep_um[axis]

    def _speed_setting_um_s(self, axis: str, setting: str) -> float:
        speed_um_s = self._length_um(axis, setting) / codec.SPEED_SCALE
        if not speed_um_s > 0:
            raise GarbledReplyError(b"", f"{setting} of {axis} is not positive").about(axis=axis)
        return speed_um_s

    def _approach_speed_um_s(self, axis: str) -> float:
        """Return the speed of homing; firmware that has no setting for it homes as it moves."""
        try:
            approach_um_s = self._speed_setting_um_s(axis, "limit.approach.maxspeed")
        except CommandRefusedError:
            return self._move_speeds_um_s[axis]
        return min(approach_um_s, self._move_speeds_um_s[axis])

    def _number(self, axis: str, reply: codec.Reply) -> float:
        if not _NUMBER.fullmatch(reply.data):
            raw = reply.data.encode("ascii")
            raise GarbledReplyError(raw, f"not a number for {axis}").about(axis=axis)
        return float(reply.data)

    def _enable_checksum(self, device: int) -> bool:
        """Return whether the device will put a checksum on its replies; old firmware cannot."""
        try:
            self._chain.query(device, 0, "set comm.checksum 1", f"device {device}")
        except CommandRefusedError:
            return False
        return True

    def _query(self, axis: str, data: str) -> codec.Reply:
        device, number = self._addresses[axis]
        return self._chain.query(device, number, data, axis)


class _Chain:
    """Commands to the devices on one port, and the replies that belong to them."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self.checksummed: frozenset[int] = frozenset()
        self._transport = transport
        self._clock = clock
        self._message_ids = cycle(codec.MESSAGE_IDS)

    def query(self, device: int, number: int, data: str, name: str) -> codec.Reply:
        """Exchange a command that may be repeated without harm, a few times if need be."""
        for attempt in range(1, QUERY_ATTEMPTS + 1):
            try:
                return self.ask(device, number, data, name)
            except (TransportTimeoutError, GarbledReplyError) as error:
                if attempt == QUERY_ATTEMPTS:
                    raise
                _log.warning("%s: attempt %d of %r failed: %s", name, attempt, data, error)
        raise AssertionError("unreachable")

    def ask(self, device: int, number: int, data: str, name: str) -> codec.Reply:
        """Exchange a command once; an error carries the command and the axis."""
        try:
            message = self._exchange(device, number, data, name)
        except DriverError as error:
            error.about(axis=name, command=data or "(status)")
            raise
        if not message.accepted:
            advice = REFUSAL_ADVICE.get(message.data, "see the protocol manual")
            raise CommandRefusedError(data, message.data, name, advice)
        return message

    def broadcast(self, data: str) -> list[codec.Reply]:
        """Send a command to every device and return the replies, until nobody says any more."""
        message_id = next(self._message_ids)
        replies = []
        with self._transport.lock:
            self._transport.discard_input()
            self._transport.write(codec.encode_command(0, 0, message_id, data))
            for _ in range(FOREIGN_MESSAGES_TOLERATED):
                try:
                    line = self._transport.read_until(codec.TERMINATOR)
                except TransportTimeoutError:
                    break
                message = codec.decode_message(line)
                if isinstance(message, codec.Reply) and message.message_id == message_id:
                    replies.append(message)
        return replies

    def _exchange(self, device: int, number: int, data: str, name: str) -> codec.Reply:
        message_id = next(self._message_ids)
        checksum_required = device in self.checksummed
        with self._transport.lock:
            self._transport.discard_input()
            self._transport.write(codec.encode_command(device, number, message_id, data))
            started_s = self._clock.now_s()
            line = b""
            for _ in range(FOREIGN_MESSAGES_TOLERATED):
                line = self._transport.read_until(codec.TERMINATOR)
                message = codec.decode_message(line, checksum_required)
                if isinstance(message, codec.Reply) and (
                    message.device,
                    message.axis,
                    message.message_id,
                ) == (device, number, message_id):
                    return message
                _log.debug("%s: %r came in between", name, message)
                if self._clock.now_s() - started_s > EXCHANGE_LIMIT_S:
                    break
            raise GarbledReplyError(line, f"{name} never answered message {message_id}")


def find_devices(transport: Transport, clock: Clock = SYSTEM_CLOCK) -> list[ZaberDevice]:
    """Return the devices on a chain by address, an empty list when nobody answers; moves nothing.

    Raises `GarbledReplyError` for bytes that are not the protocol's, or two devices that share
    an address.
    """
    chain = _Chain(transport, clock)
    addresses = sorted(reply.device for reply in chain.broadcast(""))
    if len(set(addresses)) < len(addresses):
        listed = ", ".join(map(str, addresses))
        raise GarbledReplyError(b"", f"devices share an address ({listed}), renumber them")

    def setting(address: int, name: str) -> str:
        try:
            return chain.query(address, 0, f"get {name}", f"device {address}").data
        except CommandRefusedError:
            return ""

    found = []
    for address in addresses:
        count = setting(address, "system.axiscount")
        found.append(
            ZaberDevice(
                address=address,
                axis_count=int(count) if count.isdecimal() else 1,
                device_id=setting(address, "device.id"),
                serial_number=setting(address, "system.serial"),
                firmware=setting(address, "version"),
            )
        )
    return found

"""Zaber stages: named axes of the devices on one chain, over the ASCII protocol."""

import logging
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import Any

from emmc_rig.drivers import zaber_codec as codec
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import (
    AxisFaultError,
    CommandRefusedError,
    DriverError,
    EmergencyStopError,
    GarbledReplyError,
    LimitSwitchError,
    LostPositionError,
    ScaleError,
    StalledError,
    TransportTimeoutError,
)
from emmc_rig.drivers.stage import (
    DEFAULT_SETTINGS,
    HostStage,
    Reading,
    StageIdentity,
    StageSettings,
    check_tolerance,
)
from emmc_rig.drivers.transport import FOREIGN_MESSAGES_TOLERATED, Transport, repeated, turns

_log = logging.getLogger(__name__)

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
    "STATUSBUSY": "the axis is moving, stop the axis or wait",
    "PARKED": "it is parked, unpark it",
    "DRIVERDISABLED": "its motor driver is off, release the emergency stop and home it",
    "INACTIVE": "nothing is connected to this axis, check its cable",
    "REMOTE": "another program controls the device over its network port, close that",
}

SCALES_AGREE = 1e-3
"""Relative: data sheets round a microstep to at least that, and no two screws are so alike."""
SCALE_ADVICE = "write microstep_um (data sheet, Zaber Launcher) into the stage's YAML file"

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

    `microstep_um` is the length of a microstep, one for all axes or by name; what it does not
    state is looked up by the ids of device and peripheral. `resolution`: the device's setting
    `resolution` at which `microstep_um` holds. Construction asks every axis for its scale, limits
    and speed; it moves nothing. Raises `ScaleError` for an axis of unknown or contradicted scale,
    `TransportTimeoutError` for a silent device.
    Source: Zaber ASCII Protocol Manual (commands `home`, `move abs`, `stop`, `warnings`,
    `driver enable`; settings `pos`, `limit.min`, `limit.max`, `maxspeed`, `comm.checksum`,
    `limit.approach.maxspeed`, `resolution`, `deviceid`, `peripheralid`, `device.hw.modified`,
    `peripheral.hw.modified`).
    """

    def __init__(
        self,
        transport: Transport,
        axes: Mapping[str, tuple[int, int]],
        microstep_um: float | Mapping[str, float] | None = None,
        clock: Clock = SYSTEM_CLOCK,
        settings: StageSettings = DEFAULT_SETTINGS,
        resolution: int | Mapping[str, int] | None = None,
    ) -> None:
        super().__init__(axes, (transport,), clock, settings)
        self._chain = _Chain(transport, clock)
        self._addresses = dict(axes)
        self._stated_um = _by_axis(microstep_um, axes)
        self._stated_resolution = _by_axis(resolution, axes)
        for axis in (*self._stated_um, *self._stated_resolution):
            self._require_axis(axis)
        self._start_up()

    def _identity(self, axis: str) -> StageIdentity:
        device, _ = self._addresses[axis]
        settings = ("deviceid", "system.serial", "version")
        device_id, serial, firmware = (self._chain.text(device, name) for name in settings)
        known = codec.find_model(int(device_id or 0), self._optional(axis, "peripheralid"))
        model = f"device id {device_id}" if known is None else known.name
        return StageIdentity("Zaber", model, serial, firmware)

    def temperatures_c(self) -> dict[str, float]:
        """As `HostStage.temperatures_c`: of every controller on the chain that has a sensor."""
        found = {}
        for device in dict.fromkeys(device for device, _ in self._addresses.values()):
            text = self._chain.text(device, "system.temperature")
            if _NUMBER.fullmatch(text):
                found[f"device {device}"] = float(text)
        return found

    def _configure(self) -> None:
        self._chain.checksummed = frozenset()
        # Old firmware cannot put checksums on its replies.
        self._chain.checksummed = frozenset(
            device
            for device, _ in self._addresses.values()
            if self._chain.optional(device, 0, "set comm.checksum 1", f"device {device}")
        )
        axes = self._axes
        self._resolutions = {axis: self._optional(axis, "resolution") for axis in axes}
        self._microstep_um = {axis: self._scale_um(axis) for axis in axes}
        for axis in axes:
            check_tolerance(axis, self._settings.tolerance_um, self._microstep_um[axis])
        self._limits_um = {
            axis: (self._length_um(axis, "limit.min"), self._length_um(axis, "limit.max"))
            for axis in axes
        }
        self._move_speeds_um_s = {axis: self._speed_setting_um_s(axis, "maxspeed") for axis in axes}
        self._first_speeds_um_s = dict(self._move_speeds_um_s)
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
            command = (*self._addresses[axis], f"move abs {target}", axis)
            self._send_once((axis,), partial(self._chain.ask, *command))

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

    def _top_speed_um_s(self, axis: str) -> float:
        """Return what the firmware can step; a motor without steps: the speed it came with."""
        resolution = self._resolutions[axis]
        if resolution is None:
            return self._first_speeds_um_s[axis]
        return codec.FULL_STEPS_PER_S * resolution * self._microstep_um[axis]

    def _readings_are_checked(self, axis: str) -> bool:
        return self._addresses[axis][0] in self._chain.checksummed

    def _scale_um(self, axis: str) -> float:
        """Return the length of a microstep, from the device or stated; both must agree."""
        resolution = self._resolutions[axis]
        stated_um = self._stated_um.get(axis)
        wanted = self._stated_resolution.get(axis)
        if wanted is not None and wanted != resolution:
            raise ScaleError(
                axis,
                f"its microstep was stated for resolution {wanted}, but it has {resolution}",
                f"send it `set resolution {wanted}`, or state microstep_um and resolution anew",
            )
        device_id = self._optional(axis, "deviceid", whole_device=True)
        peripheral_id = self._optional(axis, "peripheralid")
        model = codec.find_model(device_id or 0, peripheral_id)
        identity = f"device id {device_id}, peripheral id {peripheral_id or 'none'}"
        if self._is_modified(axis, peripheral_id):
            model, identity = None, f"{identity}, modified hardware"
        if model is not None and model.microstep_um is None:
            raise ScaleError(axis, f"it is {model.name} ({identity})", "wire a linear axis")
        identity = f"{identity}, resolution {resolution}"
        if model is None or model.microstep_um is None or not resolution:
            if stated_um is None:
                what = f"the length of its microstep is unknown ({identity})"
                raise ScaleError(axis, what, SCALE_ADVICE)
            return stated_um
        known_um = model.microstep_um * codec.DEFAULT_RESOLUTION / resolution
        if stated_um is not None and abs(stated_um / known_um - 1) > SCALES_AGREE:
            raise ScaleError(
                axis,
                f"a microstep of {stated_um:g} um was stated, but this {model.name} ({identity}) "
                f"has {known_um:g} um",
                "correct microstep_um, or leave it out",
            )
        return known_um

    def _is_modified(self, axis: str, peripheral_id: int | None) -> bool:
        """Return whether the maker fitted other mechanics than the ids state."""
        if peripheral_id:
            return self._optional(axis, "peripheral.hw.modified") == 1
        return self._optional(axis, "device.hw.modified", whole_device=True) == 1

    def _optional(self, axis: str, setting: str, whole_device: bool = False) -> int | None:
        """Return a setting that not every device has; None where it says so."""
        device, number = self._addresses[axis]
        number = 0 if whole_device else number
        reply = self._chain.optional(device, number, f"get {setting}", axis)
        return None if reply is None else int(self._number(axis, reply))

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
        """Return the speed of homing; firmware without a setting for it homes at move speed."""
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

    def _query(self, axis: str, data: str) -> codec.Reply:
        device, number = self._addresses[axis]
        return self._chain.query(device, number, data, axis)


def _by_axis(value: Any, axes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a value for every axis, for those that a mapping names, or for none."""
    if value is None:
        return {}
    return dict(value) if isinstance(value, Mapping) else dict.fromkeys(axes, value)


class _Chain:
    """Commands to the devices on one port, with their replies."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self.checksummed: frozenset[int] = frozenset()
        self._transport = transport
        self._clock = clock
        self._message_ids = cycle(codec.MESSAGE_IDS)

    def query(self, device: int, number: int, data: str, name: str) -> codec.Reply:
        """Exchange a command that may be repeated without harm, a few times if need be."""
        return repeated(lambda: self.ask(device, number, data, name), f"{data!r} to {name}")

    def text(self, device: int, setting: str) -> str:
        """Return a setting of a device, "" where it has none of that name."""
        reply = self.optional(device, 0, f"get {setting}", f"device {device}")
        return "" if reply is None else reply.data

    def optional(self, device: int, number: int, data: str, name: str) -> codec.Reply | None:
        """As `query`; None where the device refuses the command."""
        try:
            return self.query(device, number, data, name)
        except CommandRefusedError:
            return None

    def ask(self, device: int, number: int, data: str, name: str) -> codec.Reply:
        """Exchange a command once; an error carries the command and the axis."""
        place = device, number, next(self._message_ids)
        try:
            with self._transport.lock:
                self._transport.discard_input()
                self._transport.write(codec.encode_command(*place, data))
                line = b""
                for _ in turns(self._clock):
                    line = self._transport.read_until(codec.TERMINATOR)
                    message = codec.decode_message(line, device in self.checksummed)
                    if message and (message.device, message.axis, message.message_id) == place:
                        break
                    _log.debug("%s: %r came in between", name, message)
                else:
                    raise GarbledReplyError(line, f"{name} never answered message {place[2]}")
        except DriverError as error:
            error.about(axis=name, command=data or "(status)")
            raise
        if not message.accepted:
            advice = REFUSAL_ADVICE.get(message.data, "see the protocol manual")
            raise CommandRefusedError(data, message.data, name, advice)
        return message

    def broadcast(self, data: str) -> list[codec.Reply]:
        """Send a command to every device and return the replies, until none comes any more."""
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
                if message is not None and message.message_id == message_id:
                    replies.append(message)
        return replies


def find_devices(transport: Transport, clock: Clock = SYSTEM_CLOCK) -> list[ZaberDevice]:
    """Return the devices on a chain by address, an empty list where none answers; moves nothing.

    Raises `GarbledReplyError` for bytes that are not the protocol's, or two devices that share
    an address.
    """
    chain = _Chain(transport, clock)
    addresses = sorted(reply.device for reply in chain.broadcast(""))
    if len(set(addresses)) < len(addresses):
        listed = ", ".join(map(str, addresses))
        raise GarbledReplyError(b"", f"devices share an address ({listed}), renumber them")

    found = []
    for address in addresses:
        count = chain.text(address, "system.axiscount")
        found.append(
            ZaberDevice(
                address=address,
                axis_count=int(count) if count.isdecimal() else 1,
                device_id=chain.text(address, "device.id"),
                serial_number=chain.text(address, "system.serial"),
                firmware=chain.text(address, "version"),
            )
        )
    return found

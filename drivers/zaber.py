"""Zaber stages: named axes of the devices on one chain, over the ASCII protocol."""

import logging
from collections.abc import Mapping
from itertools import cycle

from drivers import zaber_codec as codec
from drivers.clock import SYSTEM_CLOCK, Clock
from drivers.errors import (
    AxisFaultError,
    CommandRefusedError,
    GarbledReplyError,
    StalledError,
    TransportTimeoutError,
)
from drivers.stage import DEFAULT_SETTINGS, HostStage, StageSettings
from drivers.transport import Transport

_log = logging.getLogger(__name__)

QUERY_ATTEMPTS = 3
FOREIGN_MESSAGES_TOLERATED = 64
REFERENCE_FLAGS = {"WR", "WH"}
REFUSAL_ADVICE = {
    "BADDATA": "the value is out of range, check units and limits",
    "BADCOMMAND": "this device does not know the command, check its model and firmware",
    "BADAXIS": "the device has no such axis, check the axis numbers",
    "STATUSBUSY": "it is moving, stop it or wait",
    "PARKED": "it is parked, unpark it",
    "DRIVERDISABLED": "its motor driver is off, release the emergency stop and enable it",
}


class ZaberStage(HostStage):
    """Axes of one chain, `axes` mapping names to (device address, axis number).

    `microstep_um` is the length of a microstep, one for all axes or by name. Construction asks
    every axis for its limits and speed, so that a missing one shows at once; it moves nothing.
    Raises `TransportTimeoutError` for a device that does not answer.
    Source: Zaber ASCII Protocol Manual (commands `home`, `move abs`, `stop`, `warnings`; settings
    `pos`, `limit.min`, `limit.max`, `maxspeed`, `comm.checksum`).
    """

    def __init__(
        self,
        transport: Transport,
        axes: Mapping[str, tuple[int, int]],
        microstep_um: float | Mapping[str, float],
        clock: Clock = SYSTEM_CLOCK,
        settings: StageSettings = DEFAULT_SETTINGS,
    ) -> None:
        super().__init__(axes, clock, settings)
        self._transport = transport
        self._addresses = dict(axes)
        if isinstance(microstep_um, Mapping):
            self._microstep_um = dict(microstep_um)
        else:
            self._microstep_um = dict.fromkeys(axes, microstep_um)
        for axis in axes:
            if settings.tolerance_um < self._microstep_um[axis] / 2:
                raise ValueError(
                    f"tolerance_um {settings.tolerance_um:g} is finer than half a microstep of "
                    f"{axis} ({self._microstep_um[axis]:g} um): loosen it"
                )
        self._message_ids = cycle(codec.MESSAGE_IDS)
        self._checksummed: frozenset[int] = frozenset()
        self._checksummed = frozenset(
            device for device, _ in self._addresses.values() if self._enable_checksum(device)
        )
        self._limits_um = {
            axis: (self._length_um(axis, "limit.min"), self._length_um(axis, "limit.max"))
            for axis in axes
        }
        self._speeds_um_s = {
            axis: self._length_um(axis, "maxspeed") / codec.SPEED_SCALE for axis in axes
        }

    def is_homed(self, axis: str) -> bool:
        """Return whether the axis was homed since it was powered up."""
        self._require_axis(axis)
        flags = self._query(axis, "warnings").data.split()[1:]
        return REFERENCE_FLAGS.isdisjoint(flags)

    def position_um(self, axis: str) -> float:
        """Return where the axis reads to be, in whole microsteps."""
        self._require_axis(axis)
        return self._length_um(axis, "pos")

    def _start_home(self, axis: str) -> None:
        self._query(axis, "warnings clear")
        self._exchange(axis, "home")

    def _start_move(self, axis: str, target_um: float) -> None:
        self._exchange(axis, f"move abs {round(target_um / self._microstep_um[axis])}")

    def _stop_axis(self, axis: str) -> None:
        self._query(axis, "stop")

    def _is_moving(self, axis: str) -> bool:
        reply = self._query(axis, "")
        if reply.flag == "FS":
            raise StalledError(axis)
        if reply.flag.startswith("F"):
            meaning = codec.FLAG_MEANINGS.get(reply.flag, "see the protocol manual")
            raise AxisFaultError(axis, f"{reply.flag} ({meaning})")
        return reply.busy

    def _travel_um(self, axis: str) -> tuple[float, float]:
        return self._limits_um[axis]

    def _speed_um_s(self, axis: str) -> float:
        return self._speeds_um_s[axis]

    def _length_um(self, axis: str, setting: str) -> float:
        return self._number(axis, setting) * self._microstep_um[axis]

    def _number(self, axis: str, setting: str) -> float:
        reply = self._query(axis, f"get {setting}")
        try:
            return float(reply.data)
        except ValueError as error:
            raise GarbledReplyError(
                reply.data.encode("ascii"), f"{setting} of {axis} is not a number"
            ) from error

    def _enable_checksum(self, device: int) -> bool:
        """Return whether the device will put a checksum on its replies; old firmware cannot."""
        try:
            self._retried(device, 0, "set comm.checksum 1", f"device {device}")
        except CommandRefusedError:
            return False
        return True

    def _query(self, axis: str, data: str) -> codec.Reply:
        device, number = self._addresses[axis]
        return self._retried(device, number, data, axis)

    def _retried(self, device: int, number: int, data: str, name: str) -> codec.Reply:
        """Exchange a command that may be repeated without harm, a few times if need be."""
        for attempt in range(1, QUERY_ATTEMPTS + 1):
            try:
                return self._ask(device, number, data, name)
            except (TransportTimeoutError, GarbledReplyError) as error:
                if attempt == QUERY_ATTEMPTS:
                    raise
                _log.warning("%s: attempt %d of %r failed: %s", name, attempt, data, error)
        raise AssertionError("unreachable")

    def _exchange(self, axis: str, data: str) -> codec.Reply:
        device, number = self._addresses[axis]
        return self._ask(device, number, data, axis)

    def _ask(self, device: int, number: int, data: str, name: str) -> codec.Reply:
        message_id = next(self._message_ids)
        checksum_required = device in self._checksummed
        with self._transport.lock:
            self._transport.discard_input()
            self._transport.write(codec.encode_command(device, number, message_id, data))
            for _ in range(FOREIGN_MESSAGES_TOLERATED):
                line = self._transport.read_until(codec.TERMINATOR)
                message = codec.decode_message(line, checksum_required)
                if not isinstance(message, codec.Reply):
                    _log.debug("%s: %r came in between", name, message)
                    continue
                if (message.device, message.axis, message.message_id) == (
                    device,
                    number,
                    message_id,
                ):
                    break
            else:
                raise GarbledReplyError(line, f"{name} never answered message {message_id}")
        if not message.accepted:
            advice = REFUSAL_ADVICE.get(message.data, "see the protocol manual")
            raise CommandRefusedError(data, message.data, name, advice)
        return message

"""Thorlabs APT stages: one axis for each controller channel (KDC101, TDC001 and their kin)."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from emmc_rig.drivers import apt_codec as codec
from emmc_rig.drivers.apt_codec import Id, Message, StatusBit
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.errors import (
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

HOMING_START_S = 1.0
"""A controller that has not begun to home by then did not get the command."""
FAULTS_BY_BIT: Mapping[StatusBit, tuple[type[AxisFaultError], str]] = {
    StatusBit.MOTION_ERROR: (StalledError, "the position lags behind, the motor is blocked"),
    StatusBit.CURRENT_LIMIT: (StalledError, "the motor draws too much current"),
    StatusBit.INTERLOCK: (EmergencyStopError, "the interlock is open"),
    StatusBit.ENCODER_FAULT: (LostPositionError, "the encoder fails"),
    StatusBit.OVER_TEMPERATURE: (AxisFaultError, "the controller is too hot"),
}


@dataclass(frozen=True)
class Actuator:
    """A motor with its encoder: counts for each micrometre, travel from home, fastest speed."""

    counts_per_um: float
    travel_um: float
    top_speed_um_s: float


ACTUATORS = {
    "z806": Actuator(34.304, 6_000.0, 2_600.0),
    "z812": Actuator(34.304, 12_000.0, 2_600.0),
    "z825": Actuator(34.304, 25_000.0, 2_600.0),
    "mts25-z8": Actuator(34.304, 25_000.0, 2_400.0),
    "mts50-z8": Actuator(34.304, 50_000.0, 2_400.0),
    "z825b": Actuator(34.55496, 25_000.0, 2_600.0),
}
"""By stage: counts per millimetre from "Scaling parameters" of the protocol document, travel and
maximum velocity from the data sheets. No controller reports the model of its stage."""


@dataclass(frozen=True)
class AptAxis:
    """A motor channel: serial port, address on the port, and actuator.

    `destination` is 0x50 for a unit on USB, 0x21 upwards for the bays of a rack.
    """

    transport: Transport
    actuator: Actuator
    destination: int = codec.USB_UNIT
    channel: int = 1


class AptStage(HostStage):
    """Axes of one or more controllers, `axes` mapping names to channels.

    The controller's own backlash correction is switched off: the approach from below is the
    host's. Construction enables the channels and moves nothing. Raises `TransportTimeoutError`
    for a controller that does not answer.
    Source: APT Communications Protocol, "Motor control messages": MOVE_HOME, MOVE_ABSOLUTE,
    MOVE_STOP, SET/REQ_VELPARAMS, REQ_HOMEPARAMS, SET_GENMOVEPARAMS, REQ_DCSTATUSUPDATE.
    """

    def __init__(
        self,
        axes: Mapping[str, AptAxis],
        clock: Clock = SYSTEM_CLOCK,
        settings: StageSettings = DEFAULT_SETTINGS,
    ) -> None:
        super().__init__(axes, (wiring.transport for wiring in axes.values()), clock, settings)
        transports = dict.fromkeys(wiring.transport for wiring in axes.values())
        links = {transport: _Link(transport, clock) for transport in transports}
        self._channels = {axis: _Channel(axis, wiring, links) for axis, wiring in axes.items()}
        for axis, channel in self._channels.items():
            check_tolerance(axis, settings.tolerance_um, 1 / channel.actuator.counts_per_um)
        self._homing_since_s: dict[str, float] = {}
        self._start_up()

    def _identity(self, axis: str) -> StageIdentity:
        reply = self._channels[axis].query(Id.HW_REQ_INFO, Id.HW_GET_INFO, with_channel=False)
        info = codec.decode_info(reply)
        return StageIdentity("Thorlabs", info.model, str(info.serial_number), info.firmware)

    def _configure(self) -> None:
        self._homing_since_s.clear()
        self._velocities: dict[str, codec.VelocityParameters] = {}
        for axis, channel in self._channels.items():
            channel.send(Id.HW_NO_FLASH_PROGRAMMING)
            channel.send(Id.HW_STOP_UPDATEMSGS)
            # Once nothing comes any more, the next byte begins a message.
            channel.link.transport.discard_until_quiet()
            channel.send(Id.MOD_SET_CHANENABLESTATE, channel.number, codec.ENABLE)
            no_backlash = codec.encode_position(channel.number, 0)
            channel.send(Id.MOT_SET_GENMOVEPARAMS, data=no_backlash)
            self._read_velocity(axis)
            home = channel.query(Id.MOT_REQ_HOMEPARAMS, Id.MOT_GET_HOMEPARAMS)
            self._home_speeds_um_s[axis] = self._um_s(axis, codec.decode_home(home)[0])

    def _read(self, axis: str) -> Reading:
        status = self._status(axis)
        position_um = status.position / self._channels[axis].actuator.counts_per_um
        return Reading(
            position_um, bool(status.bits & StatusBit.HOMED), bool(status.bits & codec.MOVING)
        )

    def _start_home(self, axes: tuple[str, ...]) -> None:
        """Enable the channels, which clears an error of position, and home them."""
        for axis in axes:
            channel = self._channels[axis]
            channel.send(Id.MOD_SET_CHANENABLESTATE, channel.number, codec.ENABLE)
            channel.link.forget(Id.MOT_MOVE_HOMED, channel)
            self._homing_since_s[axis] = self._clock.now_s()
            channel.send(Id.MOT_MOVE_HOME, channel.number)

    def _is_homing(self, axis: str) -> bool:
        """Return whether homing goes on; the bit "homed" may be left from before it began."""
        channel = self._channels[axis]
        status = self._status_without_fault(axis)
        if status.bits & StatusBit.HOMING:
            self._homing_since_s[axis] = -math.inf
            return True
        began = self._homing_since_s[axis] == -math.inf
        if began or channel.link.heard(Id.MOT_MOVE_HOMED, channel):
            return bool(status.bits & codec.MOVING)
        if self._clock.now_s() - self._homing_since_s[axis] < HOMING_START_S:
            return True
        raise LostPositionError(axis, "homing never began").about(command=Id.MOT_MOVE_HOME.name)

    def _start_moves(self, targets_um: Mapping[str, float], start_um: Mapping[str, float]) -> None:
        for axis, target_um in targets_um.items():
            channel = self._channels[axis]
            target = round(target_um * channel.actuator.counts_per_um)
            channel.link.take_complaint()
            channel.send(Id.MOT_MOVE_ABSOLUTE, data=codec.encode_position(channel.number, target))

    def _stop_axis(self, axis: str) -> None:
        channel = self._channels[axis]
        channel.send(Id.MOT_MOVE_STOP, channel.number, codec.STOP_PROFILED)

    def _is_moving(self, axis: str) -> bool:
        status = self._status_without_fault(axis)
        complaint = self._channels[axis].link.take_complaint()
        if complaint is not None:
            number = complaint.message_id
            command = next((i.name for i in Id if i == number), f"message {number:#06x}")
            reply = f"{complaint.code} ({complaint.notes})"
            advice = "see the controller's display and the limits"
            raise CommandRefusedError(command, reply, axis, advice)
        return bool(status.bits & codec.MOVING)

    def _why_short(self, axis: str) -> DriverError | None:
        if self._status(axis).bits & codec.LIMIT_SWITCHES:
            return LimitSwitchError(axis)
        return None

    def _travel_um(self, axis: str) -> tuple[float, float]:
        return 0.0, self._channels[axis].actuator.travel_um

    def _apply_speed(self, axis: str, speed_um_s: float) -> None:
        channel = self._channels[axis]
        old = self._velocities[axis]
        counts_per_um = channel.actuator.counts_per_um
        wanted = max(1, round(codec.velocity_units(speed_um_s, counts_per_um)))
        new = codec.VelocityParameters(channel.number, 0, old.acceleration, wanted)
        channel.send(Id.MOT_SET_VELPARAMS, data=codec.encode_velocity(new))
        self._read_velocity(axis)
        if self._velocities[axis].maximum != wanted:
            reply = f"{self._velocities[axis].maximum} instead of {wanted}"
            advice = "choose a speed that the controller allows"
            raise CommandRefusedError(Id.MOT_SET_VELPARAMS.name, reply, axis, advice)

    def _top_speed_um_s(self, axis: str) -> float:
        return self._channels[axis].actuator.top_speed_um_s

    def _read_velocity(self, axis: str) -> None:
        answer = self._channels[axis].query(Id.MOT_REQ_VELPARAMS, Id.MOT_GET_VELPARAMS)
        self._velocities[axis] = codec.decode_velocity(answer)
        self._move_speeds_um_s[axis] = self._um_s(axis, self._velocities[axis].maximum)

    def _um_s(self, axis: str, units: int) -> float:
        speed_um_s = units / codec.velocity_units(1.0, self._channels[axis].actuator.counts_per_um)
        if not speed_um_s > 0:
            raise GarbledReplyError(b"", f"a speed of {units}").about(axis=axis)
        return speed_um_s

    def _status(self, axis: str) -> codec.MotorStatus:
        return codec.decode_status(
            self._channels[axis].query(Id.MOT_REQ_DCSTATUSUPDATE, Id.MOT_GET_DCSTATUSUPDATE)
        )

    def _status_without_fault(self, axis: str) -> codec.MotorStatus:
        """Return the status; a fault counts when two in a row show it, for nothing checks them."""
        if _fault(axis, status := self._status(axis)) is None:
            return status
        if fault := _fault(axis, status := self._status(axis)):
            raise fault
        return status


class _Link:
    """Messages on one port; unexpected messages are kept until they are requested."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self.transport = transport
        self._clock = clock
        self._heard: set[tuple[int, int, int]] = set()
        self._complaint: codec.Complaint | None = None

    def send(self, raw: bytes) -> None:
        """Send a message that has no answer."""
        with self.transport.lock:
            self._take_waiting()
            self.transport.write(raw)

    def heard(self, message_id: Id, channel: "_Channel") -> bool:
        """Return whether this message came from the channel since it was last forgotten."""
        return any(
            key[0] == message_id and key[1] in channel.sources and key[2] in (0, channel.number)
            for key in self._heard
        )

    def forget(self, message_id: Id, channel: "_Channel") -> None:
        """Forget that this message came."""
        self._heard = {
            key for key in self._heard if not (key[0] == message_id and key[1] in channel.sources)
        }

    def take_complaint(self) -> codec.Complaint | None:
        """Return what the controller complained about, once."""
        complaint, self._complaint = self._complaint, None
        return complaint

    def exchange(
        self, raw: bytes, answer: Id, channel: "_Channel", channel_matters: bool
    ) -> Message:
        """Send a question once and return its answer."""
        with self.transport.lock:
            self._take_waiting()
            self.transport.write(raw)
            for _ in turns(self._clock):
                message = self._read_message()
                if message.id == answer and channel.sent(message, channel_matters):
                    return message
            raise GarbledReplyError(b"", f"no {answer.name} among what came")

    def _take_waiting(self) -> None:
        for _ in range(FOREIGN_MESSAGES_TOLERATED):
            if self.transport.waiting() < codec.HEADER_SIZE:
                break
            try:
                self._read_message()
            except (TransportTimeoutError, GarbledReplyError) as error:
                _log.warning("dropped: %s", error)
                self.transport.discard_until_quiet()

    def _read_message(self) -> Message:
        header = self.transport.read_exactly(codec.HEADER_SIZE)
        length = codec.data_length(header)
        message = codec.decode(header + (self.transport.read_exactly(length) if length else b""))
        if message.id in (Id.HW_RESPONSE, Id.HW_RICHRESPONSE):
            self._complaint = codec.decode_complaint(message)
            _log.warning("complaint: %s", self._complaint)
        elif message.data is None:
            for source in (message.source, message.destination):
                self._heard.add((message.id, source, message.param1))
        return message


class _Channel:
    """One motor channel and its address on a link."""

    def __init__(self, name: str, axis: AptAxis, links: Mapping[Transport, _Link]) -> None:
        self.name = name
        self.actuator = axis.actuator
        self.number = axis.channel
        self.link = links[axis.transport]
        self.sources = (axis.destination, 0)
        self._destination = axis.destination

    def send(
        self, message_id: Id, param1: int = 0, param2: int = 0, data: bytes | None = None
    ) -> None:
        """Send a message that has no answer; an error carries the command and the axis."""
        try:
            self.link.send(codec.encode(message_id, self._destination, param1, param2, data))
        except DriverError as error:
            error.about(axis=self.name, command=message_id.name)
            raise

    def query(self, question: Id, answer: Id, with_channel: bool = True) -> Message:
        """Send a question and return its answer; an error carries the command and the axis."""
        raw = codec.encode(question, self._destination, self.number if with_channel else 0)
        link = self.link
        try:
            return repeated(
                partial(link.exchange, raw, answer, self, with_channel),
                answer.name,
                link.transport.discard_until_quiet,
            )
        except DriverError as error:
            error.about(axis=self.name, command=question.name)
            raise

    def sent(self, message: Message, channel_matters: bool) -> bool:
        """Return whether a message with data comes from this channel.

        Some TDC001 name destination and source the wrong way round, others 0.
        """
        if message.source not in self.sources and message.destination not in self.sources:
            return False
        if not channel_matters:
            return True
        return (
            message.data is not None and int.from_bytes(message.data[:2], "little") == self.number
        )


def identify(transport: Transport, clock: Clock = SYSTEM_CLOCK) -> codec.HardwareInfo:
    """Return what the APT controller on a port says of itself; moves nothing.

    Raises `TransportTimeoutError` or `GarbledReplyError` when none is there.
    """
    anything = AptAxis(transport, next(iter(ACTUATORS.values())))
    channel = _Channel("the controller", anything, {transport: _Link(transport, clock)})
    return codec.decode_info(channel.query(Id.HW_REQ_INFO, Id.HW_GET_INFO, with_channel=False))


def _fault(axis: str, status: codec.MotorStatus) -> AxisFaultError | None:
    reply = f"status {status.bits:#010x}"
    for bit, (fault, meaning) in FAULTS_BY_BIT.items():
        if status.bits & bit:
            return fault(axis, meaning).about(reply=reply)
    if not status.bits & StatusBit.ENABLED:
        return AxisFaultError(axis, "the channel is switched off", "home it").about(reply=reply)
    return None

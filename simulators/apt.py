"""Firmware of a Thorlabs APT controller (KDC101, or a rack of bays): binary messages in and out.

Simplified: a new move starts from where the axis is, at rest; homing is one move onto the switch
at the lower end and one up by the offset, where the counter is zero; parameters are not kept over
a power cycle. A controller takes the bits "A" for downwards, as KDC101 do. A message that is not
modelled (jogs, PID, soft limits, ...) is passed over, as real controllers do, and logged.
Source of the messages: Thorlabs, "APT Controllers Host-Controller Communications Protocol".
"""

import logging
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Self

from emmc_rig.drivers import apt_codec as codec
from emmc_rig.drivers.apt_codec import Id, Message, StatusBit
from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import GarbledReplyError
from emmc_rig.simulators.firmware import SimulatedController, earliest_s
from emmc_rig.simulators.motion import AxisSpec, End, Motor

COUNTS_PER_UM = 34.304
Z825 = AxisSpec(
    travel_um=25_600.0,
    microstep_um=1 / COUNTS_PER_UM,
    max_speed_um_s=2_300.0,
    acceleration_um_s2=4_000.0,
    start_um=3_210.0,
    backlash_um=3.0,
)
HOME_OFFSET_UM = 300.0
HOME_SPEED_UM_S = 1_000.0
HOME_VELOCITY = round(codec.velocity_units(HOME_SPEED_UM_S, COUNTS_PER_UM))
UPDATE_EVERY_S = 0.1
UPDATES_WITHOUT_ACKNOWLEDGEMENT = 50
MODEL = b"KDC101\0\0"
SERIAL_NUMBER = 27_000_001
FIRMWARE = (3, 0, 2, 0)
OUT_OF_RANGE = 8
"""Code of a complaint about a target; the document leaves the numbers to the server's help."""

_log = logging.getLogger(__name__)


@dataclass
class _Bay:
    """One motor channel."""

    motor: Motor
    maximum: int
    acceleration: int
    backlash: int = 0
    enabled: bool = True
    homed: bool = False
    homing: str = ""
    motion_error: bool = False


class AptController(SimulatedController):
    """One controller; `bays` maps addresses (0x50 for a unit on USB) to what each drives.

    Faults as `SimulatedController`'s, and `motor_unplugged`: the motor's cable comes loose at
    the next message. `swapped` mixes up destination and source, as some TDC001 do.
    """

    def __init__(
        self,
        clock: Clock,
        bays: Mapping[int, AxisSpec] | None = None,
        swapped: bool = False,
    ) -> None:
        super().__init__(clock, ("motor_unplugged",))
        self.swapped = swapped
        specs = bays or {codec.USB_UNIT: Z825}
        self._start({address: Motor(spec, clock) for address, spec in specs.items()})

    def position_um(self, address: int = codec.USB_UNIT) -> float:
        """Return where the axis really is: um above its home position."""
        with self._lock:
            self._advance()
            return self._bays[address].motor.nut_um - HOME_OFFSET_UM

    def power_cycle(self) -> None:
        """Switch off and on: the axes stay in place and lose their reference."""
        with self._lock:
            self._start({address: bay.motor.restarted() for address, bay in self._bays.items()})

    def _start(self, motors: Mapping[int, Motor]) -> None:
        """Come up with the parameters of the factory."""
        self._bays = {
            address: _Bay(
                motor,
                maximum=round(codec.velocity_units(motor.spec.max_speed_um_s, COUNTS_PER_UM)),
                acceleration=round(
                    codec.acceleration_units(motor.spec.acceleration_um_s2, COUNTS_PER_UM)
                ),
            )
            for address, motor in motors.items()
        }
        self._motor_unplugged = False
        self._unread = bytearray()
        self._updates_s: float | None = None
        self._updates_left = 0

    def _receive(self, data: bytes) -> None:
        self._unread += data
        while len(self._unread) >= codec.HEADER_SIZE:
            try:
                length = codec.data_length(bytes(self._unread[: codec.HEADER_SIZE]))
            except GarbledReplyError:
                del self._unread[0]
                continue
            if len(self._unread) < codec.HEADER_SIZE + length:
                return
            raw = bytes(self._unread[: codec.HEADER_SIZE + length])
            del self._unread[: codec.HEADER_SIZE + length]
            self._take(raw)

    def _take(self, raw: bytes) -> None:
        self._advance()
        if self._dropped(raw):
            return
        self._motor_unplugged |= self.faults.strikes("motor_unplugged", raw)
        message = codec.decode(raw)
        for address in self._meant(message.destination):
            bay = self._bays[address]
            if answer := self._answers.get(message.id):
                self._say(address, Id(message.id + 1), data=answer(self, bay))
            elif handle := self._handlers.get(message.id):
                handle(self, address, bay, message)
            else:
                _log.warning("not modelled, passed over: message %#06x", message.id)

    def _meant(self, destination: int) -> list[int]:
        """Return the bays that a message is for; one unit alone answers to every address."""
        if destination in self._bays:
            return [destination]
        return list(self._bays) if len(self._bays) == 1 or destination == codec.RACK else []

    def _advance(self) -> None:
        for address, bay in self._bays.items():
            while (end := bay.motor.advance()) is not None:
                self._end_move(address, bay, end)
        self._update()

    def _next_event_s(self) -> float | None:
        ends_s = [bay.motor.ends_s for bay in self._bays.values()]
        return earliest_s([*ends_s, self._updates_s])

    def _end_move(self, address: int, bay: _Bay, end: End) -> None:
        if end is End.STALLED:
            bay.motion_error, bay.enabled, bay.homing = True, False, ""
        elif bay.homing == "seeking" and end is End.ARRIVED:
            bay.homing = "leaving"
            bay.motor.count_from_here(-HOME_OFFSET_UM)
            bay.motor.go(0.0, HOME_SPEED_UM_S, self._acceleration_um_s2(bay))
        elif bay.homing == "leaving":
            bay.homing, bay.homed = "", True
            self._say(address, Id.MOT_MOVE_HOMED, 1)
        elif end is End.BRAKED:
            bay.homing = ""
            self._say_status(address, bay, Id.MOT_MOVE_STOPPED)
        else:
            self._say_status(address, bay, Id.MOT_MOVE_COMPLETED)

    def _update(self) -> None:
        """Send the status that was subscribed to, as long as the client acknowledges it."""
        now_s = self._clock.now_s()
        while self._updates_s is not None and self._updates_s <= now_s:
            if self._updates_left == 0:
                self._updates_s = None
                return
            self._updates_left -= 1
            self._updates_s += UPDATE_EVERY_S
            for address, bay in self._bays.items():
                self._say_status(address, bay, Id.MOT_GET_DCSTATUSUPDATE)

    def _status(self, bay: _Bay) -> codec.MotorStatus:
        bits = StatusBit.POWER_OK
        velocity_um_s = bay.motor.velocity_um_s()
        if bay.motor.moving:
            bits |= StatusBit.MOVING_A if velocity_um_s < 0 else StatusBit.MOVING_B
        at = bay.motor.true_um
        if at <= 0:
            bits |= StatusBit.LIMIT_SWITCH_A
        if at >= bay.motor.spec.travel_um:
            bits |= StatusBit.LIMIT_SWITCH_B
        for condition, bit in (
            (not self._motor_unplugged, StatusBit.CONNECTED),
            (bay.homing != "", StatusBit.HOMING),
            (bay.homed, StatusBit.HOMED),
            (not bay.motor.moving, StatusBit.SETTLED),
            (bay.motion_error, StatusBit.MOTION_ERROR),
            (bay.enabled, StatusBit.ENABLED),
        ):
            bits |= bit if condition else StatusBit(0)
        velocity = round(velocity_um_s / 1e3 * 2.048)
        return codec.MotorStatus(1, self._counts(bay), velocity, int(bits))

    def _counts(self, bay: _Bay) -> int:
        return round(bay.motor.counted_um * COUNTS_PER_UM)

    def _acceleration_um_s2(self, bay: _Bay) -> float:
        return bay.acceleration / codec.acceleration_units(1.0, COUNTS_PER_UM)

    def _say(
        self, address: int, message_id: Id, param1: int = 0, param2: int = 0, data=None
    ) -> None:
        destination, source = (address, codec.HOST) if self.swapped else (codec.HOST, address)
        self._send(codec.encode(message_id, destination, param1, param2, data, source))

    def _say_status(self, address: int, bay: _Bay, message_id: Id) -> None:
        self._say(address, message_id, data=codec.encode_status(self._status(bay)))

    def _complain(self, address: int, message_id: int, notes: str) -> None:
        text = notes.encode("ascii").ljust(64, b"\0")
        data = struct.pack("<HH64s", message_id, OUT_OF_RANGE, text)
        self._say(address, Id.HW_RICHRESPONSE, data=data)

    def _go(self, address: int, bay: _Bay, target: int, message_id: int) -> None:
        if not bay.enabled or self._motor_unplugged:
            self._complain(address, message_id, "channel disabled or motor not connected")
            return
        bay.homing = ""
        bay.motor.go(
            target / COUNTS_PER_UM,
            bay.maximum / codec.velocity_units(1.0, COUNTS_PER_UM),
            self._acceleration_um_s2(bay),
            self._stalls(bay.motor),
            self._start_s(),
        )

    def _start_updates(self, address: int, bay: _Bay, message: Message) -> None:
        self._updates_s = self._clock.now_s() + UPDATE_EVERY_S
        self._updates_left = UPDATES_WITHOUT_ACKNOWLEDGEMENT

    def _stop_updates(self, address: int, bay: _Bay, message: Message) -> None:
        self._updates_s = None

    def _acknowledge(self, address: int, bay: _Bay, message: Message) -> None:
        self._updates_left = UPDATES_WITHOUT_ACKNOWLEDGEMENT

    def _enable(self, address: int, bay: _Bay, message: Message) -> None:
        bay.enabled = message.param2 == codec.ENABLE
        if bay.enabled:
            bay.motion_error = False

    def _set_velocity(self, address: int, bay: _Bay, message: Message) -> None:
        parameters = codec.decode_velocity(message)
        bay.maximum = max(1, parameters.maximum)
        bay.acceleration = max(1, parameters.acceleration)

    def _pass_over(self, address: int, bay: _Bay, message: Message) -> None:
        """Take a message that changes nothing here."""

    def _set_backlash(self, address: int, bay: _Bay, message: Message) -> None:
        (_, bay.backlash) = struct.unpack("<Hi", message.data or b"\0" * 6)

    def _home(self, address: int, bay: _Bay, message: Message) -> None:
        if not bay.enabled or self._motor_unplugged:
            self._complain(address, message.id, "channel disabled or motor not connected")
            return
        bay.homed, bay.homing = False, "seeking"
        pace = HOME_SPEED_UM_S, self._acceleration_um_s2(bay)
        if self.faults.strikes("stall", self._command):
            bay.motor.go(bay.motor.counted_um / 2, *pace, stalls=True)
        else:
            bay.motor.seek(0.0, *pace)

    def _move(self, address: int, bay: _Bay, message: Message) -> None:
        if message.data is not None and len(message.data) == 6:
            self._go(address, bay, struct.unpack("<Hi", message.data)[1], message.id)

    def _stop(self, address: int, bay: _Bay, message: Message) -> None:
        if bay.motor.ends_s is None:
            self._say_status(address, bay, Id.MOT_MOVE_STOPPED)
        elif message.param2 == codec.STOP_PROFILED:
            bay.motor.brake(self._acceleration_um_s2(bay))
        else:
            bay.motor.halt()
            bay.homing = ""
            self._say_status(address, bay, Id.MOT_MOVE_STOPPED)

    _answers: Mapping[int, Callable[[Self, _Bay], bytes]] = {
        Id.HW_REQ_INFO: lambda self, bay: struct.pack(
            "<I8sH4B60sHHH", SERIAL_NUMBER, MODEL, 16, *FIRMWARE, b"", 1, 0, len(self._bays)
        ),
        Id.MOT_REQ_VELPARAMS: lambda self, bay: codec.encode_velocity(
            codec.VelocityParameters(1, 0, bay.acceleration, bay.maximum)
        ),
        Id.MOT_REQ_GENMOVEPARAMS: lambda self, bay: codec.encode_position(1, bay.backlash),
        Id.MOT_REQ_HOMEPARAMS: lambda self, bay: struct.pack(
            "<HHHii", 1, 2, 1, HOME_VELOCITY, round(HOME_OFFSET_UM * COUNTS_PER_UM)
        ),
        Id.MOT_REQ_DCSTATUSUPDATE: lambda self, bay: codec.encode_status(self._status(bay)),
    }
    """Data of the answer to a request; the answer's id is the next number after the request's."""

    _handlers: Mapping[int, Callable[..., None]] = {
        Id.HW_START_UPDATEMSGS: _start_updates,
        Id.HW_STOP_UPDATEMSGS: _stop_updates,
        Id.MOT_ACK_DCSTATUSUPDATE: _acknowledge,
        Id.MOD_SET_CHANENABLESTATE: _enable,
        Id.MOT_SET_VELPARAMS: _set_velocity,
        Id.HW_NO_FLASH_PROGRAMMING: _pass_over,
        Id.MOT_SET_GENMOVEPARAMS: _set_backlash,
        Id.MOT_MOVE_HOME: _home,
        Id.MOT_MOVE_ABSOLUTE: _move,
        Id.MOT_MOVE_STOP: _stop,
    }

"""Thorlabs APT wire format: pure functions between values and bytes.

A message is six bytes, `<HBBBB`: id, two parameters, destination, source. With data it is
`<HHBB`: id, length of the data, destination | 0x80, source, and then the data. All numbers are
little endian; there is no checksum and no message number.
Source: Thorlabs, "APT Controllers Host-Controller Communications Protocol": "Format of messages",
"Generic system control messages", "Motor control messages".
"""

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from emmc_rig.drivers.errors import GarbledReplyError

HEADER_SIZE = 6
LONGEST_DATA = 255
"""No message of the protocol has more data than this."""
HIGHEST_ID = 0x0FFF
HAS_DATA = 0x80
HOST, RACK, FIRST_BAY, USB_UNIT = 0x01, 0x11, 0x21, 0x50
PLACES = (0x00, HOST, RACK, *range(FIRST_BAY, FIRST_BAY + 10), USB_UNIT)
"""Who can send: the host, the rack's own board, its bays, a unit on USB; 0 by some units."""

VELOCITY_TIME_S = 2048 / 6e6
"""The sampling interval T of TDC001 and KDC101, by which speeds are scaled."""


class Id(IntEnum):
    """Message ids that the driver or the simulator use."""

    HW_REQ_INFO = 0x0005
    HW_GET_INFO = 0x0006
    HW_START_UPDATEMSGS = 0x0011
    HW_STOP_UPDATEMSGS = 0x0012
    HW_NO_FLASH_PROGRAMMING = 0x0018
    HW_RESPONSE = 0x0080
    HW_RICHRESPONSE = 0x0081
    MOD_SET_CHANENABLESTATE = 0x0210
    MOT_SET_VELPARAMS = 0x0413
    MOT_REQ_VELPARAMS = 0x0414
    MOT_GET_VELPARAMS = 0x0415
    MOT_SET_GENMOVEPARAMS = 0x043A
    MOT_REQ_GENMOVEPARAMS = 0x043B
    MOT_GET_GENMOVEPARAMS = 0x043C
    MOT_REQ_HOMEPARAMS = 0x0441
    MOT_GET_HOMEPARAMS = 0x0442
    MOT_MOVE_HOME = 0x0443
    MOT_MOVE_HOMED = 0x0444
    MOT_MOVE_ABSOLUTE = 0x0453
    MOT_MOVE_COMPLETED = 0x0464
    MOT_MOVE_STOP = 0x0465
    MOT_MOVE_STOPPED = 0x0466
    MOT_REQ_DCSTATUSUPDATE = 0x0490
    MOT_GET_DCSTATUSUPDATE = 0x0491
    MOT_ACK_DCSTATUSUPDATE = 0x0492


class StatusBit(IntFlag):
    """Bits of a motor's status; which way is forward differs between controllers."""

    LIMIT_SWITCH_A = 1 << 0
    LIMIT_SWITCH_B = 1 << 1
    MOVING_A = 1 << 4
    MOVING_B = 1 << 5
    JOGGING_A = 1 << 6
    JOGGING_B = 1 << 7
    CONNECTED = 1 << 8
    HOMING = 1 << 9
    HOMED = 1 << 10
    TRACKING = 1 << 12
    SETTLED = 1 << 13
    MOTION_ERROR = 1 << 14
    INTERLOCK = 1 << 16
    OVER_TEMPERATURE = 1 << 17
    CURRENT_LIMIT = 1 << 24
    ENCODER_FAULT = 1 << 25
    OVER_CURRENT = 1 << 26
    POWER_OK = 1 << 28
    ENABLED = 1 << 31


MOVING = (
    StatusBit.MOVING_A
    | StatusBit.MOVING_B
    | StatusBit.JOGGING_A
    | StatusBit.JOGGING_B
    | StatusBit.HOMING
)
LIMIT_SWITCHES = StatusBit.LIMIT_SWITCH_A | StatusBit.LIMIT_SWITCH_B

STOP_PROFILED = 2
ENABLE, DISABLE = 1, 2


@dataclass(frozen=True)
class Message:
    """One message; `data` is None for a message of six bytes."""

    id: int
    param1: int
    param2: int
    destination: int
    source: int
    data: bytes | None = None


@dataclass(frozen=True)
class MotorStatus:
    """Data of DCSTATUSUPDATE, and of the messages that end a move."""

    channel: int
    position: int
    velocity: int
    bits: int


@dataclass(frozen=True)
class VelocityParameters:
    """Data of VELPARAMS, in the controller's units."""

    channel: int
    minimum: int
    acceleration: int
    maximum: int


@dataclass(frozen=True)
class HardwareInfo:
    """Data of HW_GET_INFO."""

    serial_number: int
    model: str
    firmware: str
    channels: int


@dataclass(frozen=True)
class Complaint:
    """Data of HW_RICHRESPONSE: what went wrong, in words."""

    message_id: int
    code: int
    notes: str


_STATUS = struct.Struct("<HihHI")
_VELOCITY = struct.Struct("<Hiii")
_HOME = struct.Struct("<HHHii")
_POSITION = struct.Struct("<Hi")
_INFO = struct.Struct("<I8sH4B60sHHH")
_COMPLAINT = struct.Struct("<HH64s")


def encode(
    message_id: int,
    destination: int,
    param1: int = 0,
    param2: int = 0,
    data: bytes | None = None,
    source: int = HOST,
) -> bytes:
    """Return the bytes of a message, with data or with two parameters.

    Raises `ValueError` for a number that the format cannot carry.
    """
    try:
        if data is None:
            return struct.pack("<HBBBB", message_id, param1, param2, destination, source)
        if len(data) > LONGEST_DATA:
            raise ValueError(f"{len(data)} bytes of data are more than {LONGEST_DATA}")
        return struct.pack("<HHBB", message_id, len(data), destination | HAS_DATA, source) + data
    except struct.error as error:
        raise ValueError(f"no APT message can carry that: {error}") from error


def data_length(header: bytes) -> int:
    """Return how many bytes of data follow these first six.

    Raises `GarbledReplyError` where they cannot begin a message to the host.
    """
    message_id, length, destination, source = struct.unpack("<HHBB", header)
    if not 0 < message_id <= HIGHEST_ID:
        raise GarbledReplyError(header, f"no message has the id {message_id:#06x}")
    if destination & ~HAS_DATA not in PLACES or source not in PLACES:
        raise GarbledReplyError(header, "no device has that address")
    if not destination & HAS_DATA:
        return 0
    if length > LONGEST_DATA:
        raise GarbledReplyError(header, f"{length} bytes of data")
    return length


def decode(raw: bytes) -> Message:
    """Return the message in exactly these bytes; raises `GarbledReplyError`."""
    if len(raw) < HEADER_SIZE:
        raise GarbledReplyError(raw, "shorter than a header")
    length = data_length(raw[:HEADER_SIZE])
    if len(raw) != HEADER_SIZE + length:
        raise GarbledReplyError(raw, f"{len(raw) - HEADER_SIZE} bytes of data, not {length}")
    message_id, param1, param2, destination, source = struct.unpack("<HBBBB", raw[:HEADER_SIZE])
    if destination & HAS_DATA:
        return Message(message_id, 0, 0, destination & ~HAS_DATA, source, raw[HEADER_SIZE:])
    return Message(message_id, param1, param2, destination, source)


def decode_status(message: Message) -> MotorStatus:
    """Return the motor's status; raises `GarbledReplyError`."""
    channel, position, velocity, _, bits = _unpack(message, _STATUS)
    return MotorStatus(channel, position, velocity, bits)


def decode_velocity(message: Message) -> VelocityParameters:
    """Return the velocity parameters; raises `GarbledReplyError`."""
    return VelocityParameters(*_unpack(message, _VELOCITY))


def decode_home(message: Message) -> tuple[int, int]:
    """Return velocity and offset of homing in its units; raises `GarbledReplyError`."""
    *_, velocity, offset = _unpack(message, _HOME)
    return velocity, offset


def decode_info(message: Message) -> HardwareInfo:
    """Return what the controller says of itself; raises `GarbledReplyError`."""
    serial_number, model, _, *firmware, _, _, _, channels = _unpack(message, _INFO)
    version = ".".join(str(part) for part in reversed(firmware[:3]))
    return HardwareInfo(serial_number, _text(model), version, channels)


def decode_complaint(message: Message) -> Complaint:
    """Return what the controller complains about; raises `GarbledReplyError`."""
    if message.data is None:
        return Complaint(0, message.param1, "a fault without a description")
    message_id, code, notes = _unpack(message, _COMPLAINT)
    return Complaint(message_id, code, _text(notes))


def encode_status(status: MotorStatus) -> bytes:
    """Return the data of a status."""
    return _STATUS.pack(status.channel, status.position, status.velocity, 0, status.bits)


def encode_velocity(parameters: VelocityParameters) -> bytes:
    """Return the data of VELPARAMS; raises `ValueError` for what it cannot carry."""
    values = (parameters.channel, parameters.minimum, parameters.acceleration, parameters.maximum)
    return _pack(_VELOCITY, *values)


def encode_position(channel: int, position: int) -> bytes:
    """Return the data of a move or of a distance; raises `ValueError` for what it cannot carry."""
    return _pack(_POSITION, channel, position)


def velocity_units(um_s: float, counts_per_um: float) -> float:
    """Return a speed in the controller's units: counts x T x 65536 (APT, "velocity")."""
    return um_s * counts_per_um * VELOCITY_TIME_S * 65536


def acceleration_units(um_s2: float, counts_per_um: float) -> float:
    """Return an acceleration in the controller's units: counts x T^2 x 65536."""
    return um_s2 * counts_per_um * VELOCITY_TIME_S**2 * 65536


def _unpack(message: Message, layout: struct.Struct) -> tuple:
    if message.data is None or len(message.data) != layout.size:
        got = "none" if message.data is None else len(message.data)
        raise GarbledReplyError(
            message.data or b"", f"{layout.size} bytes of data expected, {got} came"
        )
    return layout.unpack(message.data)


def _pack(layout: struct.Struct, *values: int) -> bytes:
    try:
        return layout.pack(*values)
    except struct.error as error:
        raise ValueError(f"no APT message can carry {values}: {error}") from error


def _text(raw: bytes) -> str:
    text = raw.split(b"\0")[0].decode("ascii", "replace")
    return "".join(c if c.isprintable() else "?" for c in text).strip()

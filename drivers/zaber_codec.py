"""Zaber ASCII wire format, pure functions between values and bytes; and the models' microsteps.

Source: Zaber ASCII Protocol Manual, "Message Format" (commands `/`, replies `@`, alerts `!`,
information `#`), "Message Checksums" and "Warning Flags".

Only models with a public source are known. Zaber Launcher and the data sheets state the microsteps
of other models. A rotary stage is listed to be named in the refusal.
"""

import re
from dataclasses import dataclass

from emmc_rig.drivers.errors import GarbledReplyError

TERMINATOR = b"\n"
MESSAGE_IDS = range(1, 100)
SPEED_SCALE = 1.6384
"""Speed settings count microsteps per second times this."""

FLAG_MEANINGS = {
    "FF": "critical system error",
    "FN": "peripheral not supported",
    "FZ": "peripheral inactive",
    "FH": "emergency stop, motor driver off",
    "FV": "supply voltage out of range, motor driver off",
    "FO": "motor driver off",
    "FC": "inrush current error",
    "FM": "motor too hot",
    "FD": "motor driver off",
    "FQ": "encoder error",
    "FI": "index error",
    "FA": "analog encoder not in step",
    "FR": "overdrive limit exceeded",
    "FS": "stalled and stopped",
    "FB": "stream left its bounds",
    "FP": "strayed from its path",
    "FE": "limit error",
    "FT": "twisted too far",
    "WL": "limit sensor triggered unexpectedly",
    "WV": "supply voltage out of range",
    "WT": "controller hot",
    "WS": "stalled and recovered",
    "WM": "displaced while it stood still",
    "WP": "calibration of the wrong type",
    "WR": "no reference position",
    "WH": "not homed",
    "NC": "its knob is being turned",
    "NI": "movement interrupted",
}
"""Warning flags, the most severe first: a reply shows the first one that is raised."""
NO_FLAG = "--"

_LINE = re.compile(rb"([@!#])([^\r\n]*?)(?::([0-9A-Fa-f]{2}))?\r?\n")
_REPLY = re.compile(r"(\d{2}) (\d) (?:(\d{2}) )?(OK|RJ) (BUSY|IDLE) (\S{2}) (.*)")


@dataclass(frozen=True)
class Reply:
    """An answer to a command; `flag` is the most severe warning flag, or "--"."""

    device: int
    axis: int
    message_id: int | None
    accepted: bool
    busy: bool
    flag: str
    data: str


def lrc(body: bytes) -> int:
    """Return the checksum of `body`: the two's complement of the sum of its bytes, 0 to 255."""
    return -sum(body) & 0xFF


def encode_command(device: int, axis: int, message_id: int, data: str = "") -> bytes:
    """Return the command's bytes, checksum and line end included; no data polls the status.

    Raises `ValueError` for a number that the format cannot carry, or data that would break it.
    """
    if not 0 <= device <= 99:
        raise ValueError(f"device address {device} is not within 0 to 99")
    if not 0 <= axis <= 9:
        raise ValueError(f"axis number {axis} is not within 0 to 9")
    if message_id not in MESSAGE_IDS:
        raise ValueError(f"message id {message_id} is not within 1 to 99")
    if not (data.isascii() and data.isprintable()) or ":" in data or "/" in data:
        raise ValueError(f"command {data!r} is not plain printable text without ':' and '/'")
    body = f"{device} {axis} {message_id:02d} {data}".rstrip().encode("ascii")
    return b"/%b:%02X\n" % (body, lrc(body))


def decode_message(line: bytes, checksum_required: bool = False) -> Reply | None:
    """Return the reply in one line, its line end included; None for an alert or information.

    A checksum that is there must be right; one that is missing is an error only when
    `checksum_required`. Raises `GarbledReplyError`.
    """
    match = _LINE.fullmatch(line)
    if match is None:
        raise GarbledReplyError(line, "not a Zaber message")
    kind, body, checksum = match.groups()
    if checksum is None and checksum_required:
        raise GarbledReplyError(line, "the checksum is missing")
    if checksum is not None and int(checksum, 16) != lrc(body):
        raise GarbledReplyError(line, "the checksum is wrong", on_the_line=True)
    if not body.isascii():
        raise GarbledReplyError(line, "not plain text")
    if kind != b"@":
        return None
    reply = _REPLY.fullmatch(body.decode("ascii"))
    if reply is None:
        raise GarbledReplyError(line, "not a reply")
    device, axis, message_id, outcome, status, flag, data = reply.groups()
    return Reply(
        device=int(device),
        axis=int(axis),
        message_id=None if message_id is None else int(message_id),
        accepted=outcome == "OK",
        busy=status == "BUSY",
        flag=flag,
        data=data,
    )


DEFAULT_RESOLUTION = 64
"""Microsteps of a full step, as all Zaber steppers are shipped and as data sheets count them."""
FULL_STEPS_PER_S = 10_000.0
"""Fastest: `maxspeed` and `move vel` end at resolution times 16384, in 1.6384 microsteps a second
(ASCII Protocol Manual, "move vel")."""


@dataclass(frozen=True)
class Model:
    """A model of axis: `microstep_um` at `DEFAULT_RESOLUTION`, None for a rotary axis."""

    name: str
    microstep_um: float | None


DEVICES = {
    50081: Model("X-LHM", 0.1240234375),
    50105: Model("X-LSQ150A", 0.09921875),
}
"""By `deviceid`, of devices with their motor built in.

50081: motorZaberMotion (github.com/zabertech), tests' `devices/xlhm.py`, is an X-LHM; its screw is
that of 43211. 50105: thz-auto-vis (github.com/PTE-TTK-Programming-Projects), `zaberwindow.cpp`,
has its microstep and 150 mm; the same microstep (10078.74 a millimetre) is published for the
X-LSQ150A elsewhere.
"""
PERIPHERALS = {
    43211: Model("LHM", 0.1240234375),
    46657: Model("a rotary stage", None),
}
"""By `peripheralid`, of motors on a separate controller.

motorZaberMotion, tests' `devices/xmcc4.py` and `mock_helpers.py`: 8062.992126 microsteps a
millimetre and 6400 a degree.
"""


def find_model(device_id: int, peripheral_id: int | None) -> Model | None:
    """Return the model behind an axis; a controller's motor is its peripheral (0: none)."""
    if peripheral_id:
        return PERIPHERALS.get(peripheral_id)
    return DEVICES.get(device_id)

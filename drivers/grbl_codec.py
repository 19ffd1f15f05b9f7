"""Grbl 1.1 wire format: pure functions between values and bytes.

Source: Grbl v1.1 documentation, "Interface" (response, push and status messages), "Commands"
(`$` commands), "Jogging" and "Realtime commands"; codes from its tables of errors and alarms.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from emmc_rig.drivers.errors import FirmwareError, GarbledReplyError

TERMINATOR = b"\n"
LINE_LENGTH = 80
"""Longest line that Grbl takes, its end included."""

STATUS_QUERY = b"?"
FEED_HOLD = b"!"
SOFT_RESET = b"\x18"
JOG_CANCEL = b"\x85"

STATES = ("Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep")
AXIS_LETTERS = "XYZABC"
MM_PER_INCH = 25.4
REPORT_BEGINS = b"<"
"""A status report, of Grbl and of firmware derived from it."""
NEWER_FIRMWARE = "install Grbl 1.1 or grblHAL on it"

SOFT_LIMITS, HARD_LIMITS, HOMING, HOMING_DIRECTIONS = 20, 21, 22, 23
HOMING_FEED, HOMING_SEEK, HOMING_DEBOUNCE, HOMING_PULL_OFF = 24, 25, 26, 27
REPORT_MASK, REPORT_INCHES = 10, 13
STEPS_PER_MM, MAX_RATE, ACCELERATION, TRAVEL = 100, 110, 120, 130
"""Numbers of settings; the last four count from here, one for each axis."""
REPORTS_MACHINE_POSITION = 1
"""Bit of `REPORT_MASK`: MPos instead of WPos."""

ERRORS = {
    1: "a word without its letter",
    2: "a number that is none",
    3: "an unknown $ command",
    4: "a negative value",
    5: "homing is off ($22=0)",
    8: "not allowed unless it stands idle",
    9: "locked until it is homed or unlocked",
    10: "soft limits need homing",
    11: "the line is too long",
    12: "faster than it can step",
    13: "the safety door is open",
    15: "the jog leaves the machine's travel",
    16: "not a jog command",
    20: "an unsupported command",
    22: "the feed rate is missing",
}
ALARMS = {
    1: "hard limit reached, position lost",
    2: "the target leaves the machine's travel, position kept",
    3: "reset while moving, position lost",
    4: "probe in the wrong state",
    5: "probe made no contact",
    6: "homing was reset",
    7: "safety door opened while homing",
    8: "homing did not clear the limit switch",
    9: "homing did not find the limit switch",
}

_STATUS = re.compile(r"<([A-Z][a-z]+)(?::(\d+))?((?:\|[A-Za-z]+:[^|<>]*)+)>")
_NUMBER = re.compile(r"-?\d{1,9}(\.\d{1,6})?")
_OLD_STATUS = re.compile(r"<[A-Z][a-z]+,[MW]Pos:.*>")


@dataclass(frozen=True)
class Ok:
    """The line was accepted; a motion that it started may go on."""


@dataclass(frozen=True)
class Refusal:
    """The line was not carried out."""

    code: int

    @property
    def meaning(self) -> str:
        """What the code stands for."""
        return ERRORS.get(self.code, "see the table of errors")


@dataclass(frozen=True)
class Alarm:
    """Grbl stopped everything and waits to be homed or unlocked."""

    code: int

    @property
    def meaning(self) -> str:
        """What the code stands for."""
        return ALARMS.get(self.code, "see the table of alarms")


@dataclass(frozen=True)
class Banner:
    """Grbl has started, or was reset."""

    version: str


@dataclass(frozen=True)
class Setting:
    """One line of the answer to `$$`; text: a number in most, grblHAL has names and addresses."""

    number: int
    text: str

    @property
    def value(self) -> float:
        """The number, without the remark that some firmware writes behind it.

        Raises `GarbledReplyError`.
        """
        return _number(f"${self.number}={self.text}".encode(), self.text.partition(" (")[0])


@dataclass(frozen=True)
class Feedback:
    """A line in brackets: `[kind:text]`."""

    kind: str
    text: str


@dataclass(frozen=True)
class Status:
    """A status report; positions in the unit that `$13` says, None where the report has none.

    pressed: letters of the axes whose limit switch is pressed. Grbl has one input for both ends of
    an axis: the letter does not say which end.
    """

    state: str
    substate: int | None
    machine: tuple[float, ...] | None
    work: tuple[float, ...] | None
    offset: tuple[float, ...] | None
    pressed: tuple[str, ...] = ()


Message = Ok | Refusal | Alarm | Banner | Setting | Feedback | Status

_MESSAGES: tuple[tuple[re.Pattern, Callable[[re.Match], Message | None]], ...] = (
    (re.compile(r"ok"), lambda found: Ok()),
    (re.compile(r"error:(\d{1,3})"), lambda found: Refusal(int(found[1]))),
    (re.compile(r"ALARM:(\d{1,3})"), lambda found: Alarm(int(found[1]))),
    (re.compile(r"(?:Grbl|GrblHAL) (\d+\.\d+\S*) \[.*\]"), lambda found: Banner(found[1])),
    (re.compile(r"\$(\d{1,4})=(.*)"), lambda found: Setting(int(found[1]), found[2].strip())),
    (re.compile(r"\[([A-Za-z0-9]+):(.*)\]"), lambda found: Feedback(found[1], found[2])),
    (re.compile(r"|(?:>|\$N).*"), lambda found: None),
)
"""Patterns of the lines of all messages but the status, each with its reader.

The last is an empty line, or a startup line that Grbl lists or ran at boot.
"""


def encode_line(text: str) -> bytes:
    """Return the line's bytes, line end included.

    Raises `ValueError` for text that Grbl would not read as one line.
    """
    if not (text.isascii() and text.isprintable()) or any(c in text for c in "?!~"):
        raise ValueError(f"line {text!r} is not plain printable text without '?', '!' and '~'")
    if len(text) >= LINE_LENGTH:
        raise ValueError(f"line {text!r} is longer than {LINE_LENGTH - 1} characters")
    return text.encode("ascii") + b"\n"


def jog(targets_mm: Mapping[str, float], feed_mm_min: float) -> str:
    """Return the line that moves axes, by letter, to machine coordinates in a straight line.

    A jog leaves the parser's modes alone, is refused (error:15) instead of alarmed when it leaves
    the travel, and can be cancelled without losing the position ("Jogging").
    """
    words = "".join(f"{letter}{target:.4f}" for letter, target in targets_mm.items())
    return f"$J=G53G90G21{words}F{feed_mm_min:.3f}"


def decode_line(line: bytes) -> Message | None:
    """Return the message in one line, its line end included.

    None for an empty line, and for a startup line that Grbl ran at boot. Raises
    `GarbledReplyError`, and `FirmwareError` for a report of Grbl 0.9 or older.
    """
    if not line.endswith(b"\n") or b"\n" in line[:-1]:
        raise GarbledReplyError(line, "not one line")
    if not line.isascii():
        raise GarbledReplyError(line, "not plain text")
    text = line.decode("ascii").rstrip("\r\n").lstrip("\r")
    if not text.isprintable():
        raise GarbledReplyError(line, "not printable text")
    if text.startswith("<"):
        return _decode_status(line, text)
    for pattern, message in _MESSAGES:
        if found := pattern.fullmatch(text):
            return message(found)
    raise GarbledReplyError(line, "not a Grbl message")


def _decode_status(line: bytes, text: str) -> Status:
    if _OLD_STATUS.fullmatch(text):
        raise FirmwareError(f"a Grbl older than 1.1 answers ({text})", NEWER_FIRMWARE)
    match = _STATUS.fullmatch(text)
    if match is None or match[1] not in STATES:
        raise GarbledReplyError(line, "not a status report")
    fields = match[3].split("|")[1:]
    values = dict(field.split(":", 1) for field in fields)
    if len(values) < len(fields):
        raise GarbledReplyError(line, "a field appears twice")
    machine, work, offset = (
        tuple(_number(line, word) for word in values[name].split(",")) if name in values else None
        for name in ("MPos", "WPos", "WCO")
    )
    if machine is None and work is None:
        raise GarbledReplyError(line, "neither MPos nor WPos")
    if machine is None and offset is not None and len(offset) != len(work or ()):
        raise GarbledReplyError(line, "offset and position of different length")
    return Status(
        state=match[1],
        substate=None if match[2] is None else int(match[2]),
        machine=machine,
        work=work,
        offset=offset,
        pressed=tuple(letter for letter in values.get("Pn", "") if letter in AXIS_LETTERS),
    )


def _number(line: bytes, word: str) -> float:
    if not _NUMBER.fullmatch(word):
        raise GarbledReplyError(line, f"{word!r} is not a number")
    return float(word)

"""The example's wire format: pure functions between values and bytes.

A command is `NUMBER VERB [VALUE]*SUM`, a reply `NUMBER WORD POSITION SPEED STATE*SUM`, each ended
by a line feed; SUM is the exclusive or of the bytes before the star, two hexadecimal digits.
Positions are steps of 0.1 um, speeds steps a second.
"""

from functools import reduce
from operator import xor
from typing import NamedTuple

from emmc_rig.drivers.errors import GarbledReplyError

STEP_UM = 0.1
END = b"\n"
STATES = ("lost", "idle", "moving", "stalled")


class Status(NamedTuple):
    """What every reply says; `accepted`: whether the command was carried out."""

    number: int
    accepted: bool
    steps: int
    speed: int
    state: str


def seal(body: str) -> bytes:
    """Return a line with its sum."""
    raw = body.encode("ascii")
    return raw + b"*%02X" % reduce(xor, raw, 0) + END


def unseal(line: bytes) -> list[str]:
    """Return a line's words; raises `GarbledReplyError` unless its sum is right."""
    raw, _, total = line.removesuffix(END).rpartition(b"*")
    if total != b"%02X" % reduce(xor, raw, 0):
        raise GarbledReplyError(line, "its sum is wrong")
    return raw.decode("ascii", "replace").split()


def decode_status(line: bytes) -> Status:
    """Return what a reply says; raises `GarbledReplyError`."""
    words = unseal(line)
    try:
        number, word, steps, speed, state = words
        status = Status(int(number), word == "ok", int(steps), int(speed), state)
    except ValueError as error:
        raise GarbledReplyError(line, "no status") from error
    if word not in ("ok", "no") or state not in STATES:
        raise GarbledReplyError(line, "no status")
    return status

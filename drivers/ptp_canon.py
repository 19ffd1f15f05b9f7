"""Canon EOS over PTP: remote mode, its own release, events that are asked for, settings in codes.

Source: libgphoto2 2.5 (`camlibs/ptp2`: ptp.h, ptp-pack.c, library.c), which is the public record
of what these cameras do; not a document of Canon's.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from enum import IntEnum
from typing import TYPE_CHECKING

from drivers.errors import CameraFormatError, CaptureError
from drivers.ptp_codec import DeviceInfo, EventCode, Kind, Message
from drivers.ptp_dials import CodedDial, Dial

if TYPE_CHECKING:
    from drivers.ptp import PtpSession

EVENT_POLL_S = 0.05
HALF, FULL = 1, 2
"""Stages of the shutter button."""
TO_HOST = 4
"""As capture destination: pictures go to the computer, not onto the card."""


class EosOperation(IntEnum):
    """Operations of EOS cameras."""

    REMOTE_RELEASE = 0x910F
    SET_PROPERTY = 0x9110
    SET_REMOTE_MODE = 0x9114
    SET_EVENT_MODE = 0x9115
    GET_EVENT = 0x9116
    RELEASE_ON = 0x9128
    RELEASE_OFF = 0x9129


class EosEvent(IntEnum):
    """Records that GetEvent gives; their first field is an object or a property."""

    OBJECT_ADDED = 0xC181
    OBJECT_ADDED_64 = 0xC1A7
    PROPERTY_CHANGED = 0xC189
    CHOICES_CHANGED = 0xC18A


class EosProperty(IntEnum):
    """Properties of EOS cameras."""

    SHUTTER = 0xD102
    ISO = 0xD103
    CAPTURE_DESTINATION = 0xD11C


RELEASE_RESULTS = {
    1: ("it could not focus", "switch the lens to manual focus"),
    7: ("its card is full", "make room on the card"),
}
RECORD = struct.Struct("<II")
FRACTIONS = {0: 0.0, 3: 1 / 3, 4: 1 / 2, 5: 2 / 3}
"""Of a stop, by the last three bits of a code; other codes are automatic, bulb and the like."""


def shutter_s(code: int) -> float | None:
    """Return the exposure that a code means: 0x38 is 1 s, 8 more is half of it."""
    if not 0x10 <= code <= 0xA8 or code % 8 not in FRACTIONS:
        return None
    return 2.0 ** (7 - code // 8 - FRACTIONS[code % 8])


def iso(code: int) -> float | None:
    """Return the sensitivity that a code means: 0x48 is ISO 100, 8 more is twice it."""
    if not 0x28 <= code <= 0xB0 or code % 8 not in FRACTIONS:
        return None
    return 100 * 2.0 ** (code // 8 - 9 + FRACTIONS[code % 8])


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and payload of what GetEvent gave, up to its end; raises `CameraFormatError`."""
    at = 0
    while at + RECORD.size <= len(data):
        size, kind = RECORD.unpack_from(data, at)
        if size == RECORD.size and kind == 0:
            return
        if size < RECORD.size or at + size > len(data):
            raise CameraFormatError(data[at : at + RECORD.size], "a record of events runs over")
        yield kind, data[at + RECORD.size : at + size]
        at += size


def is_eos(info: DeviceInfo) -> bool:
    """Whether the camera is one of these: by its maker, and by what it says that it can do."""
    can = set(info.operations)
    modes = {EosOperation.SET_REMOTE_MODE, EosOperation.SET_EVENT_MODE, EosOperation.GET_EVENT}
    releases = {EosOperation.REMOTE_RELEASE, EosOperation.RELEASE_ON}
    return "canon" in info.maker.lower() and modes <= can and bool(releases & can)


class EosBody:
    """A `drivers.ptp_dials.Body`; construction switches remote mode and events on."""

    on_card = True

    def __init__(self, session: PtpSession) -> None:
        self._session = session
        self._unread: deque[Message] = deque()
        self._values: dict[int, int] = {}
        self._codes: dict[int, tuple[int, ...]] = {}
        session.request(EosOperation.SET_REMOTE_MODE, 1)
        session.request(EosOperation.SET_EVENT_MODE, 1)
        self._ask()
        destination = EosProperty.CAPTURE_DESTINATION
        cards = [one for one in self._codes.get(destination, ()) if one != TO_HOST]
        if cards and self._values.get(destination) == TO_HOST:
            self._write(destination, cards[0])
        self.exposure: Dial = self._dial(EosProperty.SHUTTER, shutter_s)
        self.iso: Dial = self._dial(EosProperty.ISO, iso)

    def release(self) -> None:
        """Release the shutter; raises `CaptureError` where the camera says why it did not."""
        session = self._session
        if session.can(EosOperation.RELEASE_ON):
            try:
                session.request(EosOperation.RELEASE_ON, HALF, 0)
                session.request(EosOperation.RELEASE_ON, FULL, 0)
            finally:
                session.request(EosOperation.RELEASE_OFF, FULL)
                session.request(EosOperation.RELEASE_OFF, HALF)
            return
        result = session.request(EosOperation.REMOTE_RELEASE)
        if result and result[0]:
            reason, advice = RELEASE_RESULTS.get(
                result[0], (f"it gave reason {result[0]:#x}", "look at its display")
            )
            raise CaptureError(f"the shutter was not released: {reason}", advice)

    def event(self, timeout_s: float) -> Message | None:
        """Return the next event; the camera is asked every `EVENT_POLL_S`."""
        clock = self._session.clock
        deadline_s = clock.now_s() + timeout_s
        while not self._unread:
            self._ask()
            if not self._unread:
                left_s = deadline_s - clock.now_s()
                if left_s <= 0:
                    return None
                clock.sleep(min(EVENT_POLL_S, left_s))
        return self._unread.popleft()

    def _dial(self, code: int, meaning) -> CodedDial:
        return CodedDial(
            meaning,
            lambda: self._values.get(code),
            lambda: self._codes.get(code, ()),
            lambda value: self._write(code, value),
        )

    def _write(self, code: int, value: int) -> None:
        data = struct.pack("<III", 12, code, value)
        self._session.request(EosOperation.SET_PROPERTY, data=data)
        self._ask()

    def _ask(self) -> None:
        """Read the camera's pending events: settings are kept, new objects become events."""
        data = self._session.fetch(EosOperation.GET_EVENT)
        for kind, payload in records(data):
            if len(payload) < 4:
                continue
            (subject,) = struct.unpack_from("<I", payload)
            if kind in (EosEvent.OBJECT_ADDED, EosEvent.OBJECT_ADDED_64):
                self._unread.append(Message(Kind.EVENT, EventCode.OBJECT_ADDED, 0, (subject,)))
            elif kind == EosEvent.PROPERTY_CHANGED and len(payload) >= 8:
                (self._values[subject],) = struct.unpack_from("<I", payload, 4)
            elif kind == EosEvent.CHOICES_CHANGED and len(payload) >= 12:
                (count,) = struct.unpack_from("<I", payload, 8)
                if count <= (len(payload) - 12) // 4:
                    self._codes[subject] = struct.unpack_from(f"<{count}I", payload, 12)

"""Sony Alpha over PTP: the handshake, the two stages of its shutter button, the picture in memory.

Exposure and sensitivity are set on the camera itself, or through libgphoto2 (`drivers.gphoto`):
how they are written differs between generations. Source: libgphoto2 2.5 (`camlibs/ptp2`: ptp.h,
ptp.c, library.c).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING

from drivers.ptp_codec import DeviceInfo, EventCode, Message
from drivers.ptp_dials import Dial, NoDial

if TYPE_CHECKING:
    from drivers.ptp import PtpSession

PRESS_S = 0.2
"""From the first to the second stage of the button, and until it is let go."""
IN_MEMORY = 0xFFFFC001
"""Handle of the picture just taken, until it was fetched."""
UP, DOWN = 1, 2
VERSION = 0xC8


class SonyOperation(IntEnum):
    """Operations of Sony cameras."""

    CONNECT = 0x9201
    GET_EXTENSION = 0x9202
    CONTROL = 0x9207


class SonyButton(IntEnum):
    """Controls: the shutter button half and all the way down."""

    HALF = 0xD2C1
    FULL = 0xD2C2


OBJECT_ADDED = 0xC201


def is_sony(info: DeviceInfo) -> bool:
    """Whether the camera is one of these: by its maker, and by what it says that it can do."""
    return "sony" in info.maker.lower() and set(SonyOperation) <= set(info.operations)


class SonyBody:
    """A `drivers.ptp_dials.Body`; construction makes the handshake of three phases."""

    on_card = False

    def __init__(self, session: PtpSession) -> None:
        self._session = session
        self.exposure: Dial = NoDial()
        self.iso: Dial = NoDial()
        for phase in (1, 2):
            session.fetch(SonyOperation.CONNECT, phase, 0, 0)
        session.fetch(SonyOperation.GET_EXTENSION, VERSION)
        session.fetch(SonyOperation.CONNECT, 3, 0, 0)

    def release(self) -> None:
        """Press the button half, then all the way, and let it go."""
        clock = self._session.clock
        try:
            self._press(SonyButton.HALF, DOWN)
            clock.sleep(PRESS_S)
            self._press(SonyButton.FULL, DOWN)
            clock.sleep(PRESS_S)
        finally:
            self._press(SonyButton.FULL, UP)
            self._press(SonyButton.HALF, UP)

    def event(self, timeout_s: float) -> Message | None:
        """Return the next event, Sony's own for a new picture as the standard's."""
        event = self._session.next_event(timeout_s)
        if event is None or event.code != OBJECT_ADDED:
            return event
        return Message(event.kind, EventCode.OBJECT_ADDED, event.transaction, event.parameters)

    def _press(self, button: SonyButton, state: int) -> None:
        self._session.request(SonyOperation.CONTROL, button, data=struct.pack("<H", state))

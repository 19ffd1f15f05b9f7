"""A Sony Alpha's firmware: a handshake first, a button of two stages, the picture in memory.

It behaves as libgphoto2 2.5 (`camlibs/ptp2`) expects of these cameras. Its RAW files are DNG.
"""

from __future__ import annotations

import struct
from typing import Any

from drivers.ptp_codec import Code, EventCode, Format, ObjectInfo, Operation
from drivers.ptp_sony import (
    DOWN,
    IN_MEMORY,
    OBJECT_ADDED,
    UP,
    VERSION,
    SonyButton,
    SonyOperation,
)
from simulators.ptp import Answer, PtpCameraSimulator


class SonyCameraSimulator(PtpCameraSimulator):
    """An Alpha in PC remote mode: every picture is `IN_MEMORY` until it was fetched."""

    maker, model = "Sony Corporation", "ILCE simulated"
    vendor_extension = 0x11
    vendor_operations = tuple(SonyOperation)
    with_data = (*PtpCameraSimulator.with_data, SonyOperation.CONTROL)

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        lacks = (
            Operation.INITIATE_CAPTURE,
            Operation.GET_THUMB,
            Operation.GET_PARTIAL_OBJECT,
            Operation.GET_PROPERTY_DESCRIPTION,
            Operation.GET_PROPERTY,
            Operation.SET_PROPERTY,
        )
        super().__init__(*arguments, lacks=lacks, **settings)
        self._hang_up()

    def power_up(self) -> None:
        """Come up without a handshake."""
        super().power_up()
        self._hang_up()

    def _hang_up(self) -> None:
        self._phase = 0
        self._buttons = dict.fromkeys(SonyButton, UP)

    def end_session(self) -> None:
        """Forget what was begun in the session."""
        super().end_session()
        self._hang_up()

    def _vendor_answer(
        self, code: int, arguments: tuple[int, ...], data: bytes, transaction: int
    ) -> Answer:
        if code == SonyOperation.CONNECT:
            if arguments[0] != self._phase + 1:
                return Answer(Code.INVALID_PARAMETER)
            self._phase = arguments[0]
            return Answer(data=bytes(8))
        if code == SonyOperation.GET_EXTENSION:
            controls = struct.pack(f"<HI{len(SonyButton)}H", VERSION, len(SonyButton), *SonyButton)
            return Answer(data=controls)
        if self._phase != 3:
            return Answer(Code.ACCESS_DENIED)
        try:
            button, (state,) = SonyButton(arguments[0]), struct.unpack("<H", data)
        except (ValueError, struct.error):
            return Answer(Code.INVALID_PARAMETER)
        return self._press(button, state, transaction)

    def _press(self, button: SonyButton, state: int, transaction: int) -> Answer:
        before, self._buttons[button] = self._buttons[button], state
        if (
            button == SonyButton.FULL
            and (before, state) == (UP, DOWN)
            and self._buttons[SonyButton.HALF] == DOWN
        ):
            return Answer(self._capture((), b"", transaction).code)
        return Answer()

    def _store(self, name: str, kind: int, data: bytes, *place: int) -> int:
        """Keep the newest picture in memory; there are no folders."""
        if kind == Format.FOLDER:
            return 0
        info = ObjectInfo(storage=0, format=kind, size=len(data), parent=0, name=name)
        self.objects[IN_MEMORY] = (info, data)
        return IN_MEMORY

    def _queue_event(self, code: int, transaction: int, *parameters: int) -> None:
        """Send Sony's own event of a new picture, and none of the standard."""
        if code == EventCode.OBJECT_ADDED and parameters != (0,):
            super()._queue_event(OBJECT_ADDED, transaction, *parameters)

    def _object(self, arguments: tuple[int, ...], *request: object) -> Answer:
        """Hand the picture over: it leaves the memory."""
        answer = super()._object(arguments)
        self.objects.pop(arguments[0], None)
        return answer

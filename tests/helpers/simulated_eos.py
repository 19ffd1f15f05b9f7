"""A Canon EOS's firmware: no standard release, no standard events, settings in its own codes.

It behaves as libgphoto2 2.5 (`camlibs/ptp2`) expects of these cameras. What a real one answers to
a release before remote mode is not known: here it refuses. Its RAW files are DNG.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from drivers.clock import Clock
from drivers.ptp_canon import (
    RECORD,
    TO_HOST,
    EosEvent,
    EosOperation,
    EosProperty,
    iso,
    shutter_s,
)
from drivers.ptp_codec import Code, EventCode, Operation, Property
from simulators.ptp import EXPOSURE_UNIT_S, Answer, Array, PtpCameraSimulator

SHUTTERS = tuple(code for code in range(0x10, 0x99) if code % 8 in (0, 3, 5))
ISOS = (0, *(code for code in range(0x48, 0x69) if code % 8 in (0, 3, 5)))
"""The first is automatic."""
CARD = 2
NOT_FOCUSED, CARD_FULL = 1, 7
LISTED = 3
AS_STANDARD = {0x9101: Operation.GET_STORAGE_IDS, 0x9102: Operation.GET_STORAGE_INFO}
"""EOS operations that other programs use, and what they do."""
OFFSETS = {"object": 8, "storage": 12, "format": 16, "size": 28, "parent": 32, "name": 40}
"""Of the fields in a record of a new object, as libgphoto2 reads them."""


class EosCameraSimulator(PtpCameraSimulator):
    """An EOS in manual mode; `old`: it has the release of the first ones, without a button.

    `focus`: whether it finds focus.
    """

    maker, model = "Canon Inc.", "Canon EOS simulated"
    vendor_extension = 0x0B
    hidden = (Property.EXPOSURE_TIME, Property.EXPOSURE_INDEX, Property.EXPOSURE_PROGRAM)
    with_data = (*PtpCameraSimulator.with_data, EosOperation.SET_PROPERTY)

    def __init__(
        self,
        render: Callable[[float], Array],
        clock: Clock,
        *arguments: Any,
        old: bool = False,
        **settings: Any,
    ) -> None:
        lacks = (Operation.INITIATE_CAPTURE, Operation.GET_THUMB)
        super().__init__(render, clock, *arguments, lacks=lacks, **settings)
        newer = (EosOperation.RELEASE_ON, EosOperation.RELEASE_OFF)
        absent = newer if old else (EosOperation.REMOTE_RELEASE,)
        known = (one for one in EosOperation if one not in absent)
        self.vendor_operations = (*known, *AS_STANDARD)
        self.focus = True
        self._codes = {
            EosProperty.SHUTTER: 0x68,
            EosProperty.ISO: 0x48,
            EosProperty.CAPTURE_DESTINATION: CARD,
        }
        self._choices = {
            EosProperty.SHUTTER: SHUTTERS,
            EosProperty.ISO: ISOS,
            EosProperty.CAPTURE_DESTINATION: (CARD, TO_HOST),
        }
        self._apply()
        self._switch_off()

    def power_up(self) -> None:
        """Come up in no remote mode."""
        super().power_up()
        self._switch_off()

    def _switch_off(self) -> None:
        self._remote = self._telling = False
        self._button = 0
        self._records: list[bytes] = []

    def end_session(self) -> None:
        """Forget what was begun in the session."""
        super().end_session()
        self._switch_off()

    def _vendor_answer(
        self, code: int, arguments: tuple[int, ...], data: bytes, transaction: int
    ) -> Answer:
        if code in AS_STANDARD:
            return self._standard_answer(AS_STANDARD[code], arguments, data, transaction)
        if code == EosOperation.SET_REMOTE_MODE:
            self._remote = bool(arguments[0])
        elif code == EosOperation.SET_EVENT_MODE:
            self._telling = bool(arguments[0])
            for one in EosProperty:
                self._tell_property(one)
        elif code == EosOperation.GET_EVENT:
            records, self._records = self._records, []
            return Answer(data=b"".join((*records, RECORD.pack(RECORD.size, 0))))
        elif code == EosOperation.SET_PROPERTY:
            return self._set(data)
        elif not self._remote:
            return Answer(Code.ACCESS_DENIED)
        elif code == EosOperation.REMOTE_RELEASE:
            return self._release(transaction)
        elif code == EosOperation.RELEASE_ON:
            pressed, self._button = self._button, self._button | arguments[0]
            if pressed == 1 and self._button == 3 and self.focus:
                return Answer(self._capture(arguments, b"", transaction).code)
        elif code == EosOperation.RELEASE_OFF:
            self._button &= ~arguments[0]
        return Answer()

    def _release(self, transaction: int) -> Answer:
        """Release at once: why it could not is a number beside OK."""
        if not self.focus:
            return Answer(parameters=(NOT_FOCUSED,))
        code = self._capture((), b"", transaction).code
        return Answer(parameters=(CARD_FULL,)) if code == Code.STORE_FULL else Answer(code, (0,))

    def _set(self, data: bytes) -> Answer:
        if len(data) != 12:
            return Answer(Code.INVALID_PROPERTY_FORMAT)
        _, code, value = struct.unpack("<III", data)
        if code not in self._codes:
            return Answer(Code.PROPERTY_NOT_SUPPORTED)
        if value not in self._choices[EosProperty(code)]:
            return Answer(Code.INVALID_PROPERTY_VALUE)
        if not self.faults.strikes("stuck_exposure"):
            self._codes[EosProperty(code)] = value
        self._apply()
        self._tell_property(EosProperty(code))
        return Answer()

    def _apply(self) -> None:
        """Let the sensor expose by what the codes mean; automatic is the lowest ISO."""
        exposure_s = shutter_s(self._codes[EosProperty.SHUTTER]) or EXPOSURE_UNIT_S
        self._values[Property.EXPOSURE_TIME] = max(1, round(exposure_s / EXPOSURE_UNIT_S))
        self._values[Property.EXPOSURE_INDEX] = round(iso(self._codes[EosProperty.ISO]) or 100)

    def _queue_event(self, code: int, transaction: int, *parameters: int) -> None:
        """Keep a new object for GetEvent; no other event of the standard comes."""
        if code != EventCode.OBJECT_ADDED or not self._telling:
            return
        info, _ = self.objects[parameters[0]]
        name = info.name.encode("ascii") + b"\0"
        record = bytearray(OFFSETS["name"] + len(name))
        RECORD.pack_into(record, 0, len(record), EosEvent.OBJECT_ADDED)
        struct.pack_into("<II", record, OFFSETS["object"], parameters[0], info.storage)
        struct.pack_into("<H", record, OFFSETS["format"], info.format)
        struct.pack_into("<II", record, OFFSETS["size"], info.size, info.parent)
        record[OFFSETS["name"] :] = name
        self._records.append(bytes(record))

    def _tell_property(self, code: EosProperty) -> None:
        choices, value = self._choices[code], self._codes[code]
        changed = struct.pack("<II", code, value)
        offered = struct.pack(f"<III{len(choices)}I", code, LISTED, len(choices), *choices)
        for kind, payload in (
            (EosEvent.PROPERTY_CHANGED, changed),
            (EosEvent.CHOICES_CHANGED, offered),
        ):
            self._records.append(RECORD.pack(RECORD.size + len(payload), kind) + payload)

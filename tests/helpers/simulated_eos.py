"""A Canon EOS's firmware: no standard release, no standard events, settings in its own codes.

It behaves as libgphoto2 2.5 (`camlibs/ptp2`) expects of these cameras. What a real one answers to
a release before remote mode is not known: here it refuses. Its RAW files are DNG.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Any

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.ptp_codec import Code, EventCode, Operation, Property
from emmc_rig.simulators.ptp import EXPOSURE_UNIT_S, Answer, Array, PtpCameraSimulator

TO_HOST = 4
"""As capture destination: pictures go to the computer, not onto the card."""


class EosOperation(IntEnum):
    """Operations of EOS cameras."""

    SET_PROPERTY = 0x9110
    SET_REMOTE_MODE = 0x9114
    SET_EVENT_MODE = 0x9115
    GET_EVENT = 0x9116
    RELEASE_ON = 0x9128
    RELEASE_OFF = 0x9129


class EosEvent(IntEnum):
    """Records that GetEvent gives; their first field is an object or a property."""

    OBJECT_ADDED = 0xC181
    PROPERTY_CHANGED = 0xC189
    CHOICES_CHANGED = 0xC18A


class EosProperty(IntEnum):
    """Properties of EOS cameras."""

    SHUTTER = 0xD102
    ISO = 0xD103
    CAPTURE_DESTINATION = 0xD11C


RECORD = struct.Struct("<II")
FRACTIONS = {0: 0.0, 3: 1 / 3, 4: 1 / 2, 5: 2 / 3}
"""Of a stop, by the last three bits of a code; other codes of ISO are automatic."""


def shutter_s(code: int) -> float:
    """Return the exposure that a code means: 0x38 is 1 s, 8 more is half of it."""
    return 2.0 ** (7 - code // 8 - FRACTIONS[code % 8])


def iso(code: int) -> float | None:
    """Return the sensitivity that a code means: 0x48 is ISO 100, 8 more is twice it."""
    if not 0x28 <= code <= 0xB0 or code % 8 not in FRACTIONS:
        return None
    return 100 * 2.0 ** (code // 8 - 9 + FRACTIONS[code % 8])


SHUTTERS = tuple(code for code in range(0x10, 0x99) if code % 8 in (0, 3, 5))
ISOS = (0, *(code for code in range(0x48, 0x69) if code % 8 in (0, 3, 5)))
"""The first is automatic."""
CARD = 2
LISTED = 3
AS_STANDARD = {0x9101: Operation.GET_STORAGE_IDS, 0x9102: Operation.GET_STORAGE_INFO}
"""EOS operations of other programs, and the equal operations of the standard."""
OFFSETS = {"object": 8, "storage": 12, "format": 16, "size": 28, "parent": 32, "name": 40}
"""Of the fields in a record of a new object, as libgphoto2 reads them."""


class EosCameraSimulator(PtpCameraSimulator):
    """An EOS in manual mode, released by a button with two stages."""

    maker, model = "Canon Inc.", "Canon EOS simulated"
    vendor_extension = 0x0B
    hidden = (Property.EXPOSURE_TIME, Property.EXPOSURE_INDEX, Property.EXPOSURE_PROGRAM)
    with_data = (*PtpCameraSimulator.with_data, EosOperation.SET_PROPERTY)

    def __init__(
        self,
        render: Callable[[float], Array],
        clock: Clock,
        *arguments: Any,
        **settings: Any,
    ) -> None:
        lacks = (Operation.INITIATE_CAPTURE,)
        super().__init__(render, clock, *arguments, lacks=lacks, **settings)
        self.vendor_operations = (*EosOperation, *AS_STANDARD)
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
            for known in EosProperty:
                self._tell_property(known)
        elif code == EosOperation.GET_EVENT:
            records, self._records = self._records, []
            return Answer(data=b"".join((*records, RECORD.pack(RECORD.size, 0))))
        elif code == EosOperation.SET_PROPERTY:
            return self._set(data)
        elif not self._remote:
            return Answer(Code.ACCESS_DENIED)
        elif code == EosOperation.RELEASE_ON:
            pressed, self._button = self._button, self._button | arguments[0]
            if pressed == 1 and self._button == 3:
                return Answer(self._initiate_capture(arguments, b"", transaction).code)
        elif code == EosOperation.RELEASE_OFF:
            self._button &= ~arguments[0]
        return Answer()

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
        exposure_s = shutter_s(self._codes[EosProperty.SHUTTER])
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

"""PTP wire format: pure functions between values and bytes, containers and datasets.

Everything is little endian. Source: ISO 15740 (PIMA 15740:2000), clauses 5 (datasets), 9
(containers), 10 to 13 (codes); USB Still Image Capture Device Definition 1.0 (containers on USB).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Annotated, Any, Self, get_type_hints

from emmc_rig.drivers.errors import CameraFormatError

HEADER = struct.Struct("<IHHI")
HEADER_SIZE = HEADER.size
MOST_PARAMETERS = 5
EVERYTHING = 0xFFFFFFFF
"""As a storage: all of them; as a size: not known."""


class Kind(IntEnum):
    """What a container carries."""

    COMMAND = 1
    DATA = 2
    RESPONSE = 3
    EVENT = 4


KINDS = frozenset(Kind)


class Operation(IntEnum):
    """What a camera can be asked to do."""

    GET_DEVICE_INFO = 0x1001
    OPEN_SESSION = 0x1002
    CLOSE_SESSION = 0x1003
    GET_STORAGE_IDS = 0x1004
    GET_STORAGE_INFO = 0x1005
    GET_OBJECT_HANDLES = 0x1007
    GET_OBJECT_INFO = 0x1008
    GET_OBJECT = 0x1009
    DELETE_OBJECT = 0x100B
    INITIATE_CAPTURE = 0x100E
    GET_PROPERTY_DESCRIPTION = 0x1014
    GET_PROPERTY = 0x1015
    SET_PROPERTY = 0x1016


class Code(IntEnum):
    """What a camera answers."""

    OK = 0x2001
    GENERAL_ERROR = 0x2002
    SESSION_NOT_OPEN = 0x2003
    INVALID_TRANSACTION = 0x2004
    OPERATION_NOT_SUPPORTED = 0x2005
    PARAMETER_NOT_SUPPORTED = 0x2006
    INCOMPLETE_TRANSFER = 0x2007
    INVALID_STORAGE = 0x2008
    INVALID_HANDLE = 0x2009
    PROPERTY_NOT_SUPPORTED = 0x200A
    INVALID_FORMAT = 0x200B
    STORE_FULL = 0x200C
    WRITE_PROTECTED = 0x200D
    STORE_READ_ONLY = 0x200E
    ACCESS_DENIED = 0x200F
    NO_THUMBNAIL = 0x2010
    STORE_NOT_AVAILABLE = 0x2013
    BUSY = 0x2019
    INVALID_PARENT = 0x201A
    INVALID_PROPERTY_FORMAT = 0x201B
    INVALID_PROPERTY_VALUE = 0x201C
    INVALID_PARAMETER = 0x201D
    SESSION_ALREADY_OPEN = 0x201E
    CANCELLED = 0x201F


class EventCode(IntEnum):
    """Events that a camera sends on its own."""

    OBJECT_ADDED = 0x4002
    OBJECT_REMOVED = 0x4003
    STORE_FULL = 0x400A
    CAPTURE_COMPLETE = 0x400D


class Format(IntEnum):
    """Object formats."""

    UNDEFINED = 0x3000
    FOLDER = 0x3001
    JPEG = 0x3801
    DNG = 0x3811


class Property(IntEnum):
    """Device properties; exposure time in 0.1 ms, exposure index as ISO."""

    BATTERY_LEVEL = 0x5001
    EXPOSURE_TIME = 0x500D
    EXPOSURE_PROGRAM = 0x500E
    EXPOSURE_INDEX = 0x500F


@dataclass(frozen=True)
class Header:
    """The first twelve bytes of a container; `length` counts them too."""

    length: int
    kind: int
    code: int
    transaction: int

    @property
    def payload_length(self) -> int:
        """Bytes that follow."""
        return self.length - HEADER_SIZE


@dataclass(frozen=True)
class Message:
    """A command, response or event with its parameters."""

    kind: int
    code: int
    transaction: int
    parameters: tuple[int, ...] = ()


def encode_message(message: Message) -> bytes:
    """Return the container of a command, response or event."""
    count = len(message.parameters)
    if count > MOST_PARAMETERS:
        raise ValueError(f"{count} parameters are more than PTP's {MOST_PARAMETERS}")
    header = HEADER.pack(HEADER_SIZE + 4 * count, message.kind, message.code, message.transaction)
    return header + struct.pack(f"<{count}I", *message.parameters)


def encode_data(code: int, transaction: int, payload: bytes) -> bytes:
    """Return a data container."""
    return HEADER.pack(HEADER_SIZE + len(payload), Kind.DATA, code, transaction) + payload


def decode_header(data: bytes | memoryview) -> Header:
    """Return a container's header; raises `CameraFormatError`."""
    if len(data) < HEADER_SIZE:
        raise CameraFormatError(bytes(data), "shorter than a container's header")
    header = Header(*HEADER.unpack_from(data))
    if header.length < HEADER_SIZE or header.kind not in KINDS:
        raise CameraFormatError(bytes(data[:HEADER_SIZE]), "no header of a container")
    return header


def decode_message(data: bytes) -> Message:
    """Return the command, response or event in a whole container; raises `CameraFormatError`."""
    header = decode_header(data)
    count, rest = divmod(header.payload_length, 4)
    if header.length != len(data) or rest or count > MOST_PARAMETERS or header.kind == Kind.DATA:
        raise CameraFormatError(data, "length and parameters do not match")
    parameters = struct.unpack_from(f"<{count}I", data, HEADER_SIZE)
    return Message(header.kind, header.code, header.transaction, parameters)


NUMBERS = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "q", 8: "Q"}
"""Data types of property values that are read here: no texts, no lists."""

U16 = Annotated[int, "H"]
U32 = Annotated[int, "I"]
U64 = Annotated[int, "Q"]
Text = Annotated[str, "text"]
Codes = Annotated[tuple[int, ...], "*H"]


class _Reader:
    """Takes values from the front of a dataset."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def take(self, layout: str) -> tuple[int, ...]:
        size = struct.calcsize("<" + layout)
        if self._at + size > len(self._data):
            raise CameraFormatError(self._data, "a dataset ends too early")
        self._at += size
        return struct.unpack_from("<" + layout, self._data, self._at - size)

    def number(self, layout: str) -> int:
        return self.take(layout)[0]

    def array(self, layout: str) -> tuple[int, ...]:
        count = self.number("I")
        if count > len(self._data):
            raise CameraFormatError(self._data, f"a list of {count} values is longer than the data")
        return self.take(f"{count}{layout}")

    def text(self) -> str:
        """Return a string; some cameras omit the closing null, or the whole string at the end."""
        if self._at == len(self._data):
            return ""
        size = 2 * self.number("B")
        raw = bytes(self.take(f"{size}B"))
        return raw.decode("utf-16-le", "replace").partition("\x00")[0]

    def value(self, data_type: int) -> int:
        layout = NUMBERS.get(data_type)
        if layout is None:
            raise CameraFormatError(self._data, f"values of type {data_type:#06x} are no numbers")
        return self.number(layout)


def encode_text(text: str) -> bytes:
    """Return a string as PTP writes it: length in characters with the closing null, UTF-16."""
    if not text:
        return b"\x00"
    body = (text + "\x00").encode("utf-16-le")
    if len(body) > 510:
        raise ValueError(f"{text!r} is longer than PTP's 254 characters")
    return bytes((len(body) // 2,)) + body


def _encode_array(layout: str, values: tuple[int, ...]) -> bytes:
    return struct.pack(f"<I{len(values)}{layout}", len(values), *values)


def encode_value(data_type: int, value: int) -> bytes:
    """Return a property's value; raises `ValueError` where value and type do not match."""
    try:
        return struct.pack("<" + NUMBERS[data_type], value)
    except struct.error as error:
        raise ValueError(f"{value!r} is no value of type {data_type:#06x}") from error


def decode_value(data_type: int, data: bytes) -> int:
    """Return a property's value; raises `CameraFormatError`."""
    return _Reader(data).value(data_type)


def encode_handles(handles: tuple[int, ...]) -> bytes:
    """Return a list of object handles or storages."""
    return _encode_array("I", handles)


def decode_handles(data: bytes) -> tuple[int, ...]:
    """Return a list of object handles or storages; raises `CameraFormatError`."""
    return _Reader(data).array("I")


class _Dataset:
    """Fields in wire order, each with its layout: see `_Reader.take`, "*" of a list, "text"."""

    @classmethod
    @cache  # hints are texts that Python compiles anew each time
    def _layouts(cls) -> dict[str, str]:
        hints = get_type_hints(cls, include_extras=True)
        return {name: hint.__metadata__[0] for name, hint in hints.items()}

    def encode(self) -> bytes:
        """Return the dataset's bytes."""
        parts = []
        for name, layout in self._layouts().items():
            value: Any = getattr(self, name)
            if layout == "text":
                parts.append(encode_text(value))
            elif layout.startswith("*"):
                parts.append(_encode_array(layout[1:], value))
            else:
                parts.append(struct.pack("<" + layout, value))
        return b"".join(parts)

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Return the dataset in the bytes; raises `CameraFormatError`."""
        reader = _Reader(data)
        fields: dict[str, Any] = {}
        for name, layout in cls._layouts().items():
            if layout == "text":
                fields[name] = reader.text()
            elif layout.startswith("*"):
                fields[name] = reader.array(layout[1:])
            else:
                fields[name] = reader.number(layout)
        return cls(**fields)


@dataclass(frozen=True, kw_only=True)
class DeviceInfo(_Dataset):
    """Identity and capabilities of a camera (clause 5.5.2)."""

    standard_version: U16 = 100
    vendor_extension: U32 = 0
    vendor_extension_version: U16 = 0
    vendor_extension_text: Text = ""
    functional_mode: U16 = 0
    operations: Codes
    events: Codes
    properties: Codes
    capture_formats: Codes
    image_formats: Codes
    maker: Text
    model: Text
    version: Text
    serial: Text


@dataclass(frozen=True, kw_only=True)
class StorageInfo(_Dataset):
    """A memory card (clause 5.5.3)."""

    storage_type: U16 = 4
    filesystem: U16 = 3
    access: U16 = 0
    capacity_bytes: U64
    free_bytes: U64
    free_images: U32
    description: Text = ""
    label: Text = ""


@dataclass(frozen=True, kw_only=True)
class ObjectInfo(_Dataset):
    """A file or folder on the card (clause 5.5.4)."""

    storage: U32
    format: U16
    protection: U16 = 0
    size: U32
    thumb_format: U16 = 0
    thumb_size: U32 = 0
    thumb_columns: U32 = 0
    thumb_rows: U32 = 0
    columns: U32 = 0
    rows: U32 = 0
    bits: U32 = 0
    parent: U32
    association_type: U16 = 0
    association_description: U32 = 0
    sequence: U32 = 0
    name: Text
    captured: Text = ""
    modified: Text = ""
    keywords: Text = ""


@dataclass(frozen=True)
class PropertyDescription:
    """What a property is and may become (clause 13.3.3).

    `choices` lists the values it may take, `span` is (lowest, highest, step); at most one is set.
    """

    code: int
    data_type: int
    writable: bool
    default: int
    current: int
    choices: tuple[int, ...] = ()
    span: tuple[int, int, int] | None = None


NO_FORM, SPAN_FORM, CHOICES_FORM = 0, 1, 2


def encode_description(described: PropertyDescription) -> bytes:
    """Return a property's description."""
    kind = described.data_type
    parts = [
        struct.pack("<HHB", described.code, kind, described.writable),
        encode_value(kind, described.default),
        encode_value(kind, described.current),
    ]
    if described.span is not None:
        parts.append(bytes((SPAN_FORM,)))
        parts += [encode_value(kind, value) for value in described.span]
    elif described.choices:
        parts.append(bytes((CHOICES_FORM,)) + struct.pack("<H", len(described.choices)))
        parts += [encode_value(kind, value) for value in described.choices]
    else:
        parts.append(bytes((NO_FORM,)))
    return b"".join(parts)


def decode_description(data: bytes) -> PropertyDescription:
    """Return a property's description; raises `CameraFormatError`."""
    reader = _Reader(data)
    code, data_type, writable = reader.take("HHB")
    default, current = reader.value(data_type), reader.value(data_type)
    form = reader.number("B")
    choices: tuple[int, ...] = ()
    span = None
    if form == SPAN_FORM:
        span = reader.value(data_type), reader.value(data_type), reader.value(data_type)
    elif form == CHOICES_FORM:
        choices = tuple(reader.value(data_type) for _ in range(reader.number("H")))
    return PropertyDescription(code, data_type, bool(writable), default, current, choices, span)


def numeric_choices(described: PropertyDescription, special: frozenset[int]) -> tuple[int, ...]:
    """Return the positive numbers among the choices, in order, but for the special ones."""
    return tuple(sorted({v for v in described.choices if v > 0 and v not in special}))


def nearest(described: PropertyDescription, target: float, special: frozenset[int]) -> int:
    """Return the value that the property can take which is nearest to `target`, above 0.

    Nearest in ratio among choices, since those of cameras are steps of one; in difference within
    a range. A property with neither takes any whole number.
    """
    choices = numeric_choices(described, special)
    if choices:
        return min(choices, key=lambda value: abs(math.log(value / target)))
    if described.span is None:
        return max(1, round(target))
    low, high, step = described.span
    step = max(1, step)
    return min(max(low, low + step * round((target - low) / step)), high)


def limits(described: PropertyDescription, special: frozenset[int]) -> tuple[int, int]:
    """Return the lowest and highest value above 0; the present value where no form states them."""
    choices = numeric_choices(described, special)
    if not choices and described.span is not None:
        return max(1, described.span[0]), max(1, described.span[1])
    if not choices:
        choices = (max(1, described.current),)
    return choices[0], choices[-1]

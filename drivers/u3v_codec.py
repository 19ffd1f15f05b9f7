"""USB3 Vision wire format: pure functions between values and bytes.

Source: AIA USB3 Vision 1.0 and EMVA GenCP 1.1, as open implementations state them: Wireshark's
dissector (packet-u3v.c, by the AIA), Aravis (arvuvcpprivate.h, arvuvspprivate.h) and cameleon
(register_map.rs), which agree.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from emmc_rig.drivers.errors import CameraFormatError

CONTROL = (0xEF, 0x05, 0x00)
"""Class, subclass and protocol of the interface that takes commands."""
STREAM = (0xEF, 0x05, 0x02)

COMMAND_PREFIX = 0x43563355
LEADER_PREFIX = 0x4C563355
TRAILER_PREFIX = 0x54563355
ACKNOWLEDGE_WANTED = 0x4000
READMEM, READMEM_ACK = 0x0800, 0x0801
WRITEMEM, WRITEMEM_ACK = 0x0802, 0x0803
PENDING_ACK = 0x0805
ACKNOWLEDGES = (READMEM_ACK, WRITEMEM_ACK, PENDING_ACK)

_HEADER = struct.Struct("<IHHHH")
_READ = struct.Struct("<QHH")
_WRITE = struct.Struct("<Q")
_PAIR = struct.Struct("<HH")
HEADER_SIZE = _HEADER.size
WRITE_OVERHEAD = HEADER_SIZE + _WRITE.size
REQUEST_IDS = range(1, 0x10000)

# Technology-agnostic registers (ABRM), at address 0.
ABRM_MAKER = 0x0004
ABRM_MODEL = 0x0044
ABRM_VERSION = 0x00C4
ABRM_SERIAL = 0x0144
TEXT_SIZE = 64
ABRM_RESPONSE_TIME_MS = 0x01CC
ABRM_MANIFEST = 0x01D0
ABRM_SBRM = 0x01D8
# USB3 Vision registers (SBRM), from the address that the ABRM names.
SBRM_COMMAND_SIZE = 0x14
SBRM_ACKNOWLEDGE_SIZE = 0x18
SBRM_SIRM = 0x20
# Streaming registers (SIRM), from the address that the SBRM names.
SIRM_INFO = 0x00
SIRM_CONTROL = 0x04
SIRM_REQUIRED_PAYLOAD = 0x08
SIRM_REQUIRED_LEADER = 0x10
SIRM_REQUIRED_TRAILER = 0x14
SIRM_LEADER_SIZE = 0x18
SIRM_TRANSFER_SIZE = 0x1C
SIRM_TRANSFER_COUNT = 0x20
SIRM_FINAL_1 = 0x24
SIRM_FINAL_2 = 0x28
SIRM_TRAILER_SIZE = 0x2C

STATUS = {
    0x8001: ("not implemented", "this camera lacks the feature"),
    0x8002: ("invalid parameter", "check the value"),
    0x8003: ("invalid address", "update the camera's firmware"),
    0x8004: ("write protected", "stop the acquisition, or leave the feature alone"),
    0x8005: ("bad alignment", "update the camera's firmware"),
    0x8006: ("access denied", "stop the acquisition and close other programs that use the camera"),
    0x8007: ("busy", "wait, then try again"),
    0x800B: ("message timeout", "try again"),
    0x800E: ("invalid header", "open the camera again"),
    0x800F: ("wrong configuration", "open the camera again"),
    0x8FFF: ("error", "switch the camera off and on"),
    0xA001: ("resend not supported", "capture again"),
    0xA002: ("stream endpoint halted", "open the camera again"),
    0xA003: ("payload size not aligned", "open the camera again"),
    0xA004: ("stream registers inconsistent", "open the camera again"),
    0xA100: ("data discarded", "use a faster port, or lower the frame rate"),
}
"""Meaning and advice of the answers other than success (GenCP and USB3 Vision status codes)."""
UNKNOWN_STATUS = ("unknown status", "see the camera's manual")

IMAGE, IMAGE_WITH_CHUNKS = 0x0001, 0x4001

_LEADER = struct.Struct("<IHHQHHQIIIIIHH")
_TRAILER = struct.Struct("<IHHQHHQ")
LEADER_SIZE = _LEADER.size
_U32 = struct.Struct("<I")
TRAILER_SIZES = range(_TRAILER.size, 68, 4)
"""An image's trailer adds its lines, one with chunks their layout; makers may add more."""

_MANIFEST_ENTRY = struct.Struct("<HBBIQQ20s")
MANIFEST_ENTRY_SIZE = 64
XML_PLAIN, XML_ZIPPED = 0, 1


@dataclass(frozen=True)
class Acknowledge:
    """An answer of the control channel; `status` 0 is success."""

    status: int
    command: int
    request_id: int
    data: bytes

    @property
    def pending_s(self) -> float:
        """How long the camera still needs, for a pending acknowledge."""
        return _PAIR.unpack(self.data)[1] / 1000


@dataclass(frozen=True)
class Leader:
    """What precedes an image: its number, time, pixel format code and place on the sensor."""

    block_id: int
    payload_type: int
    timestamp_ns: int
    pixel_format: int
    width: int
    height: int
    offset_x: int
    offset_y: int
    padding_x: int


@dataclass(frozen=True)
class Trailer:
    """What follows an image: its number, how it went, how many bytes and lines are valid."""

    block_id: int
    status: int
    valid_bytes: int
    lines: int | None


@dataclass(frozen=True)
class ManifestEntry:
    """Place and format of a camera description; `sha1` is all zero if the camera states none."""

    version: tuple[int, int, int]
    file_type: int
    file_format: int
    address: int
    size: int
    sha1: bytes


def encode_read(request_id: int, address: int, length: int) -> bytes:
    """Return a READMEM command; raises `ValueError` for what the format cannot carry."""
    _check(request_id, address, length)
    body = _READ.pack(address, 0, length)
    return _header(READMEM, request_id, body)


def encode_write(request_id: int, address: int, data: bytes) -> bytes:
    """Return a WRITEMEM command; raises `ValueError` for what the format cannot carry."""
    _check(request_id, address, len(data) + _WRITE.size)
    return _header(WRITEMEM, request_id, _WRITE.pack(address) + data)


def decode_acknowledge(raw: bytes) -> Acknowledge:
    """Return the acknowledge in one message; raises `CameraFormatError`."""
    if len(raw) < HEADER_SIZE:
        raise CameraFormatError(raw, f"{len(raw)} bytes are no acknowledge")
    prefix, status, command, length, request_id = _HEADER.unpack_from(raw)
    if prefix != COMMAND_PREFIX:
        raise CameraFormatError(raw, "it lacks the prefix of an acknowledge")
    if command not in ACKNOWLEDGES:
        raise CameraFormatError(raw, f"{command:#06x} is no acknowledge")
    data = raw[HEADER_SIZE:]
    if length != len(data):
        raise CameraFormatError(raw, f"it announces {length} bytes of data and has {len(data)}")
    if command == PENDING_ACK and length != _PAIR.size:
        raise CameraFormatError(raw, f"a pending acknowledge with {length} bytes of data")
    return Acknowledge(status, command, request_id, data)


def decode_leader(raw: bytes | memoryview) -> Leader:
    """Return the leader of an image at the beginning of `raw`; raises `CameraFormatError`."""
    if not begins_with(raw, LEADER_PREFIX) or len(raw) < _LEADER.size:
        raise CameraFormatError(bytes(raw[:64]), "it is no leader of an image")
    _, _, size, block_id, _, payload_type, timestamp_ns, *image, _ = _LEADER.unpack_from(raw)
    if payload_type not in (IMAGE, IMAGE_WITH_CHUNKS):
        raise CameraFormatError(bytes(raw[:64]), f"payload type {payload_type:#06x} is no image")
    if not _LEADER.size <= size <= len(raw):
        raise CameraFormatError(bytes(raw[:64]), f"a leader of {size} bytes")
    return Leader(block_id, payload_type, timestamp_ns, *image)


def decode_trailer(raw: bytes | memoryview) -> Trailer:
    """Return the trailer that `raw` is; raises `CameraFormatError`."""
    if not begins_with(raw, TRAILER_PREFIX) or len(raw) < _TRAILER.size:
        raise CameraFormatError(bytes(raw[:64]), "it is no trailer")
    _, _, size, block_id, status, _, valid_bytes = _TRAILER.unpack_from(raw)
    if not _TRAILER.size <= size <= len(raw):
        raise CameraFormatError(bytes(raw[:64]), f"a trailer of {size} bytes")
    has_lines = size >= _TRAILER.size + _U32.size
    lines = _U32.unpack_from(raw, _TRAILER.size)[0] if has_lines else None
    return Trailer(block_id, status, valid_bytes, lines)


def split_frame(original: bytes) -> tuple[Leader, memoryview, Trailer]:
    """Return leader, payload and trailer of a recorded frame, which is these three in a row.

    Raises `CameraFormatError` for bytes that are no recorded frame, or a torn frame.
    """
    leader = decode_leader(original)
    begin = packet_size(original)
    for size in TRAILER_SIZES:
        end = len(original) - size
        if end >= begin and begins_with(memoryview(original)[end:], TRAILER_PREFIX):
            raw = original[end:]
            trailer = decode_trailer(raw)
            if packet_size(raw) == size and trailer.block_id == leader.block_id:
                return leader, memoryview(original)[begin:end], trailer
    raise CameraFormatError(original[-64:], "the frame does not end with its trailer")


def decode_manifest_entry(raw: bytes) -> ManifestEntry:
    """Return one entry of the manifest table; raises `CameraFormatError`."""
    if len(raw) < _MANIFEST_ENTRY.size:
        raise CameraFormatError(raw, f"{len(raw)} bytes are no entry of a manifest table")
    subminor, minor, major, info, address, size, sha1 = _MANIFEST_ENTRY.unpack_from(raw)
    return ManifestEntry(
        (major, minor, subminor), info & 0x7, info >> 10 & 0x3F, address, size, sha1
    )


def begins_with(raw: bytes | memoryview, prefix: int) -> bool:
    """Whether a packet of the stream has that prefix."""
    return len(raw) >= _U32.size and _U32.unpack_from(raw)[0] == prefix


def packet_size(raw: bytes | memoryview) -> int:
    """Return how long a leader or trailer says that it is."""
    return _PAIR.unpack_from(raw, 4)[1]


def text(raw: bytes) -> str:
    """Return a text register, which ends at its first zero byte."""
    return raw.split(b"\0", 1)[0].decode("utf-8", "replace").strip()


def _header(command: int, request_id: int, body: bytes) -> bytes:
    head = _HEADER.pack(COMMAND_PREFIX, ACKNOWLEDGE_WANTED, command, len(body), request_id)
    return head + body


def _check(request_id: int, address: int, length: int) -> None:
    if request_id not in REQUEST_IDS:
        raise ValueError(f"request id {request_id} is not within 1 to 65535")
    if not 0 <= address < 1 << 64:
        raise ValueError(f"address {address:#x} does not fit into 64 bits")
    if not 0 < length < 1 << 16:
        raise ValueError(f"{length} bytes do not fit into one command")

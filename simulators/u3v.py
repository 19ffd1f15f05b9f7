"""A USB3 Vision camera's firmware: registers, its XML, and frames cut into transfers.

It exposes whatever scene it is given, on the injected clock, holds two frames and drops what the
host does not fetch. Simplified: no events, no chunks; a frame is read out in no time. The packets
are packed here by hand, not by the driver's codec. Source: USB3 Vision 1.0 and GenCP 1.1 as
Wireshark's dissector (packet-u3v.c) states them.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.pixel_formats import BY_CODE, BY_NAME, PixelFormat
from emmc_rig.simulators import u3v_description as xml
from emmc_rig.simulators.faults import Faults
from emmc_rig.simulators.usb import (
    SUPER_SPEED,
    DeviceSpec,
    EndpointSpec,
    InterfaceSpec,
    StallError,
    UnpluggedError,
    UsbFunction,
)

Array = np.ndarray

FAULTS = (
    "pending",
    "busy",
    "drop_reply",
    "late_reply",
    "garble_reply",
    "duplicate_reply",
    "stall_control",
    "unplug",
    "dropped_frame",
    "lost_leader",
    "garbled_leader",
    "torn_payload",
    "lost_trailer",
    "discarded",
    "wrong_size",
    "stall_stream",
    "late_frame",
    "unplug_in_payload",
)

VENDOR, PRODUCT = 0x1209, 0x0E3C
COMMAND_OUT, ANSWER_IN, STREAM_IN = 0x01, 0x81, 0x82
PACKET = 1024
FRAME_RATE_HZ = 30.0
SERIAL = "U1"
EXPOSURE_TICKS = (20, 20_000_000)
GAIN_STEPS = (0, 240)
"""Limits of the raw registers: 10 us to 10 s in `xml.EXPOSURE_TICK_US`, 0 to 24 dB."""

ABRM, SBRM, SIRM, MANIFEST, FILE = 0x0, 0x10000, 0x20000, 0x30000, 0x40000
RESPONSE_MS = 200
COMMAND_SIZE, ANSWER_SIZE = 1024, 1024
LEADER_SIZE, TRAILER_SIZE = 52, 32

PENDING_S = 3.0
BUSY_STEP_S = 0.2
LATE_REPLY_S = 0.6
LATE_FRAME_S = 60.0
HELD_FRAMES = 2

OK, INVALID, BAD_ADDRESS, PROTECTED = 0x0000, 0x8002, 0x8003, 0x8004
NOT_IMPLEMENTED, NOT_ALIGNED, INCONSISTENT, DISCARDED = 0x8001, 0xA003, 0xA004, 0xA100

SET_HALT = (0x02, 0x03, 0)

COLOURS = {
    "rggb": "BayerRG",
    "grbg": "BayerGR",
    "gbrg": "BayerGB",
    "bggr": "BayerBG",
    "mono": "Mono",
}


@dataclass
class _Acquisition:
    """Frames in the making: when the next exposure begins, and its number."""

    single: bool
    next_start_s: float
    block: int = 0
    late_s: float = 0.0


class U3vCameraSimulator(UsbFunction):
    """The camera; plug it into a `SimulatedUsb`.

    `render(exposure_s)` returns the uint16 `(y, x)` mosaic in DN of the sensor's `bits`, at no
    gain, called when the exposure is over, which began at `exposed_from_s` of the clock. It must
    have `shape`, the sensor's. `depths` names the formats offered, as in
    `drivers.pixel_formats.CODES`. `alignment_bits`: transfers are multiples of 2 to its power.
    Faults, armed with `faults.inject`, strike commands, frames or the middle of a payload, as their
    names say; `when` is given a command's address, or a frame's number. A line of `lines` can
    begin frames: a function that returns when, at or after a time, it next rises (or falls).
    """

    def __init__(
        self,
        render: Callable[[float], Array],
        clock: Clock,
        shape: tuple[int, int],
        cfa: str = "rggb",
        black_level_dn: int = 64,
        bits: int = 12,
        *,
        depths: tuple[str, ...] = ("8", "10", "10p", "12", "12Packed", "12p"),
        zipped: bool = True,
        alignment_bits: int = 10,
        packet: int = PACKET,
    ) -> None:
        self.faults = Faults(FAULTS)
        self.spec = _spec(packet)
        self._render = render
        self._clock = clock
        self.exposed_from_s = 0.0
        self.lines: dict[str, Callable[[float, bool], float]] = {}
        self._shape = shape
        self._bits = bits
        self._black_level_dn = black_level_dn
        self._alignment_bits = alignment_bits
        formats = tuple(COLOURS[cfa] + depth for depth in depths)
        self._codes = tuple(BY_NAME[name].code for name in formats)
        self.description = xml.describe(self.spec.model, formats, EXPOSURE_TICKS, GAIN_STEPS)
        self._file = _zip(self.description) if zipped else self.description
        self._zipped = zipped
        self._packed: tuple[Array, tuple, bytes] | None = None
        self.plugged()

    def plugged(self) -> None:
        """Come up with the settings of the factory, which are not fit for measuring."""
        self._regions = {
            ABRM: self._abrm(),
            SBRM: self._sbrm(),
            SIRM: bytearray(0x30),
            MANIFEST: self._manifest(),
            FILE: bytearray(self._file),
            xml.BASE: bytearray(xml.SIZE),
        }
        self._write_u32(SIRM, 0x00, self._alignment_bits << 24)
        self._write_u32(SIRM, 0x10, LEADER_SIZE)
        self._write_u32(SIRM, 0x14, TRAILER_SIZE)
        for offset, value in (
            (xml.WIDTH, self._shape[1]),
            (xml.HEIGHT, self._shape[0]),
            (xml.WIDTH_MAX, self._shape[1]),
            (xml.HEIGHT_MAX, self._shape[0]),
            (xml.PIXEL_FORMAT, self._codes[0]),
            (xml.EXPOSURE, round(10_000 / xml.EXPOSURE_TICK_US)),
            (xml.TRIGGER, 0x1),
            (xml.AUTO, 0x3),
        ):
            self._write_u32(xml.BASE, offset, value)
        struct.pack_into("<f", self._regions[xml.BASE], xml.FRAME_RATE, FRAME_RATE_HZ)
        self._regions[xml.BASE][xml.SENSOR : xml.SENSOR + 4] = b"SIM1"
        self._update_sizes()
        self._answers: deque[tuple[float, bytes]] = deque()
        self._busy_request: int | None = None
        self._longest = False
        self._messages: deque[bytes | memoryview] = deque()
        self._acquisition: _Acquisition | None = None
        self._halted = False

    @property
    def streaming(self) -> bool:
        """Whether an acquisition runs or the stream is enabled."""
        return self._acquisition is not None or bool(self._read_u32(SIRM, 0x04) & 1)

    def bulk_out(self, endpoint: int, data: bytes) -> int:
        """Take a command."""
        if self.faults.strikes("unplug"):
            raise UnpluggedError
        if self.faults.strikes("stall_control"):
            raise StallError
        if len(data) >= 12:
            self._command(data)
        return len(data)

    def bulk_in(self, endpoint: int, length: int, timeout_s: float) -> bytes | memoryview | None:
        """Answer a command, or send the next piece of a frame."""
        if endpoint == ANSWER_IN:
            return self._next_answer(timeout_s)
        if self._halted:
            raise StallError
        if not self._messages and not self._next_frame(timeout_s):
            return None
        message = self._messages.popleft()
        if message == b"stall":
            raise StallError
        if message == b"unplug":
            raise UnpluggedError
        return message

    def ends_with_empty_packet(self, endpoint: int) -> bool:
        """Whether a full last packet is followed by an empty one.

        Not where the host knows the length: frames and the longest answers fill what was agreed.
        """
        return endpoint == ANSWER_IN and not self._longest

    def control(
        self, request_type: int, request: int, value: int, index: int, data: bytes
    ) -> bytes:
        """Halt the stream when asked to."""
        if (request_type, request, value) != SET_HALT or index != STREAM_IN:
            raise StallError
        self._halted = True
        self._messages.clear()
        return b""

    def cleared(self, endpoint: int) -> None:
        """The host made an endpoint usable again."""
        if endpoint == STREAM_IN:
            self._halted = False
            self._messages.clear()

    def _next_answer(self, timeout_s: float) -> bytes | None:
        now_s = self._clock.now_s()
        if self._busy_request is not None:
            self._clock.sleep(min(BUSY_STEP_S, timeout_s))
            wait_ms = round(2 * BUSY_STEP_S * 1000)
            return _answer(OK, 0x0805, self._busy_request, struct.pack("<HH", 0, wait_ms))
        if not self._answers or self._answers[0][0] > now_s + timeout_s:
            return None
        ready_s, answer = self._answers.popleft()
        self._longest = len(answer) == ANSWER_SIZE
        self._clock.sleep(max(0.0, ready_s - now_s))
        return answer

    def _command(self, data: bytes) -> None:
        prefix, _, command, length, request_id = struct.unpack_from("<IHHHH", data)
        body = data[12:]
        address = struct.unpack_from("<Q", body)[0] if len(body) >= 8 else 0
        self._busy_request = None
        if (
            prefix != 0x43563355
            or len(body) != length
            or self.faults.strikes("drop_reply", address)
        ):
            return
        now_s = self._clock.now_s()
        if self.faults.strikes("busy", address):
            self._busy_request = request_id
            return
        if self.faults.strikes("pending", address):
            wait_ms = round(PENDING_S * 1000) + 500
            pending = _answer(OK, 0x0805, request_id, struct.pack("<HH", 0, wait_ms))
            self._answers.append((now_s, pending))
            now_s += PENDING_S
        answer = self._execute(command, request_id, body)
        if self.faults.strikes("late_reply", address):
            now_s += LATE_REPLY_S
        if self.faults.strikes("garble_reply", address):
            answer = answer[:2] + bytes((answer[2] ^ 0x10,)) + answer[3:]
        self._answers.append((now_s, answer))
        if self.faults.strikes("duplicate_reply", address):
            self._answers.append((now_s, answer))

    def _execute(self, command: int, request_id: int, body: bytes) -> bytes:
        if command == 0x0800 and len(body) == 12:
            address, _, length = struct.unpack("<QHH", body)
            if length > ANSWER_SIZE - 12:
                return _answer(INVALID, 0x0801, request_id, b"")
            found = self._find(address, length)
            if found is None:
                return _answer(BAD_ADDRESS, 0x0801, request_id, b"")
            base, offset = found
            data = bytes(self._regions[base][offset : offset + length])
            return _answer(OK, 0x0801, request_id, data)
        if command == 0x0802 and 8 < len(body) <= COMMAND_SIZE - 12:
            (address,) = struct.unpack_from("<Q", body)
            status = self._store(address, body[8:])
            return _answer(status, 0x0803, request_id, struct.pack("<HH", 0, len(body) - 8))
        return _answer(NOT_IMPLEMENTED, command | 1, request_id, b"")

    def _find(self, address: int, length: int) -> tuple[int, int] | None:
        for base, memory in self._regions.items():
            if base <= address and address + length <= base + len(memory):
                return base, address - base
        return None

    def _store(self, address: int, data: bytes) -> int:
        found = self._find(address, len(data))
        if found is None:
            return BAD_ADDRESS
        base, offset = found
        if base == SIRM:
            return self._store_stream(offset, data)
        if base != xml.BASE or len(data) != 4:
            return PROTECTED
        return self._store_feature(offset, data, struct.unpack("<I", data)[0])

    def _store_stream(self, offset: int, data: bytes) -> int:
        if offset < 0x04 or 0x08 <= offset < 0x18 or len(data) != 4:
            return PROTECTED
        enabled = self._read_u32(SIRM, 0x04) & 1
        (value,) = struct.unpack("<I", data)
        if offset != 0x04:
            if enabled:
                return PROTECTED
            self._write_u32(SIRM, offset, value)
            return OK
        if value & 1 and not enabled:
            status = self._check_transfers()
            if status:
                return status
        if not value & 1:
            self._messages.clear()
        self._write_u32(SIRM, offset, value)
        return OK

    def _check_transfers(self) -> int:
        leader, transfer, count, final_1, final_2, trailer = (
            self._read_u32(SIRM, offset) for offset in (0x18, 0x1C, 0x20, 0x24, 0x28, 0x2C)
        )
        if any(size % (1 << self._alignment_bits) for size in (transfer, final_1, final_2)):
            return NOT_ALIGNED
        required = struct.unpack_from("<Q", self._regions[SIRM], 0x08)[0]
        enough = transfer * count + final_1 + final_2 >= required
        fits = leader >= LEADER_SIZE and trailer >= TRAILER_SIZE
        return OK if enough and fits else INCONSISTENT

    def _store_feature(self, offset: int, data: bytes, value: int) -> int:
        locked = self._read_u32(xml.BASE, xml.LOCKED)
        auto = self._read_u32(xml.BASE, xml.AUTO)
        signed = struct.unpack("<i", data)[0]
        rows, columns = self._shape
        if offset in (xml.WIDTH_MAX, xml.HEIGHT_MAX, xml.PAYLOAD, xml.BLACK_LEVEL):
            return PROTECTED
        if locked and offset <= xml.PIXEL_FORMAT:
            return PROTECTED
        refused = (
            (offset == xml.PIXEL_FORMAT and value not in self._codes)
            or (offset == xml.WIDTH and not 2 <= value <= columns)
            or (offset == xml.HEIGHT and not 2 <= value <= rows)
            or (offset == xml.EXPOSURE and not EXPOSURE_TICKS[0] <= value <= EXPOSURE_TICKS[1])
            or (offset == xml.EXPOSURE and auto >> xml.AUTO_EXPOSURE_BIT & 1)
            or (offset == xml.GAIN and not GAIN_STEPS[0] <= signed <= GAIN_STEPS[1])
        )
        if refused:
            return INVALID
        if offset == xml.START:
            return self._start()
        if offset == xml.STOP:
            self._acquisition = None
        else:
            self._regions[xml.BASE][offset : offset + 4] = data
            self._update_sizes()
        return OK

    def _start(self) -> int:
        if not self._read_u32(SIRM, 0x04) & 1:
            return DISCARDED
        start_s = self._trigger_s(self._clock.now_s())
        self._acquisition = _Acquisition(bool(self._read_u32(xml.BASE, xml.MODE)), start_s)
        return OK

    def _trigger_s(self, after_s: float) -> float:
        """Return when the next frame may begin: at once, or with the next edge of a line."""
        trigger = self._read_u32(xml.BASE, xml.TRIGGER)
        if not trigger & 1:
            return after_s
        line = self.lines.get(xml.LINES.get(trigger >> xml.SOURCE_SHIFT & 0xF, ""))
        rising = not trigger >> xml.FALLING_BIT & 1
        return float("inf") if line is None else line(after_s, rising)

    def _next_frame(self, timeout_s: float) -> bool:
        """Put the next frame on its way, waiting for it; return whether it came in time."""
        acquisition = self._acquisition
        if acquisition is None or not self._read_u32(SIRM, 0x04) & 1:
            return False
        if self.faults.strikes("late_frame", acquisition.block):
            acquisition.late_s = LATE_FRAME_S
        exposure_s = self._read_u32(xml.BASE, xml.EXPOSURE) * xml.EXPOSURE_TICK_US * 1e-6
        rate_hz = struct.unpack_from("<f", self._regions[xml.BASE], xml.FRAME_RATE)[0]
        period_s = max(exposure_s, 1 / max(rate_hz, 1e-3))
        triggered = self._read_u32(xml.BASE, xml.TRIGGER) & 1
        now_s = self._clock.now_s()
        ready_s = acquisition.next_start_s + exposure_s + acquisition.late_s
        if ready_s > now_s + timeout_s:
            return False
        self._clock.sleep(max(0.0, ready_s - now_s))
        acquisition.late_s = 0.0
        if not acquisition.single and not triggered:
            waiting = int((now_s - ready_s) / period_s) + 1 if now_s > ready_s else 1
            missed = max(0, waiting - HELD_FRAMES)
            acquisition.block += missed
            acquisition.next_start_s += missed * period_s
        if self.faults.strikes("dropped_frame", acquisition.block):
            acquisition.block += 1
            acquisition.next_start_s = self._trigger_s(acquisition.next_start_s + period_s)
        self._send(exposure_s, acquisition.block, acquisition.next_start_s)
        acquisition.block += 1
        after_s = exposure_s if triggered else period_s
        acquisition.next_start_s = self._trigger_s(acquisition.next_start_s + after_s)
        if acquisition.single:
            self._acquisition = None
        return True

    def _send(self, exposure_s: float, block: int, start_s: float) -> None:
        """Queue the transfers of a frame, as the faults leave them."""
        self.exposed_from_s = start_s
        form = BY_CODE[self._read_u32(xml.BASE, xml.PIXEL_FORMAT)]
        rows, columns, top, left = (
            self._read_u32(xml.BASE, offset)
            for offset in (xml.HEIGHT, xml.WIDTH, xml.OFFSET_Y, xml.OFFSET_X)
        )
        payload = memoryview(self._pixels(exposure_s, form, (top, left, rows, columns)))
        if self.faults.strikes("wrong_size", block):
            rows -= 2
            payload = payload[: len(payload) * rows // (rows + 2)]
        head = struct.pack("<IHHQHH", 0x4C563355, 0, LEADER_SIZE, block, 0, 0x0001)
        image = (form.code, columns, rows, left, top, 0, 0)
        leader = head + struct.pack("<QIIIIIHH", round(start_s * 1e9), *image)
        status = DISCARDED if self.faults.strikes("discarded", block) else OK
        trailer = struct.pack(
            "<IHHQHHQI", 0x54563355, 0, TRAILER_SIZE, block, status, 0, len(payload), rows
        )
        if self.faults.strikes("garbled_leader", block):
            leader = b"\0" + leader[1:]
        if self.faults.strikes("torn_payload", block):
            payload = payload[: len(payload) * 2 // 3 + 1]
        pieces = self._cut(payload)
        if self.faults.strikes("stall_stream", block):
            pieces.insert(len(pieces) // 2, b"stall")
        if self.faults.strikes("unplug_in_payload", block):
            pieces.insert(len(pieces) // 2, b"unplug")
        if not self.faults.strikes("lost_leader", block):
            self._messages.append(leader)
        self._messages.extend(pieces)
        if not self.faults.strikes("lost_trailer", block):
            self._messages.append(trailer)

    def _cut(self, payload: memoryview) -> list[bytes | memoryview]:
        transfer, count = self._read_u32(SIRM, 0x1C), self._read_u32(SIRM, 0x20)
        ends = [*(transfer * (i + 1) for i in range(count)), len(payload)]
        begins = [0, *ends]
        return [
            payload[begin:end]
            for begin, end in zip(begins, ends, strict=False)
            if begin < min(end, len(payload))
        ]

    def _pixels(self, exposure_s: float, form: PixelFormat, place: tuple) -> bytes:
        gain_db = struct.unpack_from("<i", self._regions[xml.BASE], xml.GAIN)[0] * xml.GAIN_STEP_DB
        mosaic = self._render(exposure_s)
        key = (form.code, place, gain_db)
        # A scene that stands still is packed once.
        if self._packed is not None and self._packed[0] is mosaic and self._packed[1] == key:
            return self._packed[2]
        top, left, rows, columns = place
        seen = mosaic[top : top + rows, left : left + columns]
        if gain_db:
            light = (seen.astype(np.float64) - self._black_level_dn) * 10 ** (gain_db / 20)
            white = (1 << self._bits) - 1
            seen = np.clip(np.rint(light + self._black_level_dn), 0, white).astype(np.uint16)
        shift = self._bits - form.bits
        data = pack(seen >> shift if shift > 0 else seen, form)
        self._packed = (mosaic, key, data)
        return data

    def _update_sizes(self) -> None:
        """Bring the registers up to date that follow from others."""
        form = BY_CODE[self._read_u32(xml.BASE, xml.PIXEL_FORMAT)]
        pixels = self._read_u32(xml.BASE, xml.WIDTH) * self._read_u32(xml.BASE, xml.HEIGHT)
        size = (pixels * form.stored_bits + 7) // 8
        self._write_u32(xml.BASE, xml.PAYLOAD, size)
        struct.pack_into("<Q", self._regions[SIRM], 0x08, size)
        black = round(self._black_level_dn * 16 * 2.0 ** (min(form.bits, self._bits) - self._bits))
        self._write_u32(xml.BASE, xml.BLACK_LEVEL, black)

    def _read_u32(self, base: int, offset: int) -> int:
        return struct.unpack_from("<I", self._regions[base], offset)[0]

    def _write_u32(self, base: int, offset: int, value: int) -> None:
        struct.pack_into("<I", self._regions[base], offset, value)

    def _abrm(self) -> bytearray:
        memory = bytearray(0x250)
        texts = {
            0x0004: self.spec.maker,
            0x0044: self.spec.model,
            0x0084: "Simulated",
            0x00C4: "1.0",
            0x0144: self.spec.serial,
        }
        for offset, text in texts.items():
            memory[offset : offset + len(text)] = text.encode()
        struct.pack_into("<I", memory, 0x0000, 0x00010001)
        struct.pack_into("<I", memory, 0x01CC, RESPONSE_MS)
        struct.pack_into("<QQ", memory, 0x01D0, MANIFEST, SBRM)
        return memory

    def _sbrm(self) -> bytearray:
        memory = bytearray(0x44)
        struct.pack_into("<I", memory, 0x00, 0x00010000)
        struct.pack_into("<Q", memory, 0x04, 0x1)
        struct.pack_into("<III", memory, 0x14, COMMAND_SIZE, ANSWER_SIZE, 1)
        struct.pack_into("<QI", memory, 0x20, SIRM, 0x30)
        struct.pack_into("<I", memory, 0x40, 0x8)
        return memory

    def _manifest(self) -> bytearray:
        file_format = (1 if self._zipped else 0) << 10 | 0x01010000
        digest = hashlib.sha1(self._file, usedforsecurity=False).digest()
        entry = struct.pack("<HBBIQQ20s20x", 0, 0, 1, file_format, FILE, len(self._file), digest)
        return bytearray(struct.pack("<Q", 1) + entry)


def pack(pixels: Array, form: PixelFormat) -> bytes:
    """Return uint16 pixels as a camera stores them, row after row without a gap."""
    flat = pixels.reshape(-1).astype(np.uint16)
    if form.stored_bits == 8:
        return flat.astype(np.uint8).tobytes()
    if form.stored_bits == 16:
        return flat.astype("<u2").tobytes()
    if form.packing == "p":
        bits = (flat[:, None] >> np.arange(form.bits, dtype=np.uint16)) & 1
        return np.packbits(bits.astype(np.uint8), bitorder="little").tobytes()
    pairs = np.append(flat, np.zeros(len(flat) % 2, np.uint16)).reshape(-1, 2)
    low_bits = form.bits - 8
    low = pairs & ((1 << low_bits) - 1)
    packed = np.stack(
        [pairs[:, 0] >> low_bits, low[:, 0] | low[:, 1] << 4, pairs[:, 1] >> low_bits], axis=1
    )
    return packed.astype(np.uint8).tobytes()[: form.row_bytes(len(flat))]


def _answer(status: int, command: int, request_id: int, data: bytes) -> bytes:
    head = struct.pack("<IHHHH", 0x43563355, status, command, len(data), request_id)
    return head + data


def _spec(packet: int) -> DeviceSpec:
    control = (EndpointSpec(COMMAND_OUT, packet_size=packet), EndpointSpec(ANSWER_IN, 2, packet))
    stream = (EndpointSpec(STREAM_IN, 2, packet),)
    return DeviceSpec(
        VENDOR,
        PRODUCT,
        "EMMC",
        "U3V simulator",
        SERIAL,
        (
            InterfaceSpec((0xEF, 0x05, 0x00), control, 0),
            InterfaceSpec((0xEF, 0x05, 0x02), stream, 1),
        ),
        kind=(0xEF, 0x02, 0x01),
        speed=SUPER_SPEED,
    )


def _zip(data: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("camera.xml", data)
    return buffer.getvalue()

"""Stream channel of a USB3 Vision camera: leader, payload and trailer put together to frames.

Source: USB3 Vision 1.0, streaming interface and its registers (SIRM).
"""

from __future__ import annotations

import array
import math
import threading
from contextlib import suppress
from dataclasses import dataclass

from emmc_rig.drivers import u3v_codec as codec
from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import (
    CameraDescriptionError,
    CameraFormatError,
    CaptureError,
    ExposureStoppedError,
    NoFrameError,
    UsbStalledError,
    UsbTimeoutError,
)
from emmc_rig.drivers.u3v_control import U3vControl
from emmc_rig.drivers.usb import TRANSFER_BYTES, UsbDevice, UsbPipe

PAYLOAD_LIMIT = 1 << 30
PACKET_LIMIT = 1 << 16
ALIGNMENT_LIMIT_BITS = 20
SLICE_S = 0.5
"""Longest single wait: Ctrl-C lands after the transfer in progress."""
SLOWEST_BYTES_S = 10e6
PAYLOAD_GRACE_S = 1.0
EMPTY_TRANSFERS_TOLERATED = 8

# Standard request to halt an endpoint (USB 2.0, 9.4.9).
TO_ENDPOINT, SET_FEATURE, ENDPOINT_HALT = 0x02, 0x03, 0

LOST_DATA_ADVICE = "use a faster port or a shorter cable, then capture it again"


@dataclass(frozen=True)
class StreamSizes:
    """Bytes of a frame's transfers, as host and camera agree on them.

    The payload is `count` transfers of `transfer` bytes and one of `final`.
    """

    leader: int
    payload: int
    trailer: int
    transfer: int
    count: int
    final: int


def plan_sizes(
    leader: int, payload: int, trailer: int, alignment: int, packet_size: int
) -> StreamSizes:
    """Return the transfers for what the camera requires; raises `CameraDescriptionError`."""
    for what, size, most in (
        ("leader", leader, PACKET_LIMIT),
        ("payload", payload, PAYLOAD_LIMIT),
        ("trailer", trailer, PACKET_LIMIT),
    ):
        if not 0 < size <= most:
            raise CameraDescriptionError(f"its stream has a {what} of {size} bytes")
    unit = math.lcm(alignment, packet_size)
    transfer = max(1, TRANSFER_BYTES // unit) * unit
    count, rest = divmod(payload, transfer)
    return StreamSizes(
        leader=_aligned(leader, alignment),
        payload=payload,
        trailer=_aligned(trailer, alignment),
        transfer=transfer,
        count=count,
        final=_aligned(rest, alignment),
    )


class U3vStream:
    """The stream interface: started with the sizes of the frames to come, then read.

    sirm: address of the streaming registers.
    """

    def __init__(
        self, device: UsbDevice, pipe: UsbPipe, control: U3vControl, sirm: int, clock: Clock
    ) -> None:
        self._device = device
        self._pipe = pipe
        self._control = control
        self._sirm = sirm
        self._clock = clock
        self._sizes = StreamSizes(1, 1, 1, 1, 1, 0)
        self._buffers: dict[int, array.array[int]] = {}
        self._frame = bytearray()
        self._next_leader: bytes | None = None
        self.stop_wanted = threading.Event()

    def start(self) -> StreamSizes:
        """Empty the endpoint, agree on sizes with the camera, enable the stream."""
        self.stop()
        info = self._control.integer(self._sirm + codec.SIRM_INFO, 4)
        if info >> 24 > ALIGNMENT_LIMIT_BITS:
            raise CameraDescriptionError(f"its stream is aligned to 2^{info >> 24} bytes")
        self._sizes = sizes = plan_sizes(
            self._control.integer(self._sirm + codec.SIRM_REQUIRED_LEADER, 4),
            self._control.integer(self._sirm + codec.SIRM_REQUIRED_PAYLOAD, 8),
            self._control.integer(self._sirm + codec.SIRM_REQUIRED_TRAILER, 4),
            1 << (info >> 24),
            self._pipe.packet_size,
        )
        for register, size in (
            (codec.SIRM_LEADER_SIZE, sizes.leader),
            (codec.SIRM_TRAILER_SIZE, sizes.trailer),
            (codec.SIRM_TRANSFER_SIZE, sizes.transfer),
            (codec.SIRM_TRANSFER_COUNT, sizes.count),
            (codec.SIRM_FINAL_1, sizes.final),
            (codec.SIRM_FINAL_2, 0),
        ):
            self._control.write(self._sirm + register, size.to_bytes(4, "little"))
        room = sizes.leader + sizes.payload + self._pipe.packet_size + sizes.trailer
        if len(self._frame) < room:
            self._frame = bytearray(room)
        self._buffers.clear()
        self._control.write(self._sirm + codec.SIRM_CONTROL, (1).to_bytes(4, "little"))
        return sizes

    def stop(self) -> None:
        """Disable the stream and forget what is still under way."""
        self._control.write(self._sirm + codec.SIRM_CONTROL, bytes(4))
        self._next_leader = None
        # Halting first makes the camera drop what it has queued; one that cannot is only cleared.
        with suppress(UsbStalledError):
            self._device.control(TO_ENDPOINT, SET_FEATURE, ENDPOINT_HALT, self._pipe.address)
        self._pipe.clear_halt()

    def receive(self, wait_s: float) -> bytes:
        """Return the next frame's leader, payload and trailer in one, waiting `wait_s` at most.

        Raises `CaptureError` for a frame that does not come whole, after which the next may be
        received; `ExposureStoppedError` soon after `stop_wanted` is set.
        """
        self.stop_wanted.clear()
        leader = self._leader(self._clock.now_s() + wait_s)
        size = codec.packet_size(leader)
        self._frame[:size] = leader[:size]
        sizes = self._sizes
        deadline_s = self._clock.now_s() + PAYLOAD_GRACE_S + sizes.payload / SLOWEST_BYTES_S
        end = self._payload(size, deadline_s)
        trailer = self._trailer(deadline_s)
        length = codec.packet_size(trailer)
        self._frame[end : end + length] = trailer[:length]
        frame = bytes(memoryview(self._frame)[: end + length])
        self._check(codec.decode_leader(leader), codec.decode_trailer(trailer), end - size)
        return frame

    def _leader(self, deadline_s: float) -> bytes:
        """Return the next leader, passing over what is left of frames before."""
        if self._next_leader is not None:
            leader, self._next_leader = self._next_leader, None
            return leader
        passed = 0
        room = self._sizes.leader
        while passed <= 2 * self._sizes.payload + self._sizes.transfer:
            raw = self._transfer(room, deadline_s, "no frame came", NoFrameError)
            leader = _leader_at_end(raw)
            if leader is not None:
                return leader
            passed += max(len(raw), self._pipe.packet_size)
            room = self._sizes.transfer
        raise CaptureError(f"no frame begins within {passed} bytes", "open the camera again")

    def _payload(self, begin: int, deadline_s: float) -> int:
        """Fill in the payload from `begin` on; return where it ends."""
        sizes, done = self._sizes, 0
        while done < sizes.payload:
            asked = min(sizes.transfer, sizes.payload - done)
            raw = self._transfer(
                asked, deadline_s, f"it stopped after {done} of {sizes.payload} bytes"
            )
            if _is_packet(raw):
                self._next_leader = _leader_at_end(raw)
                raise CaptureError(f"{done} of {sizes.payload} bytes came", advice=LOST_DATA_ADVICE)
            self._frame[begin + done : begin + done + len(raw)] = raw
            done += len(raw)
            if not raw or len(raw) % self._pipe.packet_size:
                break
        if done > sizes.payload:
            raise CaptureError(f"{done} bytes came instead of {sizes.payload}", "open it again")
        return begin + done

    def _trailer(self, deadline_s: float) -> bytes:
        for _ in range(EMPTY_TRANSFERS_TOLERATED):
            raw = self._transfer(self._sizes.trailer, deadline_s, "its end did not come")
            if not raw:
                continue
            if codec.begins_with(raw, codec.LEADER_PREFIX):
                self._next_leader = _leader_at_end(raw)
                raise CaptureError("its end did not come before the next", LOST_DATA_ADVICE)
            try:
                codec.decode_trailer(raw)
            except CameraFormatError as error:
                raise CaptureError(f"its end is garbled ({error.reason})") from error
            return raw.tobytes()
        raise CaptureError("empty packets came instead of its end")

    def _check(self, leader: codec.Leader, trailer: codec.Trailer, received: int) -> None:
        if trailer.block_id != leader.block_id:
            raise CaptureError(
                f"it begins as frame {leader.block_id} and ends as {trailer.block_id}",
                LOST_DATA_ADVICE,
            )
        if trailer.status:
            meaning, advice = codec.STATUS.get(trailer.status, codec.UNKNOWN_STATUS)
            raise CaptureError(f"the camera says {meaning} ({trailer.status:#06x})", advice)
        if trailer.valid_bytes > received:
            raise CaptureError(f"{received} of {trailer.valid_bytes} bytes came", LOST_DATA_ADVICE)
        if trailer.lines is not None and trailer.lines < leader.height:
            raise CaptureError(f"it has {trailer.lines} of {leader.height} lines", LOST_DATA_ADVICE)

    def _transfer(
        self,
        size: int,
        deadline_s: float,
        complaint: str,
        late: type[CaptureError] = CaptureError,
    ) -> memoryview:
        """Return what one transfer of at most `size` bytes, rounded up, brings.

        late: raised after the deadline, with the complaint.
        """
        room = self._pipe.whole_packets(size)
        if room not in self._buffers:
            self._buffers[room] = array.array("B", bytes(room))
        buffer = self._buffers[room]
        while True:
            left_s = deadline_s - self._clock.now_s()
            if left_s <= 0:
                raise late(f"{complaint} in time", "check the trigger and the cable")
            try:
                count = self._pipe.read_into(buffer, min(left_s, SLICE_S))
            except UsbTimeoutError:
                if self.stop_wanted.is_set():
                    raise ExposureStoppedError(self._device.name) from None
                continue
            except UsbStalledError as error:
                self._pipe.clear_halt()
                raise CaptureError("the camera halted its stream") from error
            return memoryview(buffer)[:count]


def _is_packet(raw: memoryview) -> bool:
    """Whether a transfer is a leader or trailer instead of pixels."""
    prefixes = (codec.LEADER_PREFIX, codec.TRAILER_PREFIX)
    return (
        8 <= len(raw) <= 1024
        and any(codec.begins_with(raw, prefix) for prefix in prefixes)
        and codec.packet_size(raw) == len(raw)
    )


def _leader_at_end(raw: memoryview) -> bytes | None:
    """Return the leader that a transfer is, or that ends it after the rest of a frame."""
    for at in (0, len(raw) - codec.LEADER_SIZE):
        with suppress(CameraFormatError):
            codec.decode_leader(raw[at:])
            return raw[at:].tobytes()
    return None


def _aligned(size: int, alignment: int) -> int:
    return -(-size // alignment) * alignment

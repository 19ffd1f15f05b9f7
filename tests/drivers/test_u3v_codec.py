"""USB3 Vision wire format, by transcript: the bytes are the standard's, not our encoder's."""

import pytest

from emmc_rig.drivers.errors import CameraFormatError
from emmc_rig.drivers.u3v_codec import (
    IMAGE,
    READMEM_ACK,
    Acknowledge,
    Leader,
    Trailer,
    decode_acknowledge,
    decode_leader,
    decode_manifest_entry,
    decode_trailer,
    encode_read,
    encode_write,
    split_frame,
    text,
)

# Fields as Wireshark's dissector packet-u3v.c lists them: prefix "U3VC", flags, command, length
# and request id, little endian, then address and data.
READ_SBRM = bytes.fromhex("55335643 0040 0008 0c00 0100 d801000000000000 0000 0800")
WRITE_ENABLE = bytes.fromhex("55335643 0040 0208 0c00 feff 0400020000000000 01000000")
ANSWER_SBRM = bytes.fromhex("55335643 0000 0108 0800 0100 0000010000000000")
WRITTEN = bytes.fromhex("55335643 0000 0308 0400 feff 0000 0400")
PENDING = bytes.fromhex("55335643 0000 0508 0400 0700 0000 e803")
REFUSED = bytes.fromhex("55335643 0380 0108 0000 0200")

# "U3VL", reserved, size 52, block 9, reserved, image, 1.5 s, BayerRG12p, 640 x 480 from (16, 8).
LEADER = bytes.fromhex(
    "5533564c 0000 3400 0900000000000000 0000 0100 002f685900000000"
    "59000c01 80020000 e0010000 10000000 08000000 0000 0000"
)
# "U3VT", reserved, size 32, block 9, status, reserved, 460800 bytes, 480 lines.
TRAILER = bytes.fromhex("55335654 0000 2000 0900000000000000 0000 0000 0008070000000000 e0010000")
MANIFEST = bytes.fromhex(
    "0300 02 01 00040101 0000040000000000 ec06000000000000"
    "000102030405060708090a0b0c0d0e0f10111213 0000000000000000000000000000000000000000"
)


def test_commands_are_written_as_in_the_standard():
    assert encode_read(1, 0x1D8, 8) == READ_SBRM
    assert encode_write(0xFFFE, 0x20004, (1).to_bytes(4, "little")) == WRITE_ENABLE


@pytest.mark.parametrize(
    ("wire", "message"),
    [
        (ANSWER_SBRM, Acknowledge(0, 0x0801, 1, (0x10000).to_bytes(8, "little"))),
        (WRITTEN, Acknowledge(0, 0x0803, 0xFFFE, bytes((0, 0, 4, 0)))),
        (REFUSED, Acknowledge(0x8003, READMEM_ACK, 2, b"")),
    ],
)
def test_every_acknowledge_is_read(wire, message):
    assert decode_acknowledge(wire) == message


def test_a_pending_acknowledge_says_how_long():
    assert decode_acknowledge(PENDING).pending_s == 1.0


@pytest.mark.parametrize(
    ("request_id", "address", "length", "complaint"),
    [
        (0, 0, 4, "request id 0"),
        (0x10000, 0, 4, "request id"),
        (1, 1 << 64, 4, "64 bits"),
        (1, -1, 4, "64 bits"),
        (1, 0, 0, "0 bytes"),
        (1, 0, 1 << 16, "65536 bytes"),
    ],
)
def test_a_command_that_the_format_cannot_carry_is_refused(request_id, address, length, complaint):
    with pytest.raises(ValueError, match=complaint):
        encode_read(request_id, address, length)


@pytest.mark.parametrize(
    ("wire", "complaint"),
    [
        (b"", "no acknowledge"),
        (ANSWER_SBRM[:11], "11 bytes"),
        (b"X" + ANSWER_SBRM[1:], "prefix"),
        (ANSWER_SBRM[:-1], "announces 8 bytes of data and has 7"),
        (ANSWER_SBRM + b"\0", "announces 8 bytes of data and has 9"),
        (READ_SBRM, "no acknowledge"),
        (PENDING[:8] + b"\0\0" + PENDING[10:12], "pending acknowledge with 0 bytes"),
    ],
)
def test_a_garbled_acknowledge_is_reported(wire, complaint):
    with pytest.raises(CameraFormatError, match=complaint):
        decode_acknowledge(wire)


def test_a_leader_is_read():
    assert decode_leader(LEADER) == Leader(9, IMAGE, 1_500_000_000, 0x010C0059, 640, 480, 16, 8, 0)


def test_a_trailer_is_read_with_and_without_lines():
    assert decode_trailer(TRAILER) == Trailer(9, 0, 460_800, 480)
    short = TRAILER[:6] + b"\x1c\0" + TRAILER[8:28]
    assert decode_trailer(short) == Trailer(9, 0, 460_800, None)


@pytest.mark.parametrize(
    ("wire", "complaint"),
    [
        (TRAILER, "no leader"),
        (LEADER[:51], "no leader"),
        (LEADER[:6] + b"\xff\0" + LEADER[8:], "leader of 255 bytes"),
        (LEADER[:18] + b"\2\0" + LEADER[20:], "payload type 0x0002"),
    ],
)
def test_what_is_no_leader_is_reported(wire, complaint):
    with pytest.raises(CameraFormatError, match=complaint):
        decode_leader(wire)


def test_a_recorded_frame_comes_apart_again():
    payload = bytes(range(256)) * 4
    leader, middle, trailer = split_frame(LEADER + payload + TRAILER)
    assert (leader.block_id, trailer.block_id) == (9, 9)
    assert middle == payload


@pytest.mark.parametrize("cut", [1, 31, 33, 200])
def test_a_torn_recorded_frame_is_reported(cut):
    with pytest.raises(CameraFormatError):
        split_frame((LEADER + bytes(500) + TRAILER)[:-cut])


def test_the_end_of_another_frame_is_not_taken_for_the_own():
    other = TRAILER[:8] + b"\x0a" + TRAILER[9:]
    with pytest.raises(CameraFormatError, match="does not end with its trailer"):
        split_frame(LEADER + bytes(100) + other)


def test_a_manifest_entry_is_read():
    entry = decode_manifest_entry(MANIFEST)
    assert entry.version == (1, 2, 3)
    assert (entry.file_type, entry.file_format) == (0, 1)
    assert (entry.address, entry.size) == (0x40000, 0x6EC)
    assert entry.sha1 == bytes(range(20))


def test_a_text_register_ends_at_its_first_zero():
    assert text(b"EMMC\0junk") == "EMMC"
    assert text(b"\xff\xfe full") == "�� full"

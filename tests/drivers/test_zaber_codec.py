"""Zaber wire format, by transcript: the bytes are those of the protocol, not of our encoder.

Lines marked with a section are examples of the ASCII Protocol Manual, as far as they were seen
quoted; the others were seen with a running client, or are built by the manual's rules.
"""

import pytest

from emmc_rig.drivers.errors import GarbledReplyError
from emmc_rig.drivers.zaber_codec import Reply, decode_message, encode_command


@pytest.mark.parametrize(
    ("arguments", "wire"),
    [
        ((1, 1, 10, "move abs 1000"), b"/1 1 10 move abs 1000:EF\n"),
        ((1, 0, 1, ""), b"/1 0 01:FE\n"),
    ],
)
def test_a_command_is_written_with_address_axis_id_and_checksum(arguments, wire):
    assert encode_command(*arguments) == wire


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((100, 1, 1, "home"), "device address"),
        ((1, 10, 1, "home"), "axis number"),
        ((1, 1, 0, "home"), "message id"),
        ((1, 1, 100, "home"), "message id"),
        ((1, 1, 1, "home\n/1 1 2 move abs 5"), "plain printable"),
        ((1, 1, 1, "move abs 5:00"), "plain printable"),
    ],
)
def test_a_command_the_format_cannot_carry_is_refused(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        encode_command(*arguments)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        # "Replies": the answer to `/1 move abs 10000`
        (
            b"@01 0 OK IDLE -- 0\r\n",
            Reply(1, 0, None, accepted=True, busy=False, flag="--", data="0"),
        ),
        # `home`: the answer to `/ home` before the axis has a reference
        (
            b"@01 0 OK BUSY WR 0\r\n",
            Reply(1, 0, None, accepted=True, busy=True, flag="WR", data="0"),
        ),
        (
            b"@01 1 10 OK BUSY -- 0\r\n",
            Reply(1, 1, 10, accepted=True, busy=True, flag="--", data="0"),
        ),
        (
            b"@02 1 07 OK IDLE WR 02 WR WH\r\n",
            Reply(2, 1, 7, accepted=True, busy=False, flag="WR", data="02 WR WH"),
        ),
        (
            b"@01 2 99 RJ IDLE -- BADDATA\r\n",
            Reply(1, 2, 99, accepted=False, busy=False, flag="--", data="BADDATA"),
        ),
        (
            b"@01 0 OK IDLE -- 104231 -5\n",
            Reply(1, 0, None, accepted=True, busy=False, flag="--", data="104231 -5"),
        ),
        (b"!01 1 IDLE FS\r\n", None),
        (b"#01 0 03 ranges: 0 to 5\r\n", None),
    ],
)
def test_replies_are_read_and_what_comes_unasked_is_none(line, message):
    assert decode_message(line) == message


def test_a_reply_with_the_right_checksum_is_read():
    # The bytes of "01 1 10 OK BUSY -- 0" sum to 1050 = 4 * 256 + 26, and 256 - 26 = 0xE6.
    reply = decode_message(b"@01 1 10 OK BUSY -- 0:E6\r\n", checksum_required=True)
    assert reply == Reply(1, 1, 10, accepted=True, busy=True, flag="--", data="0")


@pytest.mark.parametrize("position", range(1, 20))
def test_any_flipped_bit_in_a_checksummed_reply_is_noticed(position):
    line = bytearray(b"@01 1 10 OK BUSY -- 0:E6\r\n")
    line[position] ^= 0x01
    with pytest.raises(GarbledReplyError, match="checksum is wrong"):
        decode_message(bytes(line))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"", "not a Zaber message"),
        (b"ok\r\n", "not a Zaber message"),
        (b"@01 1 10 OK BUSY -- 0", "not a Zaber message"),
        (b"@01 1 10 OK\r\n", "not a reply"),
        (b"@01 1 10 OK BUSY -- 0\n\n", "not a Zaber message"),
        (b"@01 1 10 OK BUSY -- \xff\r\n", "not plain text"),
    ],
)
def test_bytes_that_are_no_message_are_an_error_in_one_line(line, reason):
    with pytest.raises(GarbledReplyError, match=reason) as caught:
        decode_message(line)
    assert "\n" not in str(caught.value)
    assert caught.value.raw == line


def test_a_missing_checksum_is_an_error_only_where_one_is_promised():
    line = b"@01 1 10 OK BUSY -- 0\r\n"
    assert isinstance(decode_message(line), Reply)
    with pytest.raises(GarbledReplyError, match="missing"):
        decode_message(line, checksum_required=True)

"""APT wire format, by transcript.

Bytes marked with a message are examples for it: of Thorlabs' protocol document, as far as they
were seen quoted, or of an independent implementation's documentation (thorlabs-apt-protocol).
"""

import struct

import pytest

from emmc_rig.drivers import apt_codec as codec
from emmc_rig.drivers.apt_codec import (
    Complaint,
    Id,
    Message,
    MotorStatus,
    StatusBit,
)
from emmc_rig.drivers.errors import GarbledReplyError


@pytest.mark.parametrize(
    ("arguments", "wire"),
    [
        # MOT_MOVE_HOME of channel 1 of a unit on USB (thorlabs-apt-protocol, README)
        ((Id.MOT_MOVE_HOME, 0x50, 1), "43 04 01 00 50 01"),
        # MOT_MOVE_STOP, profiled (seen with a running program)
        ((Id.MOT_MOVE_STOP, 0x50, 1, codec.STOP_PROFILED), "65 04 01 02 50 01"),
        # MOD_SET_CHANENABLESTATE, enable
        ((Id.MOD_SET_CHANENABLESTATE, 0x50, 1, codec.ENABLE), "10 02 01 01 50 01"),
        ((Id.HW_REQ_INFO, 0x50), "05 00 00 00 50 01"),
        ((Id.MOT_REQ_DCSTATUSUPDATE, 0x50, 1), "90 04 01 00 50 01"),
        ((Id.MOT_ACK_DCSTATUSUPDATE, 0x21), "92 04 00 00 21 01"),
    ],
)
def test_a_short_message_is_id_two_parameters_destination_and_source(arguments, wire):
    assert codec.encode(*arguments) == bytes.fromhex(wire)


def test_a_message_with_data_flags_its_destination_and_states_the_length():
    # MOT_MOVE_ABSOLUTE to 2048 counts (thorlabs-apt-protocol, README)
    data = codec.encode_position(1, 2048)
    wire = bytes.fromhex("53 04 06 00 d0 01 01 00 00 08 00 00")
    assert codec.encode(Id.MOT_MOVE_ABSOLUTE, 0x50, data=data) == wire
    assert codec.decode(wire) == Message(Id.MOT_MOVE_ABSOLUTE, 0, 0, 0x50, 1, data)


def test_a_status_update_is_read_with_a_signed_velocity():
    # MOT_GET_DCSTATUSUPDATE: channel, position, velocity, reserved, status bits
    data = bytes.fromhex("01 00 40 0d 03 00 fe ff 00 00 10 05 00 80")
    wire = bytes.fromhex("91 04 0e 00 81 50") + data
    status = codec.decode_status(codec.decode(wire))
    assert status == MotorStatus(1, 200_000, -2, 0x80000510)
    bits = StatusBit(status.bits)
    assert bits & StatusBit.ENABLED
    assert bits & StatusBit.HOMED
    assert bits & StatusBit.CONNECTED
    assert bits & StatusBit.MOVING_A
    assert not bits & StatusBit.HOMING


def test_hardware_information_is_read():
    data = struct.pack("<I8sH4B60sHHH", 27_255_354, b"KDC101\0\0", 16, 4, 3, 2, 0, b"", 1, 3, 1)
    assert len(data) == 84
    info = codec.decode_info(Message(Id.HW_GET_INFO, 0, 0, 1, 0x50, data))
    assert (info.serial_number, info.model, info.firmware) == (27_255_354, "KDC101", "2.3.4")
    assert info.channels == 1


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (
            Message(Id.HW_RICHRESPONSE, 0, 0, 1, 0x50, b"\x53\4\x08\0" + b"far\0junk".ljust(64)),
            Complaint(Id.MOT_MOVE_ABSOLUTE, 8, "far"),
        ),
        (Message(Id.HW_RESPONSE, 7, 0, 1, 0x50), Complaint(0, 7, "a fault without a description")),
    ],
)
def test_a_complaint_is_read_with_and_without_words(message, complaint):
    assert codec.decode_complaint(message) == complaint


def test_velocity_and_acceleration_have_the_documented_scale():
    # "Scaling parameters", TDC001 and KDC101 with a Z8 motor: 34304 counts, 767367.49 and 261.93
    # units for a millimetre, a millimetre per second, and a millimetre per second squared
    assert codec.velocity_units(1000.0, 34.304) == pytest.approx(767_367.49, abs=0.01)
    assert codec.acceleration_units(1000.0, 34.304) == pytest.approx(261.93, abs=0.01)


@pytest.mark.parametrize(
    ("wire", "reason"),
    [
        ("", "shorter than a header"),
        ("90 04 01", "shorter than a header"),
        ("00 00 01 00 01 50", "no message has the id"),
        ("90 f4 01 00 01 50", "no message has the id"),
        ("91 04 0e 00 81 77", "no device has that address"),
        ("91 04 0e 00 e1 50", "no device has that address"),
        ("91 04 0e 01 81 50", "270 bytes of data"),
        ("91 04 0e 00 81 50 01", "1 bytes of data, not 14"),
        ("44 04 01 00 01 50 00", "1 bytes of data, not 0"),
    ],
)
def test_bytes_that_are_no_message_are_an_error_in_one_line(wire, reason):
    with pytest.raises(GarbledReplyError, match=reason) as caught:
        codec.decode(bytes.fromhex(wire))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "decode", [codec.decode_status, codec.decode_velocity, codec.decode_home, codec.decode_info]
)
def test_data_of_the_wrong_length_is_an_error(decode):
    for data in (None, b"", b"\0" * 13):
        with pytest.raises(GarbledReplyError, match="bytes of data expected"):
            decode(Message(Id.MOT_GET_DCSTATUSUPDATE, 0, 0, 1, 0x50, data))


def test_numbers_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="no APT message can carry"):
        codec.encode_position(1, 2**31)
    with pytest.raises(ValueError, match="no APT message can carry"):
        codec.encode(Id.MOT_MOVE_HOME, 0x50, 256)
    with pytest.raises(ValueError, match="more than 255"):
        codec.encode(Id.MOT_MOVE_HOME, 0x50, data=b"\0" * 256)

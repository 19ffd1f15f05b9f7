"""PTP's wire format, against bytes that another program's camera sent, and against itself.

The answers marked `heard` were recorded from libgphoto2 2.5's virtual camera.
"""

from contextlib import suppress

import pytest

from emmc_rig.drivers import ptp_codec as codec
from emmc_rig.drivers.errors import CameraFormatError
from emmc_rig.drivers.ptp_codec import Kind, Message, Operation

HEARD_HANDLES = bytes.fromhex("1c000000 0200 0710 02000000 03000000 03000000 02000000 01000000")
HEARD_RESPONSE = bytes.fromhex("0c000000 0300 0120 02000000")
HEARD_OBJECT_ADDED = bytes.fromhex("10000000 0400 0240 06000000 05000000")
HEARD_SHUTTER = bytes.fromhex(
    "0d50 0600 01 64000000 64000000 02 0900"
    "10270000 e8030000 f4010000 c8000000 64000000 32000000 19000000 0c000000 01000000"
)
HEARD_BATTERY = bytes.fromhex("0150 0200 00 32 32 01 00 64 01")
HEARD_OBJECT = bytes.fromhex(
    "01000100 1138 0000 30110000 0000 00000000 00000000 00000000 00000000 00000000 00000000"
    "00000000 0000 00000000 00000000"
    "06 62002e0064006e006700 0000"
    "10 3200300032003600310031003200310054003000310031003400300031000000"
    "10 3200300032003600310031003200310054003000310031003400300031000000"
    "08 6b006500790077006f00720064000000"
)
HEARD_DEVICE = bytes.fromhex(
    "6400 0a000000 6400 0a 47002d0056003a00200031002e0030003b000000 0000"
    "11000000 0110 0210 0310 0410 0510 0610 0710 0810 0910 0a10 0b10 0e10 1410 1510 1610 9999 c290"
    "05000000 0240 0340 0640 0a40 0d40 06000000 0150 0350 0750 1050 0d50 1150"
    "01000000 0138 01000000 0138"
    "03 470050000000 03 560043000000 07 32002e0035002e00310031000000 04 30002e0031000000"
    "02 31000000"
)


def test_a_command_is_written_as_the_standard_says():
    command = Message(Kind.COMMAND, Operation.GET_OBJECT_INFO, 7, (0x11,))
    assert codec.encode_message(command).hex() == "10000000010008100700000011000000"


def test_a_heard_response_is_read():
    assert codec.decode_message(HEARD_RESPONSE) == Message(Kind.RESPONSE, 0x2001, 2)


def test_a_heard_event_is_read():
    event = codec.decode_message(HEARD_OBJECT_ADDED)
    assert event == Message(Kind.EVENT, codec.EventCode.OBJECT_ADDED, 6, (5,))


def test_heard_handles_are_read():
    header = codec.decode_header(HEARD_HANDLES)
    assert (header.kind, header.code, header.payload_length) == (Kind.DATA, 0x1007, 16)
    assert codec.decode_handles(HEARD_HANDLES[codec.HEADER_SIZE :]) == (3, 2, 1)
    assert codec.encode_data(0x1007, 2, codec.encode_handles((3, 2, 1))) == HEARD_HANDLES


def test_a_heard_device_says_who_it_is():
    info = codec.DeviceInfo.decode(HEARD_DEVICE)
    assert (info.maker, info.model, info.version, info.serial) == ("GP", "VC", "2.5.11", "0.1")
    assert info.vendor_extension_text == "G-V: 1.0;"
    assert Operation.INITIATE_CAPTURE in info.operations
    assert codec.Property.EXPOSURE_TIME in info.properties


def test_a_heard_object_is_a_dng_of_its_size():
    info = codec.ObjectInfo.decode(HEARD_OBJECT)
    assert (info.name, info.format, info.size) == ("b.dng", codec.Format.DNG, 4400)
    assert info.captured == "20261121T011401"
    assert info.encode() == HEARD_OBJECT


def test_a_heard_shutter_lists_its_speeds():
    described = codec.decode_description(HEARD_SHUTTER)
    assert described.writable
    assert described.choices == (10000, 1000, 500, 200, 100, 50, 25, 12, 1)
    assert codec.limits(described, frozenset()) == (1, 10000)
    assert codec.encode_description(described) == HEARD_SHUTTER


def test_a_heard_battery_has_a_range():
    described = codec.decode_description(HEARD_BATTERY)
    assert not described.writable
    assert described.span == (0, 100, 1)
    assert codec.encode_description(described) == HEARD_BATTERY


def described(**form):
    return codec.PropertyDescription(0x500D, 6, True, 100, 100, **form)


@pytest.mark.parametrize(
    ("target", "taken"), [(100, 100), (139, 100), (143, 200), (1e9, 200), (0.001, 25)]
)
def test_the_nearest_choice_is_nearest_in_ratio(target, taken):
    property_ = described(choices=(200, 25, 100, 0xFFFFFFFF, 0))
    assert codec.nearest(property_, target, frozenset((0xFFFFFFFF,))) == taken


@pytest.mark.parametrize(("target", "taken"), [(7, 5), (8, 10), (-50, 5), (5e9, 95)])
def test_the_nearest_step_of_a_range_lies_within_it(target, taken):
    assert codec.nearest(described(span=(5, 95, 5)), target, frozenset()) == taken


def test_a_property_that_is_no_number_is_refused():
    with pytest.raises(CameraFormatError, match="are no numbers"):
        codec.decode_description(HEARD_SHUTTER[:2] + b"\xff\xff" + HEARD_SHUTTER[4:])
    with pytest.raises(CameraFormatError, match="longer than the data"):
        codec.decode_handles(b"\xff" * 8)


def test_a_property_without_a_form_can_be_what_it_is():
    assert codec.limits(described(), frozenset()) == (100, 100)


@pytest.mark.parametrize("kept", range(0, len(HEARD_OBJECT), 5))
def test_a_dataset_that_ends_too_early_is_refused_or_lacks_only_texts(kept):
    numbers = 52
    if kept < numbers:
        with pytest.raises(CameraFormatError, match="too early"):
            codec.ObjectInfo.decode(HEARD_OBJECT[:kept])
        return
    with suppress(CameraFormatError):
        assert codec.ObjectInfo.decode(HEARD_OBJECT[:kept]).size == 4400


@pytest.mark.parametrize(
    "damaged",
    [
        b"",
        HEARD_RESPONSE[:11],
        HEARD_RESPONSE[:-1] + b"\x00\x00",
        b"\x0b" + HEARD_RESPONSE[1:],
        HEARD_RESPONSE[:4] + b"\x09" + HEARD_RESPONSE[5:],
        HEARD_HANDLES,
    ],
)
def test_what_is_no_message_is_refused(damaged):
    with pytest.raises(CameraFormatError):
        codec.decode_message(damaged)


def test_more_than_five_parameters_or_a_value_that_does_not_fit_are_the_callers_fault():
    with pytest.raises(ValueError, match="more than PTP's 5"):
        codec.encode_message(Message(Kind.COMMAND, 0x1001, 1, (0,) * 6))
    with pytest.raises(ValueError, match="no value of type"):
        codec.encode_value(4, 70_000)

"""Grbl wire format, by transcript: the bytes are those of Grbl v1.1's documentation.

Lines marked with a section are the section's examples; other lines follow its rules.
"""

import pytest

from emmc_rig.drivers.errors import GarbledReplyError
from emmc_rig.drivers.grbl_codec import (
    Alarm,
    Banner,
    Feedback,
    Ok,
    Refusal,
    Setting,
    Status,
    decode_line,
    encode_line,
    jog,
)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        # "Interface", Grbl Response Messages
        (b"ok\r\n", Ok()),
        (b"error:15\r\n", Refusal(15)),
        # "Interface", Start Up Message and Alarm Message
        (b"Grbl 1.1e ['$' for help]\r\n", Banner("1.1e")),
        (b"\rGrbl 1.1h ['$' for help]\r\n", Banner("1.1h")),
        (b"ALARM:1\r\n", Alarm(1)),
        # "Interface", Grbl $ Settings Message
        (b"$10=255\r\n", Setting(10, "255")),
        (b"$110=500.000\r\n", Setting(110, "500.000")),
        (b"$302=192.168.5.1\r\n", Setting(302, "192.168.5.1")),
        (b"$N0=G54\r\n", None),
        # "Interface", Feedback Messages
        (b"[MSG:Reset to continue]\r\n", Feedback("MSG", "Reset to continue")),
        (b"[MSG:'$H'|'$X' to unlock]\r\n", Feedback("MSG", "'$H'|'$X' to unlock")),
        (
            b"[GC:G0 G54 G17 G21 G90 G94 M0 M5 M9 T0 F0. S0.]\r\n",
            Feedback("GC", "G0 G54 G17 G21 G90 G94 M0 M5 M9 T0 F0. S0."),
        ),
        (b"[VER:v1.1d.20161014:Some string]\r\n", Feedback("VER", "v1.1d.20161014:Some string")),
        (b"[OPT:VL]\r\n", Feedback("OPT", "VL")),
        (b"[PRB:0.000,0.000,0.000:0]\r\n", Feedback("PRB", "0.000,0.000,0.000:0")),
        # "Interface", Startup Line Execution
        (b">G54G20:ok\r\n", None),
        (b"\r\n", None),
    ],
)
def test_every_kind_of_message_is_read(line, message):
    assert decode_line(line) == message


@pytest.mark.parametrize(
    ("line", "status"),
    [
        # Fields by "Interface", Real-time Status Reports: state first, then the position
        (
            b"<Idle|MPos:0.000,-10.000,5.000|FS:0,0>\r\n",
            Status("Idle", None, (0.0, -10.0, 5.0), None, None),
        ),
        (
            b"<Run|WPos:-2.500,0.000,11.000|Bf:15,128|FS:500,8000|WCO:0.000,1.551,5.664>\r\n",
            Status("Run", None, None, (-2.5, 0.0, 11.0), (0.0, 1.551, 5.664)),
        ),
        (
            b"<Hold:1|MPos:0.000,0.000,0.000|F:500|Pn:PZ|Ov:100,100,100|A:SFM>\r\n",
            Status("Hold", 1, (0.0, 0.0, 0.0), None, None, pressed=("Z",)),
        ),
        (
            b"<Door:3|MPos:1.000,2.000,3.000,4.000|Ln:99999>\r\n",
            Status("Door", 3, (1.0, 2.0, 3.0, 4.0), None, None),
        ),
        # Some firmware reports a fourth axis, and an offset of three
        (
            b"<Idle|MPos:1.000,2.000,3.000,0.000|WCO:-5.000,-2.000,0.000>\r\n",
            Status("Idle", None, (1.0, 2.0, 3.0, 0.0), None, (-5.0, -2.0, 0.0)),
        ),
    ],
)
def test_a_status_report_is_read_field_by_field(line, status):
    assert decode_line(line) == status


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"", "not one line"),
        (b"ok", "not one line"),
        (b"ok\nok\n", "not one line"),
        (b"okay\r\n", "not a Grbl message"),
        (b"error:\r\n", "not a Grbl message"),
        (b"\xffok\r\n", "not plain text"),
        (b"o\x07k\r\n", "not printable"),
        (b"<Idle|MPos:0.000,0.000,0.000|FS:0,0\r\n", "not a status report"),
        (b"<Sing|MPos:0.000,0.000,0.000>\r\n", "not a status report"),
        (b"<Idle|FS:0,0>\r\n", "neither"),
        (b"<Idle|MPos:0.000|MPos:1.000>\r\n", "twice"),
        (b"<Idle|MPos:0.000,,0.000>\r\n", "not a number"),
        (b"<Idle|MPos:0.0.0,1.000>\r\n", "not a number"),
        (b"<Idle|MPos:nan,0.000>\r\n", "not a number"),
        (b"<Idle|WPos:1.000,0.000|WCO:0.000>\r\n", "different length"),
    ],
)
def test_bytes_that_are_no_message_are_an_error_in_one_line(line, reason):
    with pytest.raises(GarbledReplyError, match=reason) as caught:
        decode_line(line)
    assert "\n" not in str(caught.value)


def test_a_jog_is_in_millimetres_and_machine_coordinates_with_its_own_feed():
    # "Jogging": $J= first, then G53 for machine coordinates, an axis word, and F in each line
    assert jog({"X": -12.3456, "Y": 5.0}, 480.0) == "$J=G53G90G21X-12.3456Y5.0000F480.000"
    assert encode_line(jog({"Y": 5.0}, 60.0)) == b"$J=G53G90G21Y5.0000F60.000\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("G1 X5\nG1 X6", "plain printable"),
        ("?", "without"),
        ("G1 X5!", "without"),
        ("G0 X\u00b5", "plain printable"),
        ("X" * 80, "longer than 79"),
    ],
)
def test_a_line_that_grbl_would_misread_is_refused(text, complaint):
    with pytest.raises(ValueError, match=complaint):
        encode_line(text)

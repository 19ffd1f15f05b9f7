"""Simulated firmware byte by byte and second by second, as the makers' manuals have it.

Nothing of the simulators' or the drivers' own constants is used: checksums, units and codes are
written out here from the manuals, so that an error that both share does not cancel.
"""

import re
import struct
from itertools import pairwise

import pytest

from emmc_rig.simulators.apt import AptController
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.grbl import GrblController
from emmc_rig.simulators.motion import AxisSpec
from emmc_rig.simulators.zaber import ZaberChain


class Wire:
    """A controller and its clock; a call sends bytes and returns all answers until a time."""

    def __init__(self, make, *arguments, **settings):
        self.clock = ManualClock()
        self.device = make(self.clock, *arguments, **settings)
        self.device.due()

    def __call__(self, data, after_s=0.0):
        said = self.device.feed(data)
        end_s = self.clock.now_s() + after_s
        # From event to event: firmware acts at the time of an event, not at the end of a sleep.
        while (next_s := self.device.next_due_s()) is not None and next_s < end_s:
            self.clock.sleep(max(0.0, next_s - self.clock.now_s()) + 1e-9)
            said += self.device.due()
        self.clock.sleep(max(0.0, end_s - self.clock.now_s()))
        return said + self.device.due()


# Zaber ASCII Protocol Manual: "Message Format", "Message Checksums", "Warning Flags"; settings
# `maxspeed` (microsteps/s x 1.6384) and `accel` (microsteps/s^2 x 1.6384 / 10000).

STEP_UM = 0.25
ZABER_AXIS = AxisSpec(
    travel_um=50_000.0, microstep_um=STEP_UM, max_speed_um_s=25_000.0,
    acceleration_um_s2=250_000.0, start_um=1_000.0, backlash_um=0.0,
)  # fmt: skip


def checked(body):
    """A Zaber message without its kind and end, with the checksum of the manual's example code."""
    total = 0
    for byte in body:
        total = (total + byte) & 0xFF
    return b"%b:%02X" % (body, (total ^ 0xFF) + 1 & 0xFF)


class Zaber(Wire):
    def __init__(self, **settings):
        super().__init__(ZaberChain, {(1, 1): ZABER_AXIS, (1, 2): ZABER_AXIS}, **settings)

    def ask(self, body, after_s=0.0):
        """Send a command without `/`; return the replies without `@`, checksum and end."""
        said = self(b"/" + checked(body.encode()) + b"\n", after_s)
        replies = []
        for line in said.splitlines():
            assert line == line[:1] + checked(line[1 : line.rindex(b":")])
            replies.append(line[: line.rindex(b":")].decode())
        return replies

    def data(self, body):
        (reply,) = self.ask(body)
        return reply.split(" ", 6)[6]


@pytest.fixture
def zaber():
    return Zaber()


@pytest.fixture
def homed_zaber(zaber):
    zaber.ask("1 0 1 home", after_s=60.0)
    return zaber


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("1 1 10", "@01 1 10 OK IDLE WR 0"),
        ("1 0 07", "@01 0 07 OK IDLE WR 0"),
        ("1 1", "@01 1 OK IDLE WR 0"),
        ("1 1 11 warnings", "@01 1 11 OK IDLE WR 02 WR WH"),
        ("1 1 12 sing", "@01 1 12 RJ IDLE WR BADCOMMAND"),
        ("1 3 13 home", "@01 3 13 RJ IDLE WR BADAXIS"),
        ("1 1 14 move abs 200001", "@01 1 14 RJ IDLE WR BADDATA"),
        ("1 1 15 move abs high", "@01 1 15 RJ IDLE WR BADDATA"),
        ("1 1 16 get system.serial", "@01 1 16 RJ IDLE WR DEVICEONLY"),
        ("1 0 17 get pos", "@01 0 17 OK IDLE WR 0 0"),
        ("1 0 18 get system.axiscount", "@01 0 18 OK IDLE WR 2"),
        ("1 1 19 get limit.max", "@01 1 19 OK IDLE WR 200000"),
        ("1 1 20 move abs 8000", "@01 1 20 OK BUSY -- 0"),
        ("1 1 21 set resolution 257", "@01 1 21 RJ IDLE WR BADDATA"),
        # `maxspeed` ends at 16384 times the resolution, 64.
        ("1 1 22 set maxspeed 1048577", "@01 1 22 RJ IDLE WR BADDATA"),
    ],
)  # fmt: skip
def test_zaber_replies_are_formatted_as_the_manual_says(zaber, command, reply):
    replies = zaber.ask(command)
    if "BUSY" in reply:
        replies = [re.sub(r"BUSY \S\S", "BUSY --", line) for line in replies]
    assert replies == [reply]


def test_a_zaber_command_with_a_wrong_checksum_is_not_answered(zaber):
    assert zaber(b"/1 1 10 move abs 1000:EE\n") == b""
    assert zaber(b"/1 1 10:00\n") == b""
    assert zaber(b"/1 1 10\n").startswith(b"@01 1 10 OK IDLE")


def test_zaber_settings_are_in_the_manuals_units(zaber):
    # 25 mm/s are 100 000 microsteps/s; homing takes half of it. 250 mm/s^2 are 1e6 microsteps/s^2.
    assert zaber.data("1 1 1 get maxspeed") == "163840"
    assert zaber.data("1 1 2 get limit.approach.maxspeed") == "81920"
    assert zaber.data("1 1 3 get accel") == "164"
    assert zaber.data("1 1 4 get resolution") == "64"


@pytest.mark.parametrize(
    ("speed", "acceleration", "at_s", "microsteps"),
    [
        # In the ramp: a t^2 / 2, with a = 100 x 10000 / 1.6384 microsteps/s^2.
        (163_840, 100, 0.1, 0.5 * 610_351.56 * 0.1**2),
        (163_840, 400, 0.02, 0.5 * 2_441_406.25 * 0.02**2),
        # At speed: v (t - ramp / 2), with v = 16384 / 1.6384 = 10000 microsteps/s.
        (16_384, 1000, 1.0, 10_000 * (1.0 - 10_000 / 6_103_515.6 / 2)),
        (32_768, 1000, 1.0, 20_000 * (1.0 - 20_000 / 6_103_515.6 / 2)),
    ],
)
def test_a_zaber_move_follows_its_speed_and_acceleration(
    homed_zaber, speed, acceleration, at_s, microsteps
):
    homed_zaber.ask(f"1 1 1 set maxspeed {speed}")
    homed_zaber.ask(f"1 1 2 set accel {acceleration}")
    homed_zaber.ask("1 1 3 move abs 100000", after_s=at_s)
    assert int(homed_zaber.data("1 1 4 get pos")) == pytest.approx(microsteps, abs=2)


def test_zaber_flags_are_listed_by_severity_and_raised_by_what_the_manual_says(homed_zaber):
    homed_zaber.ask("1 1 1 move abs 90000", after_s=0.2)
    homed_zaber.ask("1 1 2 stop", after_s=1.0)
    assert homed_zaber.data("1 1 3 warnings") == "01 NI"
    assert homed_zaber.data("1 1 4 warnings clear") == "01 NI"
    assert homed_zaber.data("1 1 5 warnings") == "00"
    homed_zaber.device.faults.inject("stall")
    homed_zaber.ask("1 1 9 home", after_s=60.0)
    assert homed_zaber.data("1 1 10 warnings") == "02 FS WR"
    homed_zaber.device.displace(1, 1, 3.0)
    assert homed_zaber.data("1 1 11 warnings") == "03 FS WM WR"
    homed_zaber.device.power_cycle()
    assert homed_zaber.data("1 1 12 warnings") == "02 WR WH"


def test_what_is_not_modelled_is_refused_and_logged(zaber, apt, caplog):
    for command in ("servo 1 get", "get knob.mode", "move vel 100"):
        assert zaber.data(f"1 1 1 {command}") == "BADCOMMAND"
        assert f"not modelled, refused: {command}" in caplog.text
    assert apt(short(0x0500)) == b""
    assert "not modelled, passed over: message 0x0500" in caplog.text


# Thorlabs, "APT Communications Protocol": header <HBBBB or <HHBB; "Scaling parameters" for Z8
# actuators on KDC101 and TDC001: 34304 counts per mm, 767367.49 per mm/s, 261.93 per mm/s^2.

UNIT, HOST = 0x50, 0x01
APT_AXIS = AxisSpec(
    travel_um=25_600.0, microstep_um=1 / 34.304, max_speed_um_s=2_000.0,
    acceleration_um_s2=1_500.0, start_um=2_300.0, backlash_um=0.0,
)  # fmt: skip


def short(message_id, first=0, second=0, destination=UNIT, source=HOST):
    return struct.pack("<HBBBB", message_id, first, second, destination, source)


def long(message_id, data, destination=UNIT, source=HOST):
    return struct.pack("<HHBB", message_id, len(data), destination | 0x80, source) + data


class Apt(Wire):
    def __init__(self):
        super().__init__(AptController, {UNIT: APT_AXIS})

    def status(self):
        """Position in counts and status bits."""
        reply = self(short(0x0490, 1))
        assert reply[:6] == struct.pack("<HHBB", 0x0491, 14, HOST | 0x80, UNIT)
        channel, position, _, _, bits = struct.unpack("<HiHHI", reply[6:])
        assert channel == 1
        return position, bits


@pytest.fixture
def apt():
    return Apt()


@pytest.fixture
def homed_apt(apt):
    apt(short(0x0443, 1), after_s=60.0)
    return apt


def test_an_apt_message_may_come_in_pieces(homed_apt):
    message = long(0x0453, struct.pack("<Hi", 1, 34_304))
    for byte in message[:-1]:
        assert homed_apt(bytes([byte]), after_s=0.1) == b""
    homed_apt(message[-1:] + short(0x0490, 1), after_s=30.0)
    assert homed_apt.status()[0] == 34_304


def test_apt_parameters_are_in_the_documents_units(apt):
    # 2 mm/s and 1.5 mm/s^2; homing at 1 mm/s, 0.3 mm off the switch.
    reply = apt(short(0x0414, 1))
    assert reply[:6] == struct.pack("<HHBB", 0x0415, 14, 0x81, UNIT)
    assert struct.unpack("<Hiii", reply[6:]) == (1, 0, round(1.5 * 261.93), round(2 * 767367.49))
    reply = apt(short(0x0441, 1))
    assert reply[:6] == struct.pack("<HHBB", 0x0442, 14, 0x81, UNIT)
    assert struct.unpack("<HHHii", reply[6:]) == (1, 2, 1, 767_367, round(0.3 * 34_304))


@pytest.mark.parametrize(
    ("velocity", "acceleration", "at_s", "counts"),
    [
        # 1 mm/s^2: half a millimetre after a second; then 1 mm/s.
        (767_367, 262, 1.0, 0.5 * 34_304),
        (767_367, 262, 3.0, 2.5 * 34_304),
        (1_534_735, 1_048, 1.0, (2 * 1.0 - 0.5) * 34_304),
    ],
)
def test_an_apt_move_follows_its_velocity_and_acceleration(
    homed_apt, velocity, acceleration, at_s, counts
):
    homed_apt(long(0x0413, struct.pack("<Hiii", 1, 0, acceleration, velocity)))
    homed_apt(long(0x0453, struct.pack("<Hi", 1, 20 * 34_304)), after_s=at_s)
    assert homed_apt.status()[0] == pytest.approx(counts, rel=2e-3)


def test_apt_status_bits_are_the_documents(apt):
    connected, settled, enabled, power = 0x100, 0x2000, 0x80000000, 0x10000000
    standing = connected | settled | enabled | power
    assert apt.status()[1] == standing
    apt(short(0x0443, 1), after_s=0.5)
    assert apt.status()[1] == connected | enabled | power | 0x200 | 0x10  # homing, downwards
    apt(b"", after_s=30.0)
    assert apt.status() == (0, standing | 0x400)
    apt(long(0x0453, struct.pack("<Hi", 1, 343_040)), after_s=1.0)
    assert apt.status()[1] == connected | enabled | power | 0x400 | 0x20
    apt.device.faults.inject("stall")
    apt(short(0x0465, 1, 2), after_s=5.0)
    apt(long(0x0453, struct.pack("<Hi", 1, 500_000)), after_s=30.0)
    assert apt.status()[1] == connected | settled | power | 0x400 | 0x4000
    apt(short(0x0210, 1, 1))
    assert apt.status()[1] & (enabled | 0x4000) == enabled


def test_the_end_of_an_apt_move_is_the_documents_message(apt):
    assert apt(short(0x0443, 1), after_s=60.0) == short(0x0444, 1, 0, HOST, UNIT)
    ended = apt(long(0x0453, struct.pack("<Hi", 1, 34_304)), after_s=30.0)
    assert ended[:6] == struct.pack("<HHBB", 0x0464, 14, 0x81, UNIT)
    assert struct.unpack("<Hi", ended[6:12]) == (1, 34_304)
    apt(long(0x0453, struct.pack("<Hi", 1, 500_000)), after_s=1.0)
    stopped = apt(bytes.fromhex("65 04 01 02 50 01"), after_s=5.0)
    assert stopped[:2] == bytes.fromhex("66 04")


def test_apt_says_who_it_is_as_the_document_lays_it_out(apt):
    reply = apt(short(0x0005))
    assert reply[:6] == struct.pack("<HHBB", 0x0006, 84, 0x81, UNIT)
    serial, model, kind, *version = struct.unpack_from("<I8sH4B", reply, 6)
    # 27 begins the serial numbers of KDC101; 16 is the document's type of a brushed DC controller.
    assert (serial // 1_000_000, model, kind) == (27, b"KDC101\0\0", 16)
    assert version == [3, 0, 2, 0]
    assert struct.unpack_from("<HHH", reply, 84) == (1, 0, 1)


def test_apt_updates_come_ten_times_a_second_and_end_without_acknowledgement(apt):
    assert apt(short(0x0011), after_s=1.0).count(bytes.fromhex("91 04 0e 00")) == 10
    apt(short(0x0492))
    assert apt(b"", after_s=20.0).count(bytes.fromhex("91 04 0e 00")) == 50
    assert apt(b"", after_s=5.0) == b""


# Grbl v1.1 documentation: "Interface" (reports, alarms, errors), "Configuration" (units of $100 to
# $132), "Jogging", "Commands".

GRBL_AXIS = AxisSpec(
    travel_um=200_000.0, microstep_um=4.0, max_speed_um_s=10_000.0,
    acceleration_um_s2=10_000.0, start_um=50_000.0, backlash_um=0.0,
)  # fmt: skip


class Grbl(Wire):
    def __init__(self, **settings):
        super().__init__(GrblController, dict.fromkeys("XYZ", GRBL_AXIS), **settings)

    def say(self, line, after_s=0.0):
        return self(line.encode() + b"\n", after_s).decode().split("\r\n")[:-1]

    def report(self):
        return self(b"?").decode().strip()

    def place(self):
        (places,) = re.findall(r"MPos:([^|>]*)", self.report())
        return [float(place) for place in places.split(",")]


@pytest.fixture
def grbl():
    device = Grbl()
    device.say("$H", after_s=120.0)
    return device


def test_grbl_greets_and_is_locked_until_it_is_homed():
    clock = ManualClock()
    device = GrblController(clock, dict.fromkeys("XYZ", GRBL_AXIS))
    assert device.due() == b"\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
    assert device.feed(b"?").startswith(b"<Alarm|MPos:")
    assert device.feed(b"G0 X-1\n") == b"error:9\r\n"
    assert device.feed(b"$X\n") == b"[MSG:Caution: Unlocked]\r\nok\r\n"


def test_grbl_lists_its_settings_in_the_documents_units(grbl):
    lines = grbl.say("$$")
    # 4 um a step; 10 mm/s; 10 mm/s^2; 200 mm.
    for line in ("$0=10", "$13=0", "$20=1", "$22=1", "$27=1", "$100=250.000", "$110=600.000",
                 "$120=10.000", "$130=200.000", "$132=200.000"):  # fmt: skip
        assert line in lines
    assert lines[-1] == "ok"
    numbers = [int(line.partition("=")[0].removeprefix("$")) for line in lines[:-1]]
    assert numbers == sorted(numbers)


def test_a_grbl_report_has_its_fields_in_the_documents_order(grbl):
    grbl.device.work_offset_mm["X"] = -5.0
    first, second, third = (grbl.report() for _ in range(3))
    assert first.startswith("<Idle|MPos:-1.000,-1.000,-1.000|FS:0,0|")
    assert "|WCO:-5.000,0.000,0.000" in first
    assert second.endswith("|FS:0,0|Ov:100,100,100>")
    assert third == "<Idle|MPos:-1.000,-1.000,-1.000|FS:0,0>"
    grbl.say("$10=0")
    assert grbl.report().startswith("<Idle|WPos:4.000,-1.000,-1.000|")


def test_grbl_repeats_the_offset_every_tenth_report_at_rest_and_every_thirtieth_in_motion(grbl):
    reports = [grbl.report() for _ in range(41)]
    offset = [at for at, report in enumerate(reports) if "WCO" in report]
    assert [b - a for a, b in pairwise(offset)] == [10] * (len(offset) - 1)
    grbl.say("$J=G91 X-150 F60")
    moving = [grbl.report() for _ in range(90)]
    offset = [at for at, report in enumerate(moving) if "WCO" in report]
    assert offset[-1] - offset[-2] == 30


@pytest.mark.parametrize(
    ("feed", "at_s", "mm"),
    [
        # 10 mm/s^2: in the ramp a t^2 / 2; 300 mm/min are 5 mm/s, reached after half a second.
        (300, 0.3, 0.45),
        (300, 2.5, 5 * (2.5 - 0.25)),
        (600, 2.0, 10 * (2.0 - 0.5)),
        # $110 is the fastest.
        (9_000, 2.0, 10 * (2.0 - 0.5)),
    ],
)
def test_a_grbl_jog_follows_its_feed_and_acceleration(grbl, feed, at_s, mm):
    assert grbl.say(f"$J=G91 X-50 F{feed}", after_s=at_s) == ["ok"]
    assert grbl.report().startswith("<Jog|")
    assert grbl.place()[0] == pytest.approx(-1.0 - mm, abs=0.01)


def test_a_grbl_diagonal_is_straight_and_its_feed_is_along_it(grbl):
    grbl.say("$J=G91 X-30 Y-40 F300", after_s=5.2)
    x, y, _ = grbl.place()
    # No axis beyond 10 mm/s^2 is 12.5 along the diagonal: 5 (5.2 - 0.2) = 25 mm, 15 and 20.
    assert (x, y) == (pytest.approx(-16.0, abs=0.02), pytest.approx(-21.0, abs=0.02))
    assert "FS:300,0" in grbl.report()


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        (["G90 G1 F600 X-18"], -20.0),
        (["G91 G1 F600 X-20"], -21.0),
        (["G20 G90 G1 F20 X-1"], -27.4),
        (["G90 G53 G1 F600 X-20"], -20.0),
        (["$J=G90 G21 X-18 F600"], -20.0),
        (["$J=G90 G53 X-20 F600"], -20.0),
        (["$J=G91 G20 X-1 F20"], -26.4),
        (["G20 G91", "$J=X-1 F20"], -26.4),
    ],
)
def test_grbl_words_move_where_the_document_says(grbl, lines, place):
    grbl.device.work_offset_mm["X"] = -2.0
    for line in lines:
        assert grbl.say(line, after_s=30.0) == ["ok"]
    assert grbl.place()[0] == pytest.approx(place, abs=0.003)


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("$J=X-500 F100", 15), ("$J=X-5", 22), ("$J=G91 G1 X-5 F100", 16), ("$Q", 3),
        ("$100=-1", 4), ("G1X", 2), ("-5", 1), ("G2 X1 Y1 I1", 20), ("M7", 20),
        ("G1 X-5" + " " * 80, 11), ("$J=F100", 26), ("$J X1", 16),
    ],
)  # fmt: skip
def test_grbl_refuses_by_the_documents_numbers(grbl, line, error):
    assert grbl.say(line) == [f"error:{error}"]


def test_grbl_refuses_soft_limits_without_homing_and_homing_that_is_off(grbl):
    grbl.say("$20=0")
    grbl.say("$22=0")
    assert grbl.say("$20=1") == ["error:10"]
    assert grbl.say("$H") == ["error:5"]


def test_grbl_alarms_have_the_documents_numbers(grbl):
    assert grbl.say("G90 G0 X-500") == ["ALARM:2", "[MSG:Reset to continue]"]
    grbl(b"\x18")
    grbl.say("$X")
    grbl.say("$J=G91 X-100 F300", after_s=1.0)
    assert "ALARM:3" in grbl(b"\x18").decode()
    grbl.say("$H", after_s=0.1)
    assert "ALARM:6" in grbl(b"\x18").decode()
    grbl.device.faults.inject("stall")
    assert "ALARM:9" in grbl.say("$H", after_s=60.0)
    grbl.say("$X")
    grbl.say("$20=0")
    assert "ALARM:1" in grbl.say("G91 G1 F600 X400", after_s=60.0)


def test_grbl_in_inches_reports_inches(grbl):
    grbl.say("$13=1")
    assert grbl.report().startswith("<Idle|MPos:-0.0394,-0.0394,-0.0394|")
    # config.h: a rate has no decimals in millimetres and one in inches, 600 / 25.4.
    assert grbl.say("$J=G91 G21 X-50 F600", after_s=2.0) == ["ok"]
    assert "|FS:23.6,0" in grbl.report()


def test_a_grbl_axis_homes_downwards_where_its_bit_says(grbl):
    grbl.say("$23=2")
    grbl.say("$H", after_s=240.0)
    assert grbl.place() == [
        pytest.approx(-1.0, abs=0.004), pytest.approx(-199.0, abs=0.004),
        pytest.approx(-1.0, abs=0.004),
    ]  # fmt: skip


def test_a_hold_of_grbl_ends_in_hold_0(grbl):
    grbl.say("G91 G1 F300 X-40\nG1 X-10", after_s=1.0)
    assert re.match(r"<Run\|.*\|FS:300,0", grbl.report())
    assert grbl(b"!?").decode().startswith("<Hold:1|")
    grbl.clock.sleep(5.0)
    assert grbl.report().startswith("<Hold:0|")

"""Simulated controllers do as real ones: lost bytes, held moves, refusals that are logged."""

import logging
import struct
from dataclasses import replace

import pytest

from drivers.apt_codec import Id, decode, encode
from simulators.apt import COUNTS_PER_UM, AptController
from simulators.clock import ManualClock
from simulators.grbl import SMALL_AXIS, GrblController
from simulators.zaber import AxisSpec, ZaberChain


class Talk:
    """A controller by hand: bytes in, what it says out."""

    def __init__(self, device):
        self.device = device
        self.device.due()

    def __call__(self, data, after_s=0.0):
        said = self.device.feed(data)
        self.device._clock.sleep(after_s)
        return said + self.device.due()


@pytest.fixture
def grbl():
    axes = dict.fromkeys("XYZ", replace(SMALL_AXIS, start_um=24_000.0, travel_um=100_000.0))
    return Talk(GrblController(ManualClock(), axes, settings={20: 0, 21: 0, 22: 0}))


def test_grbl_loses_the_bytes_that_its_receive_buffer_cannot_hold(grbl):
    lines = [b"G1 F60 X-%d\n" % number for number in range(1, 40)]
    answered = grbl(b"".join(lines)).count(b"ok")
    taken_up = sum(len(line) for line in lines[:answered])
    sent = sum(len(line) for line in lines)
    # RX_BUFFER_SIZE of Grbl 1.1's serial.h: ends of lines are held as well.
    assert sent - taken_up - grbl.device.lost_bytes == 128
    assert answered < len(lines)


def test_grbl_counted_by_answers_loses_nothing(grbl):
    for number in range(1, 20):
        assert b"ok" in grbl(b"G1 F6000 X-%d\n" % number, after_s=0.02) + grbl(b"", after_s=1.0)
    assert grbl.device.lost_bytes == 0


def test_a_held_program_is_taken_up_again_and_arrives(grbl):
    grbl(b"G1 F600 X-5\nG1 X-8\n", after_s=0.1)
    grbl(b"!", after_s=1.0)
    assert b"<Hold:0|" in grbl(b"?")
    grbl(b"", after_s=5.0)
    assert b"<Hold:0|" in grbl(b"?")
    held = grbl.device._machine_mm()["X"]
    assert -5 < held < 0
    grbl(b"~", after_s=10.0)
    assert b"<Idle|MPos:-8.000" in grbl(b"?")


def test_check_mode_parses_and_moves_nothing_and_sleep_wants_a_reset(grbl):
    assert b"Enabled" in grbl(b"$C\n")
    assert b"ok" in grbl(b"G1 F600 X-5\n", after_s=2.0)
    assert b"error:20" in grbl(b"G2 X1 Y1 I1\n")
    assert grbl.device._machine_mm()["X"] == grbl.device._machine_mm()["Y"]
    assert b"Grbl 1.1h" in grbl(b"$C\n")
    assert b"Sleeping" in grbl(b"$SLP\n")
    assert b"error:9" in grbl(b"G1 F600 X-5\n")
    assert b"Grbl 1.1h" in grbl(b"\x18")


def test_work_coordinates_are_shifted_and_reported(grbl):
    grbl(b"G1 F6000 X-5\n", after_s=2.0)
    grbl(b"G92 X1\n")
    assert b"|WCO:-6.000" in grbl(b"?")
    grbl(b"G1 X3\n", after_s=2.0)
    assert b"MPos:-3.000" in grbl(b"?")
    grbl(b"G92.1\nG10 L20 P1 X0\n")
    assert b"|WCO:-3.000" in grbl(b"?")
    grbl(b"G10 L2 P1 X-1\n")
    assert b"|WCO:-1.000" in grbl(b"?")


def zaber():
    spec = AxisSpec(travel_um=20_000.0, backlash_um=0.0)
    talk = Talk(ZaberChain(ManualClock(), {(1, 1): spec}))
    talk(b"/1 1 home\n", after_s=20.0)
    return talk


@pytest.mark.parametrize(
    ("command", "steps"),
    [
        (b"move max", 419_947),
        (b"move max 100000", 419_947),
        (b"move vel 200000", 419_947),
        (b"move abs 50000 30000", 50_000),
        (b"move rel 1000", 1_000),
    ],
)
def test_every_kind_of_move_ends_where_the_manual_says(command, steps):
    talk = zaber()
    assert b"OK BUSY" in talk(b"/1 1 " + command + b"\n")
    talk(b"", after_s=60.0)
    assert f" {steps}:" in talk(b"/1 1 get pos\n").decode()
    talk(b"/1 1 move min\n", after_s=60.0)
    assert b" 0:" in talk(b"/1 1 get pos\n")


def test_a_speed_beyond_the_firmwares_is_refused():
    talk = zaber()
    for command in (b"move vel %d", b"set maxspeed %d", b"move abs 10 %d"):
        assert b"RJ" in talk(b"/1 1 " + command % (64 * 16384 + 1) + b"\n")
        assert b"OK" in talk(b"/1 1 " + command % (64 * 16384) + b"\n", after_s=60.0)


def test_an_emergency_stop_and_a_reset_lose_the_reference():
    talk = zaber()
    talk(b"/1 1 move max\n", after_s=0.5)
    assert b"OK" in talk(b"/1 1 estop\n")
    assert b"WR" in talk(b"/1 1 warnings\n")
    talk = zaber()
    assert b"OK" in talk(b"/1 system reset\n")
    assert b"WR" in talk(b"/1 1 warnings\n")


@pytest.mark.parametrize(
    ("command", "said"), [(b"servo 1 get", b"BADCOMMAND"), (b"get knob.mode", b"BADCOMMAND")]
)
def test_what_is_not_modelled_is_refused_and_logged(command, said, caplog):
    with caplog.at_level(logging.WARNING, "simulators"):
        assert said in zaber()(b"/1 1 " + command + b"\n")
    assert "not modelled" in caplog.text


def apt(*message, data=None):
    return encode(message[0], 0x50, *message[1:], data=data)


def test_an_apt_controller_jogs_and_tells_its_limit_switches(caplog):
    talk = Talk(AptController(ManualClock()))
    talk(apt(Id.MOT_MOVE_HOME, 1), after_s=60.0)
    talk(b"", after_s=60.0)
    step = round(500 * COUNTS_PER_UM)
    parameters = (1, 2, step, 0, 100_000, 500_000, 2)
    talk(apt(Id.MOT_SET_JOGPARAMS, data=struct.pack("<HHiiiiH", *parameters)))
    answer = decode(talk(apt(Id.MOT_REQ_JOGPARAMS, 1)))
    assert struct.unpack("<HHiiiiH", answer.data or b"") == parameters
    talk(apt(Id.MOT_MOVE_JOG, 1, 2), after_s=10.0)
    assert talk.device.position_um() == pytest.approx(500.0, abs=0.1)
    talk(apt(Id.MOT_MOVE_JOG, 1, 1), after_s=10.0)
    assert talk.device.position_um() == pytest.approx(0.0, abs=3.1)
    limits = (1, 3, 1, 10, 20, 2)
    talk(apt(Id.MOT_SET_LIMSWITCHPARAMS, data=struct.pack("<HHHIIH", *limits)))
    answer = decode(talk(apt(Id.MOT_REQ_LIMSWITCHPARAMS, 1)))
    assert struct.unpack("<HHHIIH", answer.data or b"") == limits
    with caplog.at_level(logging.WARNING, "simulators"):
        talk(encode(0x0500, 0x50))
    assert "not modelled" in caplog.text

"""What is Grbl's own: alarms, resets, modes, work offsets, and homing that says nothing."""

import math
from dataclasses import replace
from functools import partial
from itertools import count

import pytest
from stage_rigs import after_first_sleep

from emmc_rig.drivers import grbl_codec as codec
from emmc_rig.drivers.errors import (
    AxisFaultError,
    CommandRefusedError,
    FirmwareError,
    GarbledReplyError,
    LimitExceededError,
    LimitSwitchError,
    LostPositionError,
    NotHomedError,
    PositionMismatchError,
    PressedSwitchError,
    TransportTimeoutError,
)
from emmc_rig.drivers.grbl import GrblStage, identify
from emmc_rig.drivers.stage import DEFAULT_SETTINGS, Direction, Reading, StageSettings
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.grbl import BENCH_AXES, WITH_SINGLE_AXIS_HOMING, GrblController

AXES = {"x": "X", "y": "Y"}
TRAVEL_UM = BENCH_AXES["X"].travel_um
PULL_OFF_UM = 1000.0


class Bench:
    def __init__(self, **options):
        self.clock = ManualClock()
        self.device = GrblController(self.clock, **options)
        self.transport = self.device.transport()

    def stage(self, axes=None, settings=DEFAULT_SETTINGS):
        return GrblStage(self.transport, axes or AXES, self.clock, settings)

    def homed(self):
        stage = self.stage()
        stage.home()
        return stage

    def say(self, line):
        """Send a line as another program would; return the controller's answer."""
        return self.device.feed(line).decode("ascii")


@pytest.fixture
def bench():
    return Bench()


def test_a_second_question_before_the_answer_is_not_answered_and_none_while_homing(bench):
    bench.say(b"")
    bench.say(b"$H\n")
    assert bench.say(b"??") == ""
    bench.clock.sleep(60.0)
    reported = bench.say(b"")
    assert reported.count("<") == 1
    assert reported.startswith("ok\r\n<Idle|")


def test_moves_are_jogs_in_machine_coordinates_that_leave_the_modes_alone(bench):
    stage = bench.homed()
    bench.say(b"G91 G20\n")
    bench.device.work_offset_mm["X"] = 7.0
    stage.move_to_um({"x": -5000.0})
    assert bench.device.position_um("X") == pytest.approx(TRAVEL_UM - 5000.0, abs=0.5)
    assert "G20 G91" in bench.say(b"$G\n")


def test_axes_that_move_together_arrive_together_each_at_its_own_speed(bench):
    stage = GrblStage(bench.transport, AXES, bench.clock, StageSettings(approach_um=0.0))
    stage.home()
    stage.set_speed_um_s("y", 500.0)
    start_s = bench.clock.now_s()
    stage.move_to_um({"x": -2000.0, "y": -3000.0})
    # 2000 um of y at 500 um/s are the slowest; x alone would take a quarter of a second.
    assert 4.0 < bench.clock.now_s() - start_s < 4.3


@pytest.mark.parametrize("mask", [0, 1])
@pytest.mark.parametrize("inches", [0, 1])
def test_positions_are_machine_positions_whatever_is_reported(mask, inches):
    bench = Bench(settings={codec.REPORT_MASK: mask, codec.REPORT_INCHES: inches})
    bench.device.work_offset_mm["X"] = -3.25
    stage = bench.homed()
    assert stage.position_um("x") == pytest.approx(-PULL_OFF_UM, abs=2.6)
    stage.move_to_um({"x": -7000.0})
    assert bench.device.position_um("X") == pytest.approx(TRAVEL_UM - 7000.0, abs=0.5)


def test_the_travel_ends_short_of_the_switch(bench):
    stage = bench.stage()
    low_um, high_um = stage.limits_um("x")
    assert (low_um, high_um) == (-TRAVEL_UM + 10.0, -PULL_OFF_UM)
    stage.home()
    with pytest.raises(LimitExceededError):
        stage.move_to_um({"x": 0.0})


def test_an_axis_that_never_reads_the_same_twice_is_named(bench, monkeypatch):
    stage = bench.homed()
    readings = (Reading(50.0 * n, homed=True, moving=False) for n in count())
    monkeypatch.setattr(stage, "_read", lambda axis: next(readings))
    with pytest.raises(GarbledReplyError, match=r"\(x never reads the same twice\)") as caught:
        stage.position_um("x")
    assert (caught.value.raw, caught.value.axis, caught.value.command) == (b"", "x", "position")


@pytest.mark.parametrize(
    ("options", "limits_um"),
    [
        ("VH", (-TRAVEL_UM + PULL_OFF_UM + 10.0, 0.0)),
        ("VHZ", (PULL_OFF_UM + 10.0, TRAVEL_UM)),
    ],
)
def test_an_axis_that_homes_downwards_has_its_switch_at_the_other_end(options, limits_um):
    bench = Bench(options=options, settings={codec.HOMING_DIRECTIONS: 0b001})
    stage = bench.stage()
    assert stage.limits_um("x") == limits_um
    assert stage.limits_um("y")[1] == -PULL_OFF_UM


def test_the_firmware_refuses_a_jog_beyond_its_travel_and_the_position_stays(bench):
    stage = bench.homed()
    bench.device.settings[codec.TRAVEL] = 5.0
    with pytest.raises(CommandRefusedError, match="check the travel") as caught:
        stage.move_to_um({"x": -9000.0})
    assert caught.value.reply.startswith("error:15")
    assert caught.value.command.startswith("$J=G53")
    assert caught.value.axis == "x"
    assert stage.move_to_um({"x": -2000.0})["x"] == pytest.approx(-2000.0, abs=1.0)


def test_a_soft_limit_alarm_keeps_the_position_but_asks_for_homing(bench):
    stage = bench.homed()
    bench.transport.write(b"G0X50\n")
    with pytest.raises(AxisFaultError, match="position kept") as caught:
        stage.move_by_um({"x": -100.0})
    assert not caught.value.loses_position
    stage.home()
    stage.move_by_um({"x": -100.0})


def test_a_limit_switch_stops_all_loses_the_position_and_is_left_before_homing(bench):
    stage = bench.homed()
    bench.say(b"$20=0\n")
    bench.say(b"G53G0X5\n")
    bench.clock.sleep(3.0)
    with pytest.raises(LimitSwitchError, match="hard limit") as caught:
        stage.position_um("x")
    assert caught.value.reply == "ALARM:1"
    with pytest.raises(NotHomedError, match="hard limit reached"):
        stage.move_to_um({"y": -3000.0})
    # Another program's move ended there: this one knows no direction that leads off the switch.
    with pytest.raises(PressedSwitchError, match="away from the end of the travel") as refused:
        stage.home()
    assert (refused.value.axis, refused.value.away) == ("x", "")
    assert stage.pressed_switches() == {"x": None}
    assert stage.move_off_switch("x", Direction.DOWN, 500.0)
    stage.home()
    assert stage.move_to_um({"x": -3000.0})["x"] == pytest.approx(-3000.0, abs=1.0)


@pytest.fixture
def at_the_lower_end():
    """A bench whose `$130` allows more travel than there is, and a stage that ran into its end."""
    bench = Bench(settings={codec.TRAVEL: TRAVEL_UM / 1e3 + 10})
    stage = bench.homed()
    with pytest.raises(PressedSwitchError) as hit:
        stage.move_to_um({"x": -TRAVEL_UM - 5000.0})
    assert (hit.value.axis, hit.value.away, hit.value.reply) == ("x", "up", "ALARM:1")
    return bench, stage


def test_a_move_that_ends_on_a_switch_says_which_way_leads_off_it(at_the_lower_end):
    bench, stage = at_the_lower_end
    with pytest.raises(PressedSwitchError, match="off the switch, upwards, before it is homed"):
        stage.home()
    assert bench.device.position_um("X") == pytest.approx(0.0, abs=BENCH_AXES["X"].backlash_um)
    assert stage.pressed_switches() == {"x": Direction.UP}
    # Outside the travel that `$130` states: Grbl's soft limits would refuse the jog.
    bench.device.settings[codec.TRAVEL] = 5.0
    assert stage.move_off_switch("x", Direction.UP, 500.0)
    assert bench.device.settings[codec.SOFT_LIMITS] == 1
    assert bench.device.position_um("X") == pytest.approx(500.0, abs=4.0)
    with pytest.raises(NotHomedError):
        stage.position_um("y")
    stage.home()
    assert stage.pressed_switches() == {}


def test_a_step_off_the_switch_that_goes_nowhere_is_an_error(at_the_lower_end):
    bench, stage = at_the_lower_end
    with pytest.raises(PositionMismatchError):
        stage.move_off_switch("x", Direction.DOWN, 500.0)
    assert bench.device.settings[codec.SOFT_LIMITS] == 1


def test_ctrl_c_in_a_step_off_the_switch_stops_it_and_restores_the_soft_limits(
    at_the_lower_end, monkeypatch
):
    bench, stage = at_the_lower_end

    def ctrl_c():
        raise KeyboardInterrupt

    after_first_sleep(monkeypatch, bench.clock, 0.1, ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        stage.move_off_switch("x", Direction.UP, 5000.0)
    assert bench.device.settings[codec.SOFT_LIMITS] == 1
    stands_um = bench.device.position_um("X")
    bench.clock.sleep(10.0)
    assert bench.device.position_um("X") == stands_um < 1000.0


def test_a_pressed_switch_keeps_the_axes_from_homing_that_would_move_it_and_no_others():
    axes = BENCH_AXES | {"Z": replace(BENCH_AXES["Z"], start_um=0.0)}
    stage = Bench(axes=axes).stage()
    with pytest.raises(PressedSwitchError) as refused:
        stage.home()
    # The stage names X and Y alone; Grbl as it is shipped homes Z as well.
    assert refused.value.axis == "Z"
    assert stage.move_off_switch("Z", Direction.UP, 500.0)
    stage.home()
    Bench(axes=axes, options=WITH_SINGLE_AXIS_HOMING).stage({"x": "X", "focus": "Z"}).home(["x"])


def test_a_reset_while_it_moves_is_a_lost_position(bench, monkeypatch):
    stage = bench.homed()
    reset = partial(bench.transport.write, codec.SOFT_RESET)
    after_first_sleep(monkeypatch, bench.clock, 0.0, reset)
    with pytest.raises(LostPositionError) as caught:
        stage.move_to_um({"x": -20_000.0})
    assert caught.value.reply in ("ALARM:3", "")
    assert not stage.is_homed("x")


def test_a_restart_that_nobody_asked_for_is_a_lost_position(bench):
    stage = bench.homed()
    bench.device.power_cycle()
    with pytest.raises(LostPositionError, match="restarted"):
        stage.position_um("x")
    with pytest.raises(NotHomedError):
        stage.position_um("y")


def test_homing_that_is_switched_off_is_refused_with_what_to_do():
    bench = Bench(settings={codec.HOMING: 0})
    stage = bench.stage()
    with pytest.raises(CommandRefusedError, match=r"switch homing on \(\$22=1\)"):
        stage.home()
    assert not stage.is_homed("x")


def test_firmware_as_it_is_shipped_homes_all_axes_where_one_is_asked_for_and_says_so(bench, caplog):
    caplog.set_level("WARNING", logger="drivers")
    stage = bench.stage()
    stage.home(["x"])
    assert "homes all axes together: x, y" in caplog.text
    assert stage.is_homed("x")
    assert stage.position_um("y") == pytest.approx(-PULL_OFF_UM, abs=2.6)


def test_settings_that_are_not_numbers_matter_only_where_they_are_needed(bench):
    def with_settings(*lines):
        plain = bench.device._execute_system

        def execute(line):
            plain(line)
            for more in lines if line == "$$" else ():
                bench.device._say(more)

        bench.device._execute_system = execute
        return bench.stage()

    with_settings("$300=grblHAL", "$302=192.168.5.1", "$75=", "$341=0").home()
    with_settings("$130=60.000 (x max travel, mm)").home()
    with pytest.raises(GarbledReplyError, match="'fast' is not a number") as caught:
        with_settings("$110=fast")
    assert "cable" not in str(caught.value)


@pytest.mark.parametrize(
    ("version", "advice"),
    [
        ("3.7 FluidNC v3.7.8:", "install Grbl 1.1 or grblHAL"),
        ("1.1h.20190825:", "it has no axis X"),
    ],
)
def test_firmware_that_does_not_state_its_speed_is_named(bench, version, advice):
    plain = bench.device._execute_system

    def execute(line):
        if line == "$I":
            bench.device._say(f"[VER:{version}]")
        elif line == "$$":
            bench.device._say("$10=1")
        else:
            plain(line)

    bench.device._execute_system = execute
    with pytest.raises(FirmwareError, match=f"{version.rstrip(':')} does not state.*{advice}"):
        bench.stage()


def test_a_grbl_of_version_0_9_is_named_by_its_report():
    with pytest.raises(FirmwareError, match=r"older than 1\.1.*install Grbl 1\.1"):
        codec.decode_line(b"<Idle,MPos:0.000,0.000,0.000,WPos:0.000,0.000,0.000>\r\n")


def test_a_grbl_of_version_0_9_is_named_by_its_banner(bench):
    bench.device._say("Grbl 0.9j ['$' for help]")
    with pytest.raises(FirmwareError, match=r"^Grbl 0\.9j answers: install Grbl 1\.1"):
        bench.stage()


def test_homing_some_axes_needs_firmware_that_can():
    stage = Bench(options=WITH_SINGLE_AXIS_HOMING).stage()
    stage.home(["y"])
    assert stage.is_homed("y")
    assert not stage.is_homed("x")
    stage.home(["x"])
    assert stage.is_homed("x")


@pytest.mark.parametrize("fault", ["drop_reply", "garble_reply"])
def test_homing_whose_end_was_not_heard_does_not_count(bench, fault):
    stage = bench.stage()
    bench.device.faults.inject(fault, when=lambda occasion: occasion.reply == b"ok\r\n")
    with pytest.raises(LostPositionError, match="ended without an answer"):
        stage.home()
    assert not stage.is_homed("x")
    stage.home()
    assert stage.is_homed("x")


def test_homing_that_never_began_does_not_count(bench):
    stage = bench.homed()
    bench.device.faults.inject("drop_command", when=lambda occasion: b"$H" in occasion.command)
    with pytest.raises(LostPositionError, match="ended without an answer"):
        stage.home()
    assert not stage.is_homed("x")


def test_an_open_door_is_a_fault_that_is_named(bench):
    stage = bench.homed()
    bench.device.faults.inject("door")
    with pytest.raises((AxisFaultError, CommandRefusedError)):
        stage.move_by_um({"x": -100.0})
    with pytest.raises(AxisFaultError, match="state Door"):
        stage.wait_until_settled()


def test_a_program_that_runs_is_held_by_a_stop(bench):
    stage = bench.homed()
    bench.say(b"G53G1X-20F60\n")
    stage.stop()
    here_um = bench.device.position_um("X")
    bench.clock.sleep(30.0)
    assert bench.device.position_um("X") == here_um
    with pytest.raises(AxisFaultError, match="state Hold"):
        stage.wait_until_settled()
    stage.home()
    stage.move_by_um({"x": -10.0})


def test_a_controller_that_boots_slowly_is_waited_for_and_a_silent_one_is_reset_once(bench):
    bench.device.faults.inject("drop_command", times=5)
    bench.stage()
    stuck = Bench()
    stuck.homed()
    stuck.say(b"$20=0\n")
    stuck.say(b"G53G0X5\n")
    stuck.clock.sleep(3.0)
    assert stuck.say(b"?") == "ALARM:1\r\n[MSG:Reset to continue]\r\n"
    waiting = stuck.stage()
    assert waiting.move_off_switch("x", Direction.DOWN, 500.0)
    waiting.home()
    dead = Bench()
    dead.device.faults.inject("drop_command", times=math.inf)
    with pytest.raises(TransportTimeoutError, match="check power"):
        dead.stage()


def test_an_axis_that_the_controller_does_not_have_shows_at_construction():
    two = Bench(axes={letter: BENCH_AXES[letter] for letter in "XY"})
    with pytest.raises(FirmwareError, match="it has no axis Z"):
        two.stage({"focus": "Z"})
    with pytest.raises(ValueError, match="use one of X, Y"):
        two.stage({"focus": "Q"})


def test_it_says_what_it_is(bench):
    assert identify(bench.transport, bench.clock) == ("version 1.1h.20190825:, options V,15,128")

"""Every stage over simulated firmware with known true positions: accuracy, and every fault."""

import math
import threading
from contextlib import suppress

import pytest
from stage_rigs import FAULTED, RIGS, after_first_sleep, opened, simulated_rig  # noqa: F401

from emmc_rig.bench.conformance.stages import TOLERANCE_UM, middle_um
from emmc_rig.drivers.errors import (
    DriverError,
    GarbledReplyError,
    MoveTimeoutError,
    NotHomedError,
    PortGoneError,
    PositionMismatchError,
    StalledError,
    TransportTimeoutError,
)
from emmc_rig.drivers.stage import START_GRACE_S, move_time_limit_s

BACKLASH_UM = 3.0
REPLY_FAULTS = ("drop_reply", "lose_reply_byte", "garble_reply", "late_reply", "duplicate_reply")


@pytest.fixture(params=FAULTED)
def simulated(request, opened, tmp_path):  # noqa: F811
    """Every kind of stage, and every wire."""
    return simulated_rig(request.param, opened, tmp_path)


@pytest.fixture(params=RIGS)
def in_memory(request, opened, tmp_path):  # noqa: F811
    return RIGS[request.param]("memory", opened, tmp_path)


def homed(rig, **settings):
    """A stage that was homed, and the name of its first axis."""
    stage = rig.make_stage(**settings)
    stage.home()
    return stage, stage.axes[0]


def test_an_axis_is_really_where_it_reads_to_be_from_either_side(simulated):
    stage = simulated.make_stage()
    stage.home()
    target_um = {axis: middle_um(stage, axis) for axis in stage.axes}
    for start_um in (-3000.0, 3000.0, -5.0, 5.0, 0.0):
        stage.move_to_um({axis: um + start_um for axis, um in target_um.items()})
        read_um = stage.move_to_um(target_um)
        for axis, um in target_um.items():
            assert read_um[axis] == pytest.approx(um, abs=TOLERANCE_UM)
            assert simulated.true_um(axis) == pytest.approx(um, abs=TOLERANCE_UM)


def test_a_tolerance_finer_than_half_a_step_is_refused(in_memory):
    with pytest.raises(ValueError, match="loosen it"):
        in_memory.make_stage(tolerance_um=0.01)


def test_without_the_approach_a_downward_move_is_off_by_the_backlash(simulated):
    stage, axis = homed(simulated, approach_um=0.0)
    target_um = middle_um(stage, axis)
    stage.move_to_um({axis: target_um + 2000.0})
    stage.move_to_um({axis: target_um})
    assert simulated.true_um(axis) - target_um == pytest.approx(BACKLASH_UM, abs=TOLERANCE_UM)


def test_a_move_takes_the_time_of_its_distance_and_speed(simulated):
    stage, axis = homed(simulated, approach_um=0.0, settle_s=0.0)
    stage.set_speed_um_s(axis, 1000.0)
    stage.move_to_um({axis: middle_um(stage, axis)})
    start_s = simulated.clock.now_s()
    stage.move_by_um({axis: 5000.0})
    passed_s = simulated.clock.now_s() - start_s
    assert 5.0 < passed_s < move_time_limit_s(5000.0, 1000.0)


def test_nothing_is_returned_while_the_stage_still_moves(simulated):
    stage = simulated.make_stage(settle_s=0.0)
    stage.home()
    for step_um in (4000.0, -4000.0, 1.0, 700.0):
        stage.move_to_um({axis: middle_um(stage, axis) + step_um for axis in stage.axes})
        here_um = [simulated.true_um(axis) for axis in stage.axes]
        simulated.clock.sleep(10.0)
        assert [simulated.true_um(axis) for axis in stage.axes] == here_um


def test_a_stop_from_elsewhere_ends_a_move_in_an_error_and_keeps_the_position(
    simulated, monkeypatch
):
    stage, axis = homed(simulated)
    start_um = stage.move_to_um({axis: middle_um(stage, axis)})[axis]
    after_first_sleep(monkeypatch, simulated.clock, 0.3, lambda: stage.stop([axis]))
    with pytest.raises(PositionMismatchError):
        stage.move_by_um({axis: 9000.0})
    read_um = stage.position_um(axis)
    assert start_um + 50.0 < read_um < start_um + 8999.0
    assert simulated.true_um(axis) == pytest.approx(read_um, abs=TOLERANCE_UM)


@pytest.mark.parametrize("trouble", [KeyboardInterrupt, RuntimeError])
def test_an_interrupt_during_a_move_stops_every_axis_and_leaves_it_stopped(
    simulated, monkeypatch, trouble
):
    stage = simulated.make_stage()
    stage.home()
    start_um = {axis: middle_um(stage, axis) - 5000.0 for axis in stage.axes}
    stage.move_to_um(start_um)
    for axis in stage.axes:
        stage.set_speed_um_s(axis, 500.0)
    sleep = simulated.clock.sleep

    def interrupt(duration_s):
        sleep(0.5)
        raise trouble

    with monkeypatch.context() as patch:
        patch.setattr(simulated.clock, "sleep", interrupt)
        with pytest.raises(trouble):
            stage.move_to_um({axis: um + 10_000.0 for axis, um in start_um.items()})
    simulated.let_bytes_arrive()
    simulated.clock.sleep(5.0)
    stopped_um = {axis: simulated.true_um(axis) for axis in stage.axes}
    simulated.clock.sleep(60.0)
    for axis in stage.axes:
        assert simulated.true_um(axis) == stopped_um[axis]
        assert start_um[axis] + 1.0 < stopped_um[axis] < start_um[axis] + 9999.0
        assert stage.position_um(axis) == pytest.approx(stopped_um[axis], abs=TOLERANCE_UM)


def test_an_interrupt_during_homing_stops_it_and_leaves_the_axis_unknown(simulated, monkeypatch):
    stage = simulated.make_stage()
    sleep = simulated.clock.sleep

    def interrupt(duration_s):
        sleep(0.1)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(simulated.clock, "sleep", interrupt)
        with pytest.raises(KeyboardInterrupt):
            stage.home()
    simulated.let_bytes_arrive()
    simulated.clock.sleep(5.0)
    stopped_um = [simulated.true_um(axis) for axis in stage.axes]
    simulated.clock.sleep(60.0)
    assert [simulated.true_um(axis) for axis in stage.axes] == stopped_um
    with pytest.raises(NotHomedError):
        stage.move_to_um({stage.axes[0]: middle_um(stage, stage.axes[0])})
    stage.home()
    assert stage.is_homed(stage.axes[0])


@pytest.mark.parametrize("fault", [*REPLY_FAULTS, "drop_command"])
def test_a_query_survives_a_message_that_goes_wrong(in_memory, fault):
    stage, axis = homed(in_memory)
    here_um = stage.move_to_um({axis: middle_um(stage, axis) for axis in stage.axes})[axis]
    in_memory.device.faults.inject(fault)
    assert stage.position_um(axis) == pytest.approx(here_um, abs=TOLERANCE_UM)
    for axis in stage.axes:
        assert stage.position_um(axis) == pytest.approx(in_memory.true_um(axis), abs=TOLERANCE_UM)
    stage.move_by_um({axis: 100.0})


@pytest.mark.parametrize("fault", REPLY_FAULTS)
def test_a_move_whose_answers_go_wrong_is_sent_once_and_arrives(in_memory, fault):
    stage, axis = homed(in_memory, approach_um=0.0)
    target_um = middle_um(stage, axis)
    moves = count_moves(in_memory)
    in_memory.device.faults.inject(fault, when=in_memory.is_move)
    read_um = stage.move_to_um({axis: target_um})
    assert len(moves) == 1
    assert read_um[axis] == pytest.approx(target_um, abs=TOLERANCE_UM)
    assert in_memory.true_um(axis) == pytest.approx(target_um, abs=BACKLASH_UM + TOLERANCE_UM)
    assert stage.move_by_um({axis: 100.0})[axis] == pytest.approx(target_um + 100.0, abs=2.0)


@pytest.mark.parametrize("fault", REPLY_FAULTS)
@pytest.mark.parametrize("nth", [0, 1, 4])
def test_one_bad_answer_while_it_moves_does_not_end_the_wait_early(in_memory, fault, nth):
    stage, axis = homed(in_memory, settle_s=0.0)
    target_um = middle_um(stage, axis)
    in_memory.device.faults.inject(
        fault, skip=nth, when=lambda occasion: not in_memory.is_move(occasion)
    )
    # An answer that nothing checks may read as a fault: an error is allowed, a lie is not.
    with suppress(DriverError):
        stage.move_to_um({axis: target_um})
        assert in_memory.true_um(axis) == pytest.approx(target_um, abs=TOLERANCE_UM)


def test_a_move_that_never_reached_the_device_is_an_error_and_not_repeated(simulated):
    stage, axis = homed(simulated, approach_um=0.0)
    here_um = simulated.true_um(axis)
    moves = count_moves(simulated)
    simulated.device.faults.inject("drop_command", when=simulated.is_move)
    start_s = simulated.clock.now_s()
    with pytest.raises(PositionMismatchError) as caught:
        stage.move_to_um({axis: middle_um(stage, axis)})
    assert simulated.clock.now_s() - start_s < START_GRACE_S + 4 * simulated.timeout_on_clock_s
    assert caught.value.axis == axis
    assert len(moves) == 1
    assert simulated.true_um(axis) == pytest.approx(here_um, abs=0.01)


def test_a_move_whose_bytes_were_lost_never_counts_as_arrived(simulated):
    stage, axis = homed(simulated, approach_um=0.0)
    target_um = middle_um(stage, axis) + 123.4
    simulated.device.faults.inject("lose_command_byte", when=simulated.is_move)
    with suppress(DriverError):
        stage.move_to_um({axis: target_um})
        assert simulated.true_um(axis) == pytest.approx(target_um, abs=TOLERANCE_UM)


@pytest.mark.parametrize("fault", ["drop_reply", "drop_command", "garble_reply"])
def test_a_device_that_never_answers_well_is_an_error_within_its_time_limit(in_memory, fault):
    stage, axis = homed(in_memory)
    in_memory.device.faults.inject(fault, times=math.inf)
    start_s = in_memory.clock.now_s()
    with pytest.raises((TransportTimeoutError, GarbledReplyError)) as caught:
        stage.position_um(axis)
    assert in_memory.clock.now_s() - start_s < 20 * in_memory.timeout_on_clock_s
    assert caught.value.command
    # The cable is named only where bytes show noise on the line.
    assert any(words in str(caught.value) for words in (": check", "is it the device"))
    with pytest.raises(DriverError):
        stage.move_to_um({axis: middle_um(stage, axis)})


def test_a_busy_flag_that_sticks_is_an_error_after_the_time_of_distance_and_speed(simulated):
    stage, axis = homed(simulated, approach_um=0.0)
    simulated.device.faults.inject("busy_forever")
    target_um = stage.position_um(axis) + (1000.0 if stage.limits_um(axis)[0] >= 0 else -1000.0)
    start_s = simulated.clock.now_s()
    with pytest.raises(MoveTimeoutError, match="still moves after") as caught:
        stage.move_to_um({axis: target_um})
    limit_s = move_time_limit_s(1000.0, stage.speed_um_s(axis))
    assert caught.value.time_limit_s == pytest.approx(limit_s, rel=0.01)
    assert limit_s < 5.0
    # The clock also counts what a busy computer takes for the exchanges.
    assert simulated.clock.now_s() - start_s < limit_s + 20.0


def test_a_stall_is_reported_where_it_can_be_felt_and_homing_puts_it_right(simulated):
    stage, axis = homed(simulated)
    target_um = middle_um(stage, axis)
    simulated.device.faults.inject("stall")
    if simulated.senses_stalls:
        with pytest.raises(StalledError, match="clear the obstacle") as caught:
            stage.move_to_um({axis: target_um})
        assert caught.value.axis == axis
        with pytest.raises(NotHomedError):
            stage.move_to_um({axis: target_um})
    else:
        stage.move_to_um({axis: target_um})
        assert abs(simulated.true_um(axis) - target_um) > 1000.0
    stage.home()
    stage.move_to_um({axis: target_um})
    assert simulated.true_um(axis) == pytest.approx(target_um, abs=TOLERANCE_UM)


def test_a_stall_while_homing_leaves_the_axis_unknown(simulated):
    stage = simulated.make_stage()
    simulated.device.faults.inject("stall")
    with pytest.raises(StalledError):
        stage.home()
    assert not stage.is_homed(stage.axes[0])
    stage.home()
    assert stage.is_homed(stage.axes[0])


def test_silent_drift_is_invisible_to_the_counter_and_homing_puts_it_right(simulated):
    stage, axis = homed(simulated)
    target_um = middle_um(stage, axis)
    simulated.device.faults.inject("drift")
    read_um = stage.move_to_um({axis: target_um})[axis]
    assert read_um == pytest.approx(target_um, abs=TOLERANCE_UM)
    assert simulated.true_um(axis) - read_um == pytest.approx(simulated.device.drift_um, abs=1.0)
    stage.home()
    stage.move_to_um({axis: target_um})
    assert simulated.true_um(axis) == pytest.approx(target_um, abs=TOLERANCE_UM)


def test_power_lost_and_back_means_home_again(simulated):
    stage, axis = homed(simulated)
    stage.move_to_um({axis: middle_um(stage, axis)})
    simulated.device.power_cycle()
    with pytest.raises(DriverError, match="home"):
        stage.move_by_um({axis: 10.0})
    with pytest.raises(NotHomedError):
        stage.move_by_um({axis: 10.0})
    stage.home()
    stage.move_to_um({axis: middle_um(stage, axis)})
    assert simulated.true_um(axis) == pytest.approx(middle_um(stage, axis), abs=TOLERANCE_UM)


def test_power_lost_during_a_move_is_not_success(simulated, monkeypatch):
    stage, axis = homed(simulated, approach_um=0.0)
    after_first_sleep(monkeypatch, simulated.clock, 0.0, simulated.device.power_cycle)
    with pytest.raises(DriverError, match="home"):
        stage.move_to_um({axis: middle_um(stage, axis)})
    assert not stage.is_homed(axis)


@pytest.mark.parametrize("power_lost", [False, True])
def test_unplugged_in_a_move_then_replugged_it_works_again_after_homing(simulated, power_lost):
    stage, axis = homed(simulated)
    stage.set_speed_um_s(axis, 1500.0)
    simulated.device.faults.inject("unplug", when=simulated.is_move)
    with pytest.raises(PortGoneError, match="plug it in, reconnect, then home") as caught:
        stage.move_to_um({axis: middle_um(stage, axis)})
    if simulated.wire == "memory":  # a socket takes bytes for a peer that has gone
        assert "could not be stopped" in caught.value.__notes__[0]
    with pytest.raises(NotHomedError):
        stage.position_um(axis)
    with pytest.raises(DriverError):
        stage.reconnect(wait_s=0.0)
    simulated.replug(power_lost)
    stage.reconnect()
    assert stage.speed_um_s(axis) == pytest.approx(1500.0, rel=1e-3)
    with pytest.raises(NotHomedError):
        stage.move_to_um({axis: middle_um(stage, axis)})
    stage.home()
    stage.move_to_um({axis: middle_um(stage, axis)})
    assert simulated.true_um(axis) == pytest.approx(middle_um(stage, axis), abs=TOLERANCE_UM)


def test_polling_beside_a_move_mixes_up_no_replies(simulated):
    stage = simulated.make_stage(settle_s=0.0)
    stage.home()
    axis, other = stage.axes[0], stage.axes[-1]
    middle = middle_um(stage, axis)
    stage.move_to_um({axis: middle_um(stage, axis) for axis in stage.axes})
    done, polled, failures = threading.Event(), [], []

    def poll():
        while not done.is_set():
            try:
                polled.append(stage.position_um(other))
            except BaseException as error:
                failures.append(error)
                return

    poller = threading.Thread(target=poll)
    poller.start()
    try:
        for step_um in (40.0, 80.0, 20.0, 60.0):
            assert stage.move_to_um({axis: middle + step_um})[axis] == pytest.approx(
                middle + step_um, abs=TOLERANCE_UM
            )
    finally:
        done.set()
        poller.join()
    assert failures == []
    home_um = middle_um(stage, other)
    assert polled
    assert all(home_um - 100.0 < um < home_um + 100.0 for um in polled)


def test_a_closed_stage_says_that_its_port_is_gone(simulated):
    stage = simulated.make_stage()
    stage.home()
    with stage:
        pass
    with pytest.raises(PortGoneError):
        stage.position_um(stage.axes[0])


def test_an_axis_that_begins_late_is_waited_for(in_memory):
    stage, axis = homed(in_memory, approach_um=0.0)
    target_um = middle_um(stage, axis)
    in_memory.device.faults.inject("slow_start")
    assert stage.move_to_um({axis: target_um})[axis] == pytest.approx(target_um, abs=1.0)


def test_an_answer_that_came_late_is_not_left_for_the_next_question(in_memory):
    stage, axis = homed(in_memory)
    in_memory.device.faults.inject("late_reply", when=in_memory.is_question)
    stage.position_um(axis)
    in_memory.clock.sleep(2.0)
    if in_memory.replies_are_numbered:
        assert stage.position_um(axis) == pytest.approx(in_memory.true_um(axis), abs=4.0)
    else:
        assert in_memory.transport.waiting() == 0


def count_moves(rig):
    """Return a list that grows with every move that reaches the firmware."""
    moves = []
    rig.device.faults.inject(
        "drop_command",
        times=math.inf,
        when=lambda occasion: rig.is_move(occasion) and moves.append(occasion) is not None,
    )
    return moves

"""Conformance suite of stages of any protocol and wire, simulated or real.

A test module that imports all of this defines the fixture `rig`, whose `make_stage(**settings)`
opens the stage, not homed.
"""

import math

import pytest

from emmc_rig.drivers.errors import (
    LimitExceededError,
    NotHomedError,
    SpeedFixedError,
    SpeedLimitError,
    UnknownAxisError,
)

TOLERANCE_UM = 1.0


@pytest.fixture
def stage(rig):
    homed = rig.make_stage()
    homed.home()
    return homed


def middle_um(stage, axis):
    """A place in the middle of the travel, and room on both sides of it."""
    low_um, high_um = stage.limits_um(axis)
    return (low_um + high_um) / 2


def choose_speed(stage, axis, speed_um_s):
    """Set a speed, where the device has more than one."""
    try:
        stage.set_speed_um_s(axis, speed_um_s)
    except SpeedFixedError as error:
        pytest.skip(str(error))


def test_an_axis_that_was_not_homed_refuses_to_move_and_to_tell_its_position(rig):
    stage = rig.make_stage()
    stage.reconnect()
    axis = stage.axes[0]
    assert not stage.is_homed(axis)
    with pytest.raises(NotHomedError, match="home it first"):
        stage.move_to_um({axis: middle_um(stage, axis)})
    with pytest.raises(NotHomedError):
        stage.move_by_um({axis: 10.0})
    with pytest.raises(NotHomedError):
        stage.position_um(axis)


def test_homing_gives_every_axis_its_reference(stage):
    for axis in stage.axes:
        assert stage.is_homed(axis)
        assert math.isfinite(stage.position_um(axis))


def test_homing_finds_the_same_place_again(stage):
    before_um = {axis: stage.position_um(axis) for axis in stage.axes}
    stage.move_to_um({axis: middle_um(stage, axis) for axis in stage.axes})
    stage.home()
    for axis in stage.axes:
        assert stage.position_um(axis) == pytest.approx(before_um[axis], abs=TOLERANCE_UM)


def test_axes_move_together_to_where_they_are_sent(stage):
    targets_um = {axis: middle_um(stage, axis) + 100.0 * n for n, axis in enumerate(stage.axes)}
    read_um = stage.move_to_um(targets_um)
    for axis, target_um in targets_um.items():
        assert read_um[axis] == pytest.approx(target_um, abs=TOLERANCE_UM)
        assert stage.position_um(axis) == pytest.approx(target_um, abs=TOLERANCE_UM)


def test_a_relative_move_starts_from_where_the_axis_reads_to_be(stage):
    axis = stage.axes[0]
    start_um = stage.move_to_um({axis: middle_um(stage, axis)})[axis]
    end_um = stage.move_by_um({axis: -120.0})[axis]
    assert end_um == pytest.approx(start_um - 120.0, abs=2 * TOLERANCE_UM)


def test_a_target_beyond_the_limits_is_refused_before_anything_moves(stage):
    axis = stage.axes[-1]
    low_um, high_um = stage.limits_um(axis)
    here_um = stage.position_um(axis)
    for target_um in (low_um - 0.1, high_um + 0.1, math.nan, math.inf, -math.inf):
        with pytest.raises(LimitExceededError) as caught:
            stage.move_to_um({axis: target_um})
        assert caught.value.limits_um == (low_um, high_um)
    assert stage.position_um(axis) == pytest.approx(here_um, abs=TOLERANCE_UM)


def test_soft_limits_narrow_the_travel(rig):
    wide = rig.make_stage()
    axis = wide.axes[0]
    middle = middle_um(wide, axis)
    narrow = rig.make_stage(soft_limits_um={axis: (middle - 500.0, middle + 500.0)})
    low_um, high_um = narrow.limits_um(axis)
    assert middle - 500.0 <= low_um < high_um == middle + 500.0
    with pytest.raises(LimitExceededError):
        narrow.move_to_um({axis: middle + 501.0})


def test_an_unknown_axis_is_named_with_the_known_ones(stage):
    for act in (stage.position_um, stage.is_homed, stage.limits_um, stage.speed_um_s):
        with pytest.raises(UnknownAxisError, match=stage.axes[0]):
            act("no_such_axis")
    for act in (stage.home, stage.stop, stage.wait_until_settled):
        with pytest.raises(UnknownAxisError):
            act(["no_such_axis"])
    with pytest.raises(UnknownAxisError):
        stage.move_to_um({"no_such_axis": 1.0})


def test_a_speed_is_kept_and_nonsense_is_refused(stage):
    axis = stage.axes[0]
    slower_um_s = stage.speed_um_s(axis) / 2
    choose_speed(stage, axis, slower_um_s)
    assert stage.speed_um_s(axis) == pytest.approx(slower_um_s, rel=1e-3)
    for speed_um_s in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(SpeedLimitError, match="cannot move at"):
            stage.set_speed_um_s(axis, speed_um_s)
    assert stage.speed_um_s(axis) == pytest.approx(slower_um_s, rel=1e-3)


def test_stopping_a_stage_that_stands_changes_nothing(stage):
    axis = stage.axes[0]
    here_um = stage.move_to_um({axis: middle_um(stage, axis)})[axis]
    stage.stop()
    assert stage.position_um(axis) == pytest.approx(here_um, abs=TOLERANCE_UM)
    stage.move_by_um({axis: 50.0})


def test_after_a_reconnect_speeds_are_restored_and_every_axis_must_be_homed(stage):
    axis = stage.axes[0]
    speed_um_s = stage.speed_um_s(axis) / 3
    choose_speed(stage, axis, speed_um_s)
    stage.reconnect()
    assert stage.speed_um_s(axis) == pytest.approx(speed_um_s, rel=1e-3)
    with pytest.raises(NotHomedError, match="home it first"):
        stage.position_um(axis)
    stage.home()
    stage.move_to_um({axis: middle_um(stage, axis)})

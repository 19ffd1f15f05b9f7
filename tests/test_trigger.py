"""Exposure on the stage's arrival, by a line: after the move, at the place, sooner than asked."""

from contextlib import closing

import pytest

from drivers.errors import (
    CameraSettingError,
    CommandRefusedError,
    FrameLostError,
    LimitExceededError,
    StalledError,
)
from drivers.stage import StageSettings
from emmc_rig.study.benchmarks.trigger import EXPOSURE_S, MOVE_S, TriggeredRig, trigger_timing

BACKLASH_UM = 3.0


@pytest.fixture
def rig():
    made = TriggeredRig(StageSettings(settle_s=0.0))
    made.stage.home()
    return made


@pytest.mark.parametrize("places_um", [(1_000.0, 1_400.0), (2_000.0, 900.0)], ids=["up", "down"])
@pytest.mark.parametrize("delay_s", [0.0, 0.05])
def test_the_exposure_begins_on_arrival_whichever_way_the_axis_came(rig, places_um, delay_s):
    edges_s = []
    tell = rig.chain.on_output
    rig.chain.on_output = lambda *change: (edges_s.append(change[1:]), tell(*change))
    with closing(rig.open_camera()) as camera:
        for place_um in places_um:
            with camera.armed(delay_s=delay_s) as receive:
                assert rig.stage.move_and_signal_um("x", place_um) == pytest.approx(place_um, abs=1)
                frame = receive(MOVE_S)
            assert frame.exposure_s == pytest.approx(EXPOSURE_S)
            at_s = [at_s for _, level, at_s in edges_s if level][-1]
            assert rig.clock.now_s() >= at_s + delay_s + EXPOSURE_S
    assert [level for _, level, _ in edges_s] == [1, 0, 1]
    for seen_um, place_um in zip(rig.seen_um, places_um, strict=True):
        assert seen_um == pytest.approx(place_um, abs=0.1)  # from below: no backlash


def test_the_line_does_not_rise_on_the_way_to_the_approach(rig):
    rig.stage.move_to_um({"x": 5_000.0})
    places_um = []
    rig.chain.on_output = lambda device, output, level, at_s: (
        places_um.append(rig.chain.position_um(1, 1)) if level else None
    )
    rig.stage.move_and_signal_um("x", 4_000.0)
    assert places_um == [pytest.approx(4_000.0, abs=BACKLASH_UM)]


def test_a_move_that_fails_raises_no_line_and_exposes_nothing(rig):
    with closing(rig.open_camera()) as camera:
        with pytest.raises(LimitExceededError), camera.armed():
            rig.stage.move_and_signal_um("x", 1e9)
        rig.chain.faults.inject("stall", when=lambda command: b" move " in command)
        with pytest.raises(StalledError), camera.armed():
            rig.stage.move_and_signal_um("x", 9_000.0)
        assert rig.seen_um == []
        with pytest.raises(FrameLostError), camera.armed() as receive:
            receive(1.0)
        assert camera.snap().mosaic.shape  # untriggered again


def test_a_camera_without_that_line_is_refused(rig):
    with closing(rig.open_camera()) as camera:
        with pytest.raises(CameraSettingError, match="offers Software, Line0, not Line7"):
            camera.armed("Line7").__enter__()
        assert camera.snap().mosaic.shape


def test_an_output_that_the_device_lacks_is_refused_before_it_moves(rig):
    before_um = rig.chain.position_um(1, 1)
    with pytest.raises(CommandRefusedError, match="BADDATA"):
        rig.stage.move_and_signal_um("x", 3_000.0, output=9)
    assert rig.chain.position_um(1, 1) == before_um


def test_a_triggered_frame_takes_less_time_than_one_that_is_asked_for():
    timing = trigger_timing(frames=5)
    assert timing.triggered_ms < timing.asked_ms
    assert timing.triggered_ms > timing.vibration_ms + timing.exposure_ms

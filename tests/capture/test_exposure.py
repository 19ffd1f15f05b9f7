"""Exposure by itself: shots metered, alike and bracketed, and what badly exposed ones say."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import begun, plan_and_camera, request_for, stops_after
from simulated_disk import SimulatedDisk

from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.captures.amend import amendment
from emmc_rig.captures.control import Control
from emmc_rig.captures.faults import GaveUpError
from emmc_rig.captures.metering import BRACKET_STEP, METERABLE_LEVELS, Exposures, asked_of_scene
from emmc_rig.captures.plan import Metering
from emmc_rig.captures.run import planned_frames
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.errors import CameraSettingError
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.session.brightness import (
    GOOD_LEVELS,
    exposure_reasons,
    next_exposure_s,
    shot_exposures,
)
from emmc_rig.session.journal import Figures, metered
from emmc_rig.session.verify import verify
from emmc_rig.simulators.clock import ManualClock

SIZE = (24, 32)
AUTO = """
camera: rgbw-bayer-3shots
shots: [{exposure_s: auto}, {exposure_s: auto, repeats: 2}, {exposure_s: auto}]
whiteboards: null
darks: {repeats: 2}
"""
FILTERS = """
camera: programmable-aperture
shots: [{exposure_s: auto}, {exposure_s: auto}, {exposure_s: 0.02}]
whiteboards: null
darks: null
"""


@cache
def scene_samples(name, views=(5, 5)):
    return fine_scene(name, 1, 1, size=SIZE, views=views).samples


def rig_for(text, scene="near-planar", brightness=1.0, spot=0.0):
    """The simulated rig; spot: in one corner of the scene, how much brighter than white."""
    camera = plan_and_camera(text)[1]
    samples = np.float32(brightness) * scene_samples(scene, camera.views)
    if spot:
        samples = samples.copy()
        samples[:, :, :3, :3] = spot
    return simulated_rig(camera, samples, SIZE, 0, ManualClock(), rays_per_view=16)[0]


def captured(text=AUTO, disk=None, **scene):
    rig = rig_for(text, **scene)
    session, plan = begun(Path("/disk"), disk or SimulatedDisk(), rig, text)
    outcome = Sequencer(session, plan, rig).run()
    return session, outcome


@pytest.fixture(scope="module")
def session():
    return captured()[0]


def test_metered_shots_reach_the_level_alike_and_nothing_speaks_against_them(session):
    assert verify(session).is_complete
    shots = shot_exposures(session)
    assert [shot.shot for shot in shots] == [0, 1, 2]
    assert all(0.55 < shot.level < 0.9 for shot in shots)
    assert len({session.stored[f"shot-{shot}-e0-r0"].exposure_s for shot in range(3)}) == 1
    assert exposure_reasons(shots) == []
    assert not any(frame.is_optional for frame in session.needed)


def test_what_metering_asks_for_is_journalled_before_the_first_shot(session):
    kinds = [(e.kind, getattr(e, "id", "")) for e in session.journal.entries]
    decided = kinds.index(("metered", ""))
    assert [name for _, name in kinds[:decided] if name.startswith("shot")] == []
    assert ("frame", "meter-shot-0") in kinds[:decided]
    # One frame meters all shots of the same masks, filter, lamp and gain.
    assert sum(name.startswith("meter-") for _, name in kinds) == 1


@pytest.mark.parametrize("brightness", [0.01, 0.2, 3.0])
def test_the_level_is_reached_in_dim_and_bright_scenes(brightness):
    session, outcome = captured(brightness=brightness)
    assert outcome.complete
    assert all(0.55 < shot.level < 0.9 for shot in shot_exposures(session))


def test_shots_with_other_masks_are_metered_each_and_exposed_alike_unless_asked_otherwise():
    both, _ = captured(FILTERS)
    assert {f.id for f in both.frames if f.kind == "metering"} == {"meter-shot-0", "meter-shot-1"}
    alike = [both.stored[f"shot-{shot}-e0-r0"].exposure_s for shot in range(3)]
    assert alike[0] == alike[1] != alike[2] == 0.02
    own, _ = captured(FILTERS + "metering: {alike: false}\n")
    asked = metered(own.journal.entries)
    assert asked is not None
    assert set(asked.exposures_s) == {0, 1}
    assert min(asked.exposures_s.values()) == pytest.approx(alike[0], rel=0.05)


def test_a_scene_with_a_bright_spot_is_bracketed_and_its_dark_part_read_with_less_noise():
    session, outcome = captured(brightness=0.05, spot=8.0)
    assert outcome.complete
    taken_s = {name: entry.exposure_s for name, entry in session.stored.items()}
    assert taken_s["shot-0-e1-r0"] == pytest.approx(
        BRACKET_STEP * taken_s["shot-0-e0-r0"], rel=0.01
    )
    assert all(shot.saturated < 0.01 for shot in shot_exposures(session))
    assert verify(session).is_complete
    plain, _ = captured(AUTO + "metering: {bracket: false}\n", brightness=0.05, spot=8.0)
    assert not any(name.endswith("e1-r0") for name in plain.stored)


def test_no_exposure_is_longer_than_the_plan_allows():
    text = AUTO + "metering: {longest_s: 0.02}\n"
    session, _ = captured(text)
    assert session.stored["shot-0-e0-r0"].exposure_s == pytest.approx(0.02)
    (reason,) = exposure_reasons(shot_exposures(session))
    assert reason.level == "doubt"


def test_a_dark_scene_is_refused_with_what_to_do():
    with pytest.raises(GaveUpError, match=r"meter-shot-0 is black.*metering\.longest_s"):
        captured(brightness=0.0)
    session = captured()[0]
    dark = {"figures": Figures(0.0, 0.1, 0.2)}
    entry = session.stored["meter-shot-0"].model_copy(update=dark)
    frames = [frame for frame in session.frames if frame.kind == "shot"]
    with pytest.raises(CameraSettingError, match="dark"):
        asked_of_scene(frames, {"meter-shot-0": entry}, Metering(), (1e-3, 1.0))


@pytest.mark.parametrize("sensitivity", [1e-3, 0.1, 1.0, 30.0, 5e3])
@pytest.mark.parametrize("good", [METERABLE_LEVELS, GOOD_LEVELS])
def test_a_good_exposure_is_found_in_four_frames_whatever_the_light(sensitivity, good):
    exposure_s = 0.1
    for _ in range(4):
        level = min(1.0, sensitivity * exposure_s)
        next_s = next_exposure_s(exposure_s, level, (1e-6, 1e6), good)
        if next_s is None:
            break
        exposure_s = next_s
    assert good[0] <= sensitivity * exposure_s <= good[1]


def test_no_exposure_beyond_the_limits_is_tried_and_none_twice():
    assert next_exposure_s(0.1, 0.01, (0.03, 0.3)) == 0.3
    assert next_exposure_s(0.3, 0.03, (0.03, 0.3)) is None
    assert next_exposure_s(0.1, 1.0, (0.03, 0.3)) == 0.03
    assert next_exposure_s(0.03, 1.0, (0.03, 0.3)) is None


def test_a_bracket_has_two_stops_for_each_four_times_that_the_range_is_above_eight(session):
    frames = [frame for frame in session.frames if frame.is_metered_shot]
    entry = session.stored["meter-shot-0"]
    for bright_dn, longest in ((79, 1), (81, 4), (319, 4), (321, 16), (10_000, 16)):
        seen = entry.model_copy(update={"figures": Figures(0.0, 20.0, bright_dn, 10.0)})
        asked = asked_of_scene(frames, {"meter-shot-0": seen}, Metering(), (1e-6, 1e6)).asked
        assert max([f.light for f in frames if f.id in asked], default=1) == longest


def test_the_first_metering_of_a_scene_counts_where_it_is_taken_again(session):
    exposures, limits_s = Exposures(plan_and_camera(AUTO)[0], session), (1e-6, 1e3)
    decided = exposures.decide(limits_s)
    planned = next(frame for frame in session.frames if frame.kind == "metering")
    entry = session.stored[planned.id]
    exposures.learn(planned, entry.model_copy(update={"exposure_s": entry.exposure_s / 9}))
    assert exposures.decide(limits_s) == decided


@pytest.mark.parametrize("last", ["meter-shot-0", "shot-0-e0-r0", "shot-0-e1-r0"])
def test_a_capture_that_goes_on_exposes_as_it_was_decided_before(last):
    disk, control = SimulatedDisk(), Control()
    rig = rig_for(AUTO, brightness=0.05, spot=8.0)
    session, plan = begun(Path("/disk"), disk, rig, AUTO)
    assert not Sequencer(session, plan, rig, stops_after(last, control), control).run().complete
    # The lamp is brighter on the next day.
    rig = rig_for(AUTO, brightness=0.06, spot=9.6)
    assert Sequencer(session, plan, rig).run().complete
    whole, _ = captured(brightness=0.05, spot=8.0)
    assert {name: e.exposure_s for name, e in session.stored.items()} == {
        name: e.exposure_s for name, e in whole.stored.items()
    }
    assert sum(entry.kind == "metered" for entry in session.journal.entries) == 1


def test_an_edited_level_holds_for_the_shots_that_are_not_taken():
    disk, control = SimulatedDisk(), Control()
    rig = rig_for(AUTO)
    session, plan = begun(Path("/disk"), disk, rig, AUTO)
    Sequencer(session, plan, rig, stops_after("shot-0-e0-r0", control), control).run()
    text = AUTO + "metering: {level: 0.35}\n"
    edited, camera = plan_and_camera(text)
    planned = planned_frames(request_for(Path("/disk"), text), rig)
    edit = amendment(session, edited, camera, session.rig, planned)
    assert edit is not None
    session = session.amend(request_for(Path("/disk"), text).frozen(edit.frames), edit.changes)
    assert Sequencer(session, edited, rig).run().complete
    taken_s = [session.stored[f"shot-{shot}-e0-r0"].exposure_s for shot in range(3)]
    assert taken_s[1] == taken_s[2] == pytest.approx(taken_s[0] / 2, rel=0.02)

"""Exposure by itself: shots metered, alike and bracketed, and what badly exposed ones say."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import begun, plan_and_camera, request_for
from simulated_disk import SimulatedDisk

import emmc_rig as emmc
from drivers.errors import CameraSettingError
from emmc_rig.acquisition.amend import amendment
from emmc_rig.acquisition.command import _frozen, planned_frames
from emmc_rig.acquisition.control import Control
from emmc_rig.acquisition.metering import BRACKET_STEP, asked_of_scene
from emmc_rig.acquisition.plan import Metering
from emmc_rig.acquisition.retries import GaveUpError
from emmc_rig.acquisition.sequencer import Sequencer
from emmc_rig.acquisition.watcher import CaptureWatcher
from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.files.scenes import fine_scene
from emmc_rig.processing.reconstructing import expected_gain_db
from emmc_rig.session.exposure import ShotExposure, exposure_reasons, shot_exposures
from emmc_rig.session.journal import Figures, metered
from emmc_rig.session.verify import verify
from simulators.clock import ManualClock

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
    assert [one.shot for one in shots] == [0, 1, 2]
    assert all(0.55 < one.level < 0.9 for one in shots)
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
    assert all(0.55 < one.level < 0.9 for one in shot_exposures(session))


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
    assert all(one.saturated < 0.01 for one in shot_exposures(session))
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


class StopsAfter(CaptureWatcher):
    """Stops a capture once a frame is taken."""

    def __init__(self, frame_id, control):
        self.frame_id, self.control = frame_id, control

    def taken(self, planned, frame, found):
        if planned.id == self.frame_id:
            self.control.stop()


@pytest.mark.parametrize("last", ["meter-shot-0", "shot-0-e0-r0", "shot-0-e1-r0"])
def test_a_capture_that_goes_on_exposes_as_it_was_decided_before(last):
    disk, control = SimulatedDisk(), Control()
    rig = rig_for(AUTO, brightness=0.05, spot=8.0)
    session, plan = begun(Path("/disk"), disk, rig, AUTO)
    assert not Sequencer(session, plan, rig, StopsAfter(last, control), control).run().complete
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
    Sequencer(session, plan, rig, StopsAfter("shot-0-e0-r0", control), control).run()
    text = AUTO + "metering: {level: 0.35}\n"
    edited, camera = plan_and_camera(text)
    planned = planned_frames(request_for(Path("/disk"), text), rig)
    edit = amendment(session, edited, camera, session.rig, planned)
    assert edit is not None
    session = session.amend(_frozen(request_for(Path("/disk"), text), edit.frames), edit.changes)
    assert Sequencer(session, edited, rig).run().complete
    taken_s = [session.stored[f"shot-{shot}-e0-r0"].exposure_s for shot in range(3)]
    assert taken_s[1] == taken_s[2] == pytest.approx(taken_s[0] / 2, rel=0.02)


@pytest.mark.parametrize(
    ("shots", "said"),
    [
        ([ShotExposure(0, 0.05, 0.0)], "shot 0 is 5.0% of white: 11.5 dB or more"),
        ([ShotExposure(0, 0.7, 0.0), ShotExposure(1, 0.01, 0.0)], "shot 1 is 1.0% of white"),
        ([ShotExposure(0, 1.0, 0.03)], "3.0% of the readings of shot 0 are saturated"),
        ([ShotExposure(0, 0.3, 0.0005)], ""),
    ],
)
def test_badly_exposed_shots_are_a_doubt(shots, said):
    reasons = exposure_reasons(shots)
    assert [reason.level for reason in reasons] == ["doubt"] * bool(said)
    assert all(said in reason.what for reason in reasons)


def test_less_light_than_metering_asks_for_is_reported_with_its_true_cost_in_noise():
    text = AUTO.replace("auto", "0.02")
    session, _ = captured(text)
    (reason,) = exposure_reasons(shot_exposures(session))
    level = min(one.level for one in shot_exposures(session))
    assert level == pytest.approx(0.06, abs=0.03)
    assert f"{10 * np.log10(0.7 / level):.1f} dB" in reason.what


@pytest.mark.slow
def test_more_light_is_expected_to_gain_and_the_more_of_it_the_more():
    camera = emmc.camera("rgbw-bayer-2shots")
    scene = emmc.scene("near-planar", size=(32, 40))
    psi = camera.psi((32, 40))
    readings = psi @ scene
    readings += 0.1 * np.random.default_rng(0).standard_normal(readings.shape)
    result = emmc.reconstruct(psi, readings, "adaptive-fast", noise_sigma=0.1)
    none, some, most = (expected_gain_db(result, factor) for factor in (1.0, 4.0, 100.0))
    assert none == pytest.approx(0, abs=1e-9)
    assert some is not None
    assert most is not None
    assert 0.3 < some < most < 20

"""Frames of other times: as shots of the present scene, and shots between which the scene moved."""

import numpy as np
import pytest

from emmc_rig.model.camera import build_imaging_matrix, shipped_cameras
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.adaptive.times import OtherTime, aligned, moved, rested
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.methods import reconstruct
from emmc_rig.reconstruction.verdict import run
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.simulators.scenes import render

SIZE = (48, 64)
CAMERA = shipped_cameras()["rgbw-bayer-3shots"]
STEP = (1, 2)
LEAST_GAIN_DB = 0.8


def _window(frame, scene="toy-table"):
    """Return a window of a scene whose content moves by STEP a frame."""
    whole = render(scene, (5, 5), (108, 144)).light_field
    top, left = 34 - STEP[0] * frame, 44 - STEP[1] * frame
    return np.ascontiguousarray(whole[:, :, top : top + SIZE[0], left : left + SIZE[1]])


def _captured(psi, scenes):
    """Return the frames of a camera before whose shots the scenes were, one after the other."""
    clean = [psi.of_shots([shot]).forward(scene) for shot, scene in enumerate(scenes)]
    return CAMERA.read_out(np.concatenate(clean), 3)


@pytest.fixture(scope="module")
def psi():
    return build_imaging_matrix(CAMERA, SIZE)


@pytest.fixture(scope="module")
def slid(psi):
    return _captured(psi, [_window(shot) for shot in range(psi.shots)])


def _given(psi, shown):
    return "adaptive", psi, shown


def _first_alone(psi, shown):
    first = shown.of_one_deviation().cut(np.s_[:1,])
    return reconstruct("adaptive", psi.of_shots([0]), first)


@pytest.mark.parametrize("binning", [1, 2])
def test_an_aligned_frame_reads_the_present_scene(random_psi, binning):
    psi = random_psi(1, (3, 3), (16, 20), 1, binning)
    light_field = np.random.default_rng(2).random(psi.light_field_shape).astype(np.float32)
    down, right = 2 * binning, -binning
    then = np.roll(light_field, (down, right), axis=(2, 3))
    frames = psi.forward(then)
    usable = np.ones(frames.shape, bool)
    readings = Readings(psi, frames, 0.01, np.full(frames.shape, 1e-4, np.float32), usable)
    back = np.zeros((*psi.size, 2), np.float32) + np.array((down, right), np.float32) + 0.2
    carried = aligned(OtherTime(readings, usable, light_field[1, 1], -back, back), binning)
    seen = carried.usable[0]
    # What went out of the picture below, and on its left.
    assert not seen[-2:].any()
    assert not seen[:, :1].any()
    assert seen[:-2, 1:].all()
    np.testing.assert_allclose(
        carried.frames[0][seen], carried.psi.forward(light_field)[0][seen], rtol=1e-4, atol=1e-5
    )


def test_places_that_rest_have_no_flow():
    flow = np.full((20, 24, 2), 0.8, np.float32)
    rests = np.zeros((20, 24), np.float32)
    rests[:, 12:] = 1
    there, back = rested(flow, -flow, rests)
    assert np.abs(there[:, 20:]).max() < 0.01
    assert np.abs(back[:, 20:]).max() < 0.01
    assert np.allclose(there[:, :4], 0.8, atol=0.01)
    assert np.allclose(back[:, :4], -0.8, atol=0.01)


def test_shots_of_a_scene_that_moves_are_carried_to_the_first(psi, slid):
    alone, result = _first_alone(psi, slid), reconstruct(*_given(psi, slid), moving=True)
    gain_db = psnr_db(result.light_field, _window(0)) - psnr_db(alone.light_field, _window(0))
    assert gain_db > LEAST_GAIN_DB
    assert result.parameters["moved_px"] == pytest.approx(2 * np.hypot(*STEP), abs=0.5)
    assert result.parameters["seen_share"] > 0.8


def test_a_traced_scene_that_moves_by_fractions_of_a_pixel_is_carried_too():
    """Its pictures are traced anew, not moved."""
    size, scene = (64, 80), "panning-desk"
    psi = build_imaging_matrix(CAMERA, size)
    seen = [render(scene, (5, 5), size, time_s=at_s).light_field for at_s in (0.0, 0.1, 0.2)]
    shown = _captured(psi, seen)
    alone, result = _first_alone(psi, shown), reconstruct(*_given(psi, shown), moving=True)
    gain_db = psnr_db(result.light_field, seen[0]) - psnr_db(alone.light_field, seen[0])
    assert gain_db > LEAST_GAIN_DB
    # The camera swings by (0.15, 0.05) widths in 8 s; the little that it slides is left out.
    true_px = size[1] * np.hypot(0.15, 0.05) * np.sin(2 * np.pi * 0.2 / 8)
    # The largest of flows, each of which is off by 0.1 to 0.2 pixels.
    assert result.parameters["moved_px"] == pytest.approx(true_px, abs=0.3)


def test_shots_of_another_scene_do_next_to_no_harm(psi):
    other = _window(0, "near-planar")
    shown = _captured(psi, [_window(0), other, other])
    alone, result = _first_alone(psi, shown), reconstruct(*_given(psi, shown), moving=True)
    found_db, alone_db = (psnr_db(item.light_field, _window(0)) for item in (result, alone))
    assert found_db > alone_db - 0.3


@pytest.fixture
def fits(monkeypatch):
    """Of every fit, whether it was of a scene that moves."""
    made, fit = [], run.reconstruct

    def noted(*given, moving, **more):
        made.append(moving)
        return fit(*given, moving=moving, **more)

    monkeypatch.setattr(run, "reconstruct", noted)
    return made


def test_the_verdict_trusts_what_was_carried_and_says_how_far(psi, slid, fits):
    result, verdict = reconstruct_judged(*_given(psi, slid))
    assert fits == [True]
    assert psnr_db(result.light_field, _window(0)) > psnr_db(
        _first_alone(psi, slid).light_field, _window(0)
    )
    assert verdict.level == "trust"
    assert "the scene moved by up to 4." in result.screening[-1]
    assert verdict.evidence.parameters["moved_px"] == result.parameters["moved_px"]
    low, high = result.stated["stated_interval_db"]
    assert low <= psnr_db(result.light_field, _window(0)) <= high


def test_at_rest_shots_are_one_capture_as_ever(psi, fits):
    shown = _captured(psi, [_window(0)] * psi.shots)
    result, verdict = reconstruct_judged(*_given(psi, shown))
    assert fits == [False]
    assert "moved_px" not in result.parameters
    assert verdict.level == "trust"


def test_a_film_at_rest_before_a_mask_that_steps_gains_by_each_frame(psi):
    shown, film, found_db = _captured(psi, [_window(0)] * psi.shots), Film(), []
    for shot in range(psi.shots):
        seen = shown.of_one_deviation().cut(np.s_[shot : shot + 1,])
        result = reconstruct("adaptive", psi.of_shots([shot]), seen, film=film)
        film = result.film
        found_db.append(psnr_db(result.light_field, _window(0)))
    assert found_db[2] > found_db[0] + LEAST_GAIN_DB
    assert result.parameters["moved_px"] < 0.1
    assert film.known is not None
    assert len(film.known.earlier) == psi.shots


def test_a_method_without_surfaces_takes_no_scene_that_moves(psi, slid):
    with pytest.raises(ReconstructionError, match="'tv' takes no films"):
        reconstruct("tv", *_given(psi, slid)[1:], moving=True)


def test_a_small_object_that_moved_counts_by_its_own_motion(random_psi):
    psi = random_psi(1, (3, 3), (64, 96), 1, 1)
    frames = np.ones(psi.frames_shape, np.float32)
    readings = Readings(psi, frames, 0.01, frames * 1e-4, frames > 0)
    flow = np.zeros((64, 96, 2), np.float32)
    flow[20:30, 20:30] = 0, 8
    other = OtherTime(readings, readings.usable, np.ones((64, 96, 3), np.float32), flow, -flow)
    assert moved([other])["moved_px"] == pytest.approx(8)

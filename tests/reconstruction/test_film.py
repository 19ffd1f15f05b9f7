"""Films: frames that follow are fitted with earlier ones, carried along by optical flow."""

from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.model.camera import build_imaging_matrix, shipped_cameras
from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.adaptive.film import Film
from emmc_rig.reconstruction.adaptive.joint import surfaces_of
from emmc_rig.reconstruction.adaptive.survey import checked
from emmc_rig.reconstruction.adaptive.times import (
    OtherTime,
    at_places,
    flow_between,
    joined,
    sampled,
)
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.methods import reconstruct
from emmc_rig.simulators.scenes import render

SIZE = (48, 64)
LEAST_GAIN_DB, MOST_LOSS_DB = 0.3, 0.2
CAMERA = shipped_cameras()["scenario-ii-cfa"]


def _sliding(frame: int, step: tuple[int, int] = (1, 2), scene: str = "toy-table"):
    """Return a window of a scene whose content moves by whole pixels a frame."""
    whole = render(scene, (5, 5), (108, 144)).light_field
    top, left = 34 - step[0] * frame, 44 - step[1] * frame
    return np.ascontiguousarray(whole[:, :, top : top + SIZE[0], left : left + SIZE[1]])


def _readings(psi, light_field, seed):
    return CAMERA.read_out(psi.forward(light_field), seed)


@pytest.fixture(scope="module")
def psi():
    return build_imaging_matrix(CAMERA, SIZE)


@pytest.fixture(scope="module")
def followed(psi):
    """Return the truths, the film's results and those of each frame alone."""
    film, out = Film(), []
    for frame in range(4):
        truth = _sliding(frame)
        shown = _readings(psi, truth, frame)
        given = "adaptive", psi, shown
        result = reconstruct(*given, film=film)
        film = result.film
        out.append((truth, result, reconstruct(*given)))
    return out


def test_flow_of_a_sliding_picture_is_its_motion():
    first, second = (_sliding(frame)[2, 2] for frame in (0, 1))
    there, back = flow_between(first, second)
    inner = np.s_[8:-8, 8:-8]
    assert np.median(np.abs(there[inner] - (1, 2))) < 0.1
    assert np.median(np.abs(back[inner] + (1, 2))) < 0.1


def test_a_flow_after_another_leads_where_both_lead():
    first = np.broadcast_to(np.array((1.5, -2), np.float32), (20, 30, 2))
    second = 0.1 * at_places((20, 30))
    both = joined(first, second)
    assert np.allclose(
        both[5:10, 10:15], sampled(second, at_places((20, 30)) + first)[5:10, 10:15] + first[0, 0]
    )
    assert np.allclose(both[5, 10], (1.5 + 0.1 * 6.5, -2 + 0.1 * 8), atol=1e-4)


def test_an_earlier_frame_sees_the_present_texture_where_it_was(psi):
    rng = np.random.default_rng(0)
    margin, shape = 8, (SIZE[0] + 16, SIZE[1] + 16)
    texture = rng.random((3, *shape), dtype=np.float32)
    centre = np.full(shape, 0.75, np.float32)
    there = np.zeros((*SIZE, 2), np.float32) + np.array((2, -3), np.float32)
    readings = Readings(
        psi,
        np.zeros(psi.frames_shape),
        0.01,
        np.ones(psi.frames_shape),
        np.ones(psi.frames_shape, bool),
    )
    earlier = OtherTime(readings, readings.usable, np.zeros((*SIZE, 3)), there, -there)
    seen = earlier.surfaces(centre, margin, 1, 3).forward(texture)
    then = np.roll(texture, (-2, 3), axis=(1, 2))
    expected = surfaces_of(psi, centre, margin, 1).forward(then)
    inner = np.s_[:, 8:-8, 8:-8]
    assert np.allclose(seen[inner], expected[inner], atol=2e-4)
    assert not np.allclose(
        seen[inner], surfaces_of(psi, centre, margin, 1).forward(texture)[inner], atol=0.02
    )


def test_a_film_goes_on_where_disparities_shrank_as_they_were_fitted(psi, monkeypatch):
    after, shown = Film.after, _readings(psi, _sliding(0), 0)

    def shrunk(film, plain, scene, *more):
        return after(film, plain, replace(scene, centre=0 * scene.centre), *more)

    monkeypatch.setattr(Film, "after", shrunk)
    given = psi, shown
    known = reconstruct("adaptive-fast", *given, film=Film()).film.known
    assert known.texture.shape[1:] == known.centre.shape
    assert known.centre.shape == tuple(length + 2 * known.margin for length in SIZE)


def test_a_film_is_more_accurate_than_its_frames_alone(followed):
    gains = [
        psnr_db(result.light_field, truth) - psnr_db(alone.light_field, truth)
        for truth, result, alone in followed[2:]
    ]
    assert np.mean(gains) > 0.5, gains
    assert all("new_share" in result.parameters for _, result, _ in followed[1:])


def _last_psnr_db(psi, followed, of_earlier):
    """Return the PSNR of the last frame, with the earlier frames that it goes on from changed."""
    film = followed[-2][1].film
    known = replace(film.known, earlier=tuple(of_earlier(item) for item in film.known.earlier))
    shown = _readings(psi, followed[-1][0], len(followed) - 1)
    given = "adaptive", psi, shown
    result = reconstruct(*given, film=replace(film, known=known))
    return psnr_db(result.light_field, followed[-1][0])


def _unused(known):
    return replace(known, used=np.zeros_like(known.used))


def test_earlier_frames_themselves_make_the_next_one_more_accurate(psi, followed):
    alone_db = _last_psnr_db(psi, followed, _unused)
    assert psnr_db(followed[-1][1].light_field, followed[-1][0]) > alone_db + LEAST_GAIN_DB


def test_earlier_frames_of_something_else_do_next_to_no_harm(psi, followed):
    def of_something_else(known):
        frames = np.ascontiguousarray(known.readings.frames[:, ::-1, ::-1])
        return replace(known, readings=replace(known.readings, frames=frames))

    alone_db = _last_psnr_db(psi, followed, _unused)
    assert _last_psnr_db(psi, followed, of_something_else) > alone_db - MOST_LOSS_DB


def test_the_flow_reported_is_the_motion(followed):
    assert followed[-1][1].parameters["flow_px"] == pytest.approx(np.hypot(1, 2), abs=0.3)


def test_the_first_frame_is_that_of_a_capture(followed):
    _, result, alone = followed[0]
    assert np.array_equal(result.light_field, alone.light_field)
    assert alone.film is None


def test_the_psnr_mostly_lies_in_the_interval_stated(followed):
    inside = 0
    for truth, result, _ in followed:
        low, high = result.stated["stated_interval_db"]
        inside += low <= psnr_db(result.light_field, truth) <= high
    assert inside >= len(followed) - 1


def test_after_a_cut_a_frame_is_a_first_one(psi, followed):
    shown = _readings(psi, _sliding(0, scene="near-planar"), 9)
    given = "adaptive", psi, shown
    result = reconstruct(*given, film=followed[-1][1].film)
    assert "new_share" not in result.parameters
    assert np.array_equal(result.light_field, reconstruct(*given).light_field)


def test_a_frame_that_earlier_ones_mislead_is_a_first_one(psi, followed):
    truth, result, alone = followed[-1]
    film = followed[-2][1].film
    easier = replace(film, known=replace(film.known, missed=0.5 * film.known.missed))
    shown = _readings(psi, truth, len(followed) - 1)
    given = "adaptive", psi, shown
    found = reconstruct(*given, film=easier)
    assert "new_share" in result.parameters
    assert "new_share" not in found.parameters
    assert np.array_equal(found.light_field, alone.light_field)
    assert found.film.known.missed == easier.known.missed


SHOWN = np.s_[:, :, 36:42, 50:56]
"""Where an object appears before a scene that rests."""


@pytest.fixture(scope="module")
def resting(psi):
    """Return the truths and results of a resting scene before which an object appears at last."""
    truth, film, out = render("toy-table", (5, 5), SIZE).light_field, Film(), []
    changed = truth.copy()
    changed[SHOWN] = 1 - truth[SHOWN]
    for frame, seen in enumerate((truth, truth, changed, changed)):
        steps = []
        result = reconstruct(
            "adaptive-fast", psi, _readings(psi, seen, frame), film=film, on_step=steps.append
        )
        film = result.film
        out.append((seen, result, steps))
    return out


def test_a_resting_scene_is_not_fitted_again_and_stays_what_it_was(resting):
    (_, first, _), (_, second, steps) = resting[:2]
    assert second.parameters["still_share"] > 0.95
    assert second.steps == 0
    assert [(step.step, step.total) for step in steps] == [(1, 1)]
    np.testing.assert_allclose(second.light_field, first.light_field, atol=1 / 65535)
    assert np.array_equal(second.maps["disparity"], first.maps["disparity"])


def test_readings_of_resting_places_are_averaged(psi, resting):
    truth, result, _ = resting[1]
    rest = result.film.known.rest
    shown = [_readings(psi, truth, frame) for frame in range(2)]
    mean = np.mean([frame.readings for frame in shown], axis=0)
    rests = (rest.count == 2)[None]
    assert rests.mean() > 0.95
    given = checked(psi, replace(shown[1], readings=mean))
    np.testing.assert_allclose(rest.readings[rests], given.frames[rests], atol=1e-6)
    np.testing.assert_allclose(rest.mean(given).noise[rests], given.noise[rests] / 2, rtol=1e-5)


def test_the_mean_of_readings_is_fitted_after_frames_at_rest(psi):
    truth, film, found = render("near-planar", (5, 5), SIZE).light_field, Film(), []
    rng, exact = np.random.default_rng(0), psi.forward(truth)
    for _ in range(5):
        noisy = exact + rng.normal(0, 0.02, exact.shape).astype(np.float32)
        result = reconstruct("adaptive-fast", psi, even_frames(noisy, 0.02), film=film)
        film = result.film
        found.append(result)
    assert [result.steps > 0 for result in found] == [True, False, False, True, False]
    before_db, after_db = (psnr_db(found[n].light_field, truth) for n in (2, 3))
    assert after_db > before_db + LEAST_GAIN_DB


def test_of_an_object_before_a_resting_scene_only_its_surroundings_are_fitted(resting):
    (_, before, _), (truth, last, steps) = resting[1:3]
    rest = last.film.known.rest
    object_px = rest.count[SHOWN[2:]]
    assert (object_px == 1).all(), "all pixels of the object are found to have changed"
    assert 0.5 < last.parameters["still_share"] < 1
    fitted = (last.light_field != before.light_field).any(axis=(0, 1, 4))
    assert fitted[SHOWN[2:]].all()
    assert fitted.mean() < 0.5
    far = np.s_[:, :, :, :20]
    assert np.array_equal(last.light_field[far], before.light_field[far])
    was, now = (np.abs(of.light_field - truth)[SHOWN].mean() for of in (before, last))
    assert now < 0.5 * was
    assert [step.step for step in steps] == sorted(step.step for step in steps)
    assert steps[-1].step == steps[-1].total


def test_an_object_that_stays_rests_in_the_next_frame(resting):
    assert resting[3][1].parameters["still_share"] > 0.95
    assert (resting[3][1].film.known.rest.count[SHOWN[2:]] == 2).mean() > 0.9


def test_a_pixel_without_a_reading_rests_on_its_earlier_ones(psi, resting):
    truth, first, _ = resting[0]
    shown = _readings(psi, truth, 7)
    usable = shown.usable.copy()
    usable[:, 10:14, 10:14] = False
    readings = np.where(usable, shown.readings, 1)
    given = replace(shown, readings=readings, usable=usable)
    rest = reconstruct("adaptive-fast", psi, given, film=first.film).film.known.rest
    assert (rest.count[10:14, 10:14] == 1).all()
    before = first.film.known.rest
    assert np.array_equal(rest.readings[:, 10:14, 10:14], before.readings[:, 10:14, 10:14])


def test_the_psnr_of_resting_frames_lies_in_the_interval_stated(resting):
    for truth, result, _ in resting:
        low, high = result.stated["stated_interval_db"]
        assert low <= psnr_db(result.light_field, truth) <= high


def test_a_camera_that_moves_sees_nothing_rest(followed):
    assert all(result.parameters["still_share"] == 0 for _, result, _ in followed[1:])


def test_of_a_camera_that_moves_slowly_frames_follow_from_the_same_one(psi):
    film, known = Film(), []
    for seed, px in enumerate((0, 0.15, 0.6)):
        moved = px * _sliding(1, (0, 1)) + (1 - px) * _sliding(0)
        shown = _readings(psi, moved, seed)
        result = reconstruct("adaptive-fast", psi, shown, film=film)
        film = result.film
        known.append(film.known)
    assert known[1] is known[0]
    # The motion since that frame, not since the last one.
    assert result.parameters["flow_px"] > 0.4
    assert known[2] is not known[0]


def test_a_film_of_another_size_is_refused(psi, followed):
    small = build_imaging_matrix(CAMERA, (40, 48))
    frames = np.full(small.frames_shape, 0.2, np.float32)
    with pytest.raises(ReconstructionError, match="48x64 samples, this Psi is of 40x48"):
        reconstruct("adaptive", small, even_frames(frames, 0.01), film=followed[0][1].film)


def test_a_method_that_takes_no_films_says_which_do(psi):
    frames = np.full(psi.frames_shape, 0.2, np.float32)
    with pytest.raises(
        ReconstructionError, match="'tv' takes no films: choose one of adaptive, adaptive-fast"
    ):
        reconstruct("tv", psi, even_frames(frames, 0.01), film=Film())

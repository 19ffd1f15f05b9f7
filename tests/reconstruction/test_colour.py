"""Colours without filters: what masks show of them, and how much of them is left to chance."""

import numpy as np
import pytest

from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.reconstruction.colour import chroma_of, coloured, unseen_colour
from emmc_rig.reconstruction.problem import smooth_guess
from emmc_rig.study.trial import Capture, trial_of

SIZE = (48, 64)


def everywhere(psi):
    return np.ones(psi.frames_shape, dtype=bool)


def even(psi, colour):
    scene = np.broadcast_to(np.asarray(colour, np.float32), psi.light_field_shape)
    return psi.forward(scene)


@pytest.fixture(scope="module")
def one_shot():
    return build_imaging_matrix(find_camera("scenario-iii-mono"), SIZE)


@pytest.mark.parametrize("colour", [(0.6, 0.3, 0.2), (0.2, 0.5, 0.3), (0.4, 0.4, 0.4)])
def test_the_colour_of_an_even_scene_follows_from_one_grey_shot(one_shot, colour):
    picture = smooth_guess(one_shot, even(one_shot, colour), everywhere(one_shot))
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), colour, atol=0.01)


def test_pixels_that_are_not_usable_do_not_count(one_shot):
    usable = everywhere(one_shot)
    usable[:, 10:14, 20:24] = False
    frames = np.where(usable, even(one_shot, (0.6, 0.3, 0.2)), 50)
    picture = smooth_guess(one_shot, frames, usable)
    np.testing.assert_allclose(picture.mean(axis=(0, 1)), (0.6, 0.3, 0.2), atol=0.01)


def test_grey_masks_show_no_colour_and_all_of_it_is_left_to_chance():
    psi = build_imaging_matrix(find_camera("coded-aperture-random"), SIZE)
    usable = everywhere(psi)
    frames = even(psi, (0.6, 0.3, 0.2))
    picture = smooth_guess(psi, frames, usable)
    assert np.ptp(picture, axis=-1).max() < 1e-3
    unseen = unseen_colour(psi, frames, usable, picture) / np.square(picture.mean(axis=-1))
    # What is presumed: two chrominances of deviation 0.1, and two finer ones of 0.07.
    np.testing.assert_allclose(unseen, 2 * (0.1**2 + 0.07**2), rtol=0.01)


def test_colour_filters_leave_no_colour_unseen():
    psi = build_imaging_matrix(find_camera("scenario-ii-cfa"), SIZE)
    frames, usable = even(psi, (0.6, 0.3, 0.2)), everywhere(psi)
    assert not unseen_colour(psi, frames, usable, np.full((*SIZE, 3), 0.4)).any()


def test_more_shots_leave_less_colour_unseen():
    def unseen(shots):
        camera = find_camera("scenario-iii-mono").with_shots(shots)
        given = trial_of(Capture("deep-occlusions", camera, SIZE, zoom=3))
        picture = smooth_guess(given.psi, given.readings, given.usable)
        return unseen_colour(given.psi, given.readings, given.usable, picture).mean()

    assert unseen(3) < 0.5 * unseen(1)


@pytest.mark.parametrize("scene", ["deep-occlusions", "near-planar"])
def test_the_deviation_of_colours_is_that_of_their_error(scene):
    given = trial_of(Capture(scene, find_camera("scenario-iii-mono"), SIZE, zoom=3))
    truth = given.truth @ OPPONENT[1:].T
    picture = smooth_guess(given.psi, given.readings, given.usable)
    error = np.square(picture @ OPPONENT[1:].T - truth).sum(axis=-1).mean() / 3
    stated = unseen_colour(given.psi, given.readings, given.usable, picture).mean()
    assert 0.4 < stated / error < 2.5


def test_coloured_light_fields_are_seen_better_than_grey_ones():
    given = trial_of(Capture("deep-occlusions", find_camera("scenario-iii-mono"), SIZE, zoom=3))
    usable = given.usable
    picture = smooth_guess(given.psi, given.readings, usable)
    grey = np.repeat(picture.mean(axis=-1, keepdims=True), 3, axis=-1)
    np.testing.assert_allclose(
        coloured(given.psi, given.readings, usable, grey), picture, atol=0.01
    )
    truth = given.truth.mean(axis=(0, 1))
    assert np.square(picture - truth).mean() < 0.8 * np.square(grey - truth).mean()


def test_binned_pixels_tell_colours_too():
    camera = find_camera("scenario-iii-mono")
    sensor = camera.sensor.model_copy(update={"binning": 2})
    psi = build_imaging_matrix(camera.model_copy(update={"sensor": sensor}), SIZE)
    found = chroma_of(psi, even(psi, (0.6, 0.3, 0.2)), everywhere(psi), np.full((*SIZE, 3), 0.3667))
    expected = (OPPONENT[1:] @ (0.6, 0.3, 0.2)) / (OPPONENT[0] @ (0.6, 0.3, 0.2))
    np.testing.assert_allclose(found.value.mean(axis=(0, 1)), expected, atol=0.02)

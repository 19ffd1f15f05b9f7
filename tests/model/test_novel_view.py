"""Views between views: planes move as they must, near things hide far ones, light is averaged."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.novel_view import (
    between,
    centre_disparity,
    estimated_disparity,
    sampled,
    view_disparities,
)

VIEWS, SIZE = (5, 5), (60, 80)
INNER = np.s_[8:-8, 8:-8]


def waves(y, x, seed=0):
    """A smooth texture at any place, (y, x, 3)."""
    phases = np.random.default_rng(seed).uniform(0, 6, 3)
    return np.stack([0.5 + 0.4 * np.sin(0.35 * x + 0.2 * y + p) for p in phases], axis=-1)


def layered(v, u, far_px=-1.0, near_px=2.0):
    """A near square before a far plane, seen from (v, u): picture (y, x, 3), disparity (y, x)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    near_y, near_x = y - near_px * (v - 2), x - near_px * (u - 2)
    near = (np.abs(near_y - 30) < 12) & (np.abs(near_x - 40) < 16)
    far = waves(y - far_px * (v - 2), x - far_px * (u - 2))
    picture = np.where(near[..., None], waves(near_y, near_x, 1) * [1, 0.3, 0.3], far)
    return picture.astype(np.float32), np.where(near, near_px, far_px).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    seen = [[layered(v, u) for u in range(5)] for v in range(5)]
    light_field = np.array([[item[0] for item in row] for row in seen])
    disparities = np.array([[item[1] for item in row] for row in seen])
    return light_field, disparities


@pytest.mark.parametrize("size", [(7, 9), (1, 5), (6, 1)])
def test_samples_between_pixels_are_those_of_scipy(size):
    rng = np.random.default_rng(3)
    picture = rng.random((*size, 3), np.float32)
    y, x = (rng.uniform(-2, length + 1, (20, 30)).astype(np.float32) for length in size)
    for c in range(3):
        twin = map_coordinates(picture[..., c].astype(float), (y, x), order=1, mode="nearest")
        np.testing.assert_allclose(sampled(picture, y, x)[..., c], twin, atol=1e-6)
        np.testing.assert_allclose(sampled(picture[..., c], y, x), twin, atol=1e-6)


def test_a_view_that_there_is_comes_back_as_it_is(scene):
    light_field, disparities = scene
    np.testing.assert_allclose(
        between(light_field, disparities, 3, 1), light_field[3, 1], atol=1e-6
    )


@pytest.mark.parametrize(("v", "u"), [(1.5, 2.5), (0.25, 3.0), (3.4, 3.9)])
def test_a_view_between_has_near_before_far_where_they_truly_are(scene, v, u):
    light_field, disparities = scene
    drawn, (truth, depth) = between(light_field, disparities, v, u), layered(v, u)
    # Along the square's outline a ray's nearest samples are of two surfaces.
    outline = cv2.dilate(
        cv2.Laplacian(depth, cv2.CV_32F).astype(bool).astype(np.uint8), np.ones((5, 5))
    )
    clear = outline[INNER] == 0
    missed = np.abs(drawn - truth)[INNER][clear]
    assert missed.max() < 0.01
    nearest = light_field[round(v), round(u)]
    assert missed.mean() < np.abs(nearest - truth)[INNER][clear].mean() / 3


def test_surfaces_far_apart_are_drawn_the_near_one_before_the_far_one():
    """Weights fall exponentially with the distance behind the nearest surface, and none overflows.

    A gap of 30 px between views: behind the outline, some views see the far plane alone.
    """
    far_px, near_px = -15.0, 15.0
    seen = [[layered(v, u, far_px, near_px) for u in range(5)] for v in range(5)]
    light_field = np.array([[picture for picture, _ in row] for row in seen])
    disparities = np.array([[disparity for _, disparity in row] for row in seen])
    drawn = between(light_field, disparities, 2.25, 2.5)
    truth, depth = layered(2.25, 2.5, far_px, near_px)
    inside = cv2.erode((depth == near_px).astype(np.uint8), np.ones((9, 9))) > 0
    assert inside.sum() > 200
    assert np.abs(drawn - truth)[inside].max() < 0.01
    assert np.isfinite(drawn).all()


def test_what_every_view_sees_follows_from_the_centre(scene):
    _, disparities = scene
    made = view_disparities(centre_view(disparities[..., None])[..., 0], VIEWS)
    agreed = np.abs(made - disparities)[:, :, *INNER] < 0.01
    assert agreed.mean() > 0.99
    assert np.isfinite(made).all()


def test_a_disparity_of_the_centre_view_is_taken_and_any_other_estimated(scene):
    light_field, disparities = scene
    given = disparities[2, 2].copy()
    given[:3] = np.nan
    taken = centre_disparity(light_field, given)
    np.testing.assert_array_equal(taken[3:], given[3:])
    assert (taken[:3] == -1).all()  # the median: most of the picture is the far plane
    for other in (None, given[::2, ::2]):
        made = centre_disparity(light_field, other)
        np.testing.assert_array_equal(made, estimated_disparity(light_field))

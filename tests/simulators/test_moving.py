"""Scenes that move: places and optical flow against closed forms, and against what is rendered."""

import cv2
import numpy as np
import pytest
from smooth_texture import SMOOTH, UNLIT

from emmc_rig.formats.scenes import fine_scene, open_scene
from emmc_rig.model.lightfield import centre_view
from emmc_rig.simulators.moving import flow_between, world_at
from emmc_rig.simulators.raycaster import Ball, CameraMotion, Card, Motion, World, tabulated
from emmc_rig.simulators.scenes import MOVING_SCENES, flow_px, render, rendered

SIZE_PX = (48, 64)
PICTURE_PLANE = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], dtype=float)
WALL = Card(SMOOTH, -2.0, PICTURE_PLANE, tiled=True)
# A square of a quarter of the width in the middle of the picture.
SQUARE = np.array([[4, 0, 0.5], [0, 4, 0.5], [0, 0, 1]], dtype=float)
STANDING = CameraMotion()


def world(*things: Card | Ball, camera: CameraMotion = STANDING) -> World:
    cards = tuple(thing for thing in things if isinstance(thing, Card))
    balls = tuple(thing for thing in things if isinstance(thing, Ball))
    return World(cards, balls, UNLIT, ambient=1.0, camera=camera)


def carried(view: np.ndarray, by_px: np.ndarray) -> np.ndarray:
    """The later view, sampled where each pixel's point went; 0 where the point is hidden."""
    y, x = np.indices(view.shape[:2], dtype=np.float32)
    to = np.where(np.isfinite(by_px), by_px, -1e3).astype(np.float32)
    return cv2.remap(view, x + to[..., 0], y + to[..., 1], cv2.INTER_CUBIC)


def test_a_card_swings_as_its_motion_says_and_hides_what_it_comes_before():
    swing = Motion((0.125, 0.0, 0.0), period_s=4.0)
    moving = world(WALL, Card(SMOOTH, 1.0, SQUARE, motion=swing))
    # A quarter of the period later it has gone an eighth of the width: 8 pixels to the right.
    found = flow_between(moving, SIZE_PX, 0.0, 1.0)
    np.testing.assert_allclose(found[16:32, 24:40], np.broadcast_to([8, 0], (16, 16, 2)))
    still = found[:, :24]
    np.testing.assert_allclose(still, np.zeros_like(still), atol=1e-12)
    assert np.isnan(found[16:32, 40:48]).all()
    assert np.isfinite(np.delete(found, np.s_[16:32], axis=0)).all()


def test_a_card_turns_about_its_centre_by_the_angle_of_its_rate():
    moving = world(WALL, Card(SMOOTH, 1.0, SQUARE, motion=Motion(turn_rad_s=(0, 0, 0.4))))
    found = flow_between(moving, SIZE_PX, 0.0, 0.5)
    y, x = np.indices(SIZE_PX)
    from_middle = np.stack([x + 0.5 - 32, y + 0.5 - 24], axis=-1)
    cos, sin = np.cos(0.2), np.sin(0.2)
    expected = from_middle @ np.array([[cos, sin], [-sin, cos]]) - from_middle
    np.testing.assert_allclose(found[16:32, 24:40], expected[16:32, 24:40], atol=1e-9)


def test_a_tilted_card_that_is_moved_keeps_the_disparity_of_each_of_its_points():
    tilted = Card(SMOOTH, 1.0, PICTURE_PLANE, slope_s=3.0, slope_t=-1.0, tiled=True)
    moving = world(Card(**{**vars(tilted), "motion": Motion((0.125, 0.0, 0.5), period_s=4.0)}))
    before, after = (
        rendered(tabulated(world_at(moving, time_s)), (5, 5), SIZE_PX).disparity_px
        for time_s in (0.0, 1.0)
    )
    nearer_px = 0.5 * SIZE_PX[1] / 256
    np.testing.assert_allclose(after[:, 8:], before[:, :-8] + nearer_px, atol=1e-6)


def test_a_camera_that_slides_by_a_view_step_sees_what_the_next_view_saw():
    camera = CameraMotion(slide=1 / 5, period_s=4.0)
    cards = (WALL, Card(SMOOTH, 3.0, SQUARE, slope_s=2.0))
    before, after = (
        rendered(tabulated(world_at(world(*cards, camera=camera), time_s)), (5, 5), SIZE_PX)
        for time_s in (0.0, 1.0)
    )
    np.testing.assert_allclose(after.light_field[:, :4], before.light_field[:, 1:], atol=1e-5)


@pytest.mark.parametrize("turn_rad_s", [(0, 0, 0.5), (0, 0.5, 0), (0.3, -0.2, 0.4)])
def test_the_flow_of_a_rolling_ball_carries_its_colours(turn_rad_s):
    size = (192, 256)
    motion = Motion((0.1, 0.05, 0.5), 6.0, turn_rad_s)
    moving = world(WALL, Ball(0.0, 0.0, 0.5, 0.2, 0.8, SMOOTH, motion=motion))
    views = [
        rendered(tabulated(world_at(moving, time_s)), (1, 1), size).light_field[0, 0]
        for time_s in (0.4, 0.9)
    ]
    found = flow_between(moving, size, 0.4, 0.9)
    seen = np.isfinite(found).all(axis=-1)
    # At the limb the pixels of either time mix ball and wall.
    inner = cv2.erode(np.asarray(seen, dtype=np.uint8), np.ones((7, 7))).astype(bool)
    error = np.abs(carried(views[1], found) - views[0])[inner]
    assert inner.mean() > 0.5
    # The light from above stays with the room, a quarter of it less per radius downwards.
    assert np.percentile(error, 99) < 0.05
    assert np.percentile(np.abs(views[1] - views[0])[inner], 99) > 0.2


@pytest.mark.parametrize("name", MOVING_SCENES)
def test_a_built_in_scene_moves_and_its_flow_returns(name):
    at_0, later = (render(name, (3, 3), SIZE_PX, 1, time_s=time_s) for time_s in (0.0, 0.5))
    still_error = np.abs(centre_view(later.light_field) - centre_view(at_0.light_field))
    found = flow_px(name, SIZE_PX, 1, 0.0, 0.5)
    seen = np.isfinite(found).all(axis=-1)
    assert 0.8 < seen.mean() < 1
    error = np.abs(carried(centre_view(later.light_field), found) - centre_view(at_0.light_field))
    assert error[seen].mean() < 0.6 * still_error[seen].mean()
    back = flow_px(name, SIZE_PX, 1, 0.5, 0.0)
    returned = found + carried(back, found)
    # Where a pixel lies between two surfaces the way back is one of either.
    assert np.nanmedian(np.abs(returned)) < 0.02


def test_a_capture_is_simulated_of_the_scene_as_it_is_at_a_time():
    fine = fine_scene("moving-toys", 2, 1, size=SIZE_PX, views=(2, 2), seed=1, time_s=0.5)
    samples = render("moving-toys", (4, 4), SIZE_PX, 1, time_s=0.5).light_field
    np.testing.assert_array_equal(fine.samples, samples)
    assert not np.array_equal(samples, render("moving-toys", (4, 4), SIZE_PX, 1).light_field)
    assert open_scene("moving-toys", SIZE_PX, (2, 2)).light_field.shape == (2, 2, *SIZE_PX, 3)


def test_a_scene_that_does_not_move_is_the_same_at_any_time():
    still, later = (render("toy-table", (2, 2), SIZE_PX, time_s=time_s) for time_s in (0.0, 3.0))
    np.testing.assert_array_equal(later.light_field, still.light_field)
    np.testing.assert_allclose(flow_px("toy-table", SIZE_PX, 0, 0.0, 3.0), 0, atol=1e-9)

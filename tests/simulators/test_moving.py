"""Scenes that move: renderings at a time, compared with renderings of worlds that stand still."""

import numpy as np
from smooth_texture import SMOOTH, UNLIT

from emmc_rig.formats.scenes import fine_scene, open_scene
from emmc_rig.simulators.moving import world_at
from emmc_rig.simulators.raycaster import Ball, CameraMotion, Card, Motion, World, tabulated
from emmc_rig.simulators.scenes import render, rendered

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


def centre(world, time_s=0.0, size=SIZE_PX):
    return rendered(tabulated(world_at(world, time_s)), (1, 1), size).light_field[0, 0]


def test_a_card_swings_by_its_motion_and_hides_what_it_comes_before():
    swing = Motion((0.125, 0.0, 0.0), period_s=4.0)
    moving = world(WALL, Card(SMOOTH, 1.0, SQUARE, motion=swing))
    # A quarter of the period later it has gone an eighth of the width: 8 pixels to the right.
    before, after = centre(moving), centre(moving, 1.0)
    np.testing.assert_allclose(after[16:32, 32:48], before[16:32, 24:40], atol=1e-6)
    np.testing.assert_array_equal(after[:, :24], before[:, :24])


def test_a_card_turns_about_its_centre_and_a_ball_about_its_own_by_their_rates():
    size, turning = (48, 48), Motion(turn_rad_s=(0, 0, np.pi / 2))
    card = world(Card(SMOOTH, 1.0, SQUARE, motion=turning))
    np.testing.assert_allclose(
        centre(card, 1.0, size), np.rot90(centre(card, 0.0, size), -1), atol=1e-5
    )
    rolling = Ball(0.0, 0.0, 0.5, 0.2, 0.8, SMOOTH, motion=Motion((0.1, 0.05, 0.5), 4.0, (1, 2, 3)))
    still = Ball(0.1, 0.05, 1.0, 0.2, 0.8, SMOOTH, turn=(1.0, 2.0, 3.0))
    expected = rendered(tabulated(world(still)), (1, 1), SIZE_PX).light_field[0, 0]
    np.testing.assert_allclose(centre(world(rolling), 1.0), expected, atol=1e-6)


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


def test_a_capture_is_simulated_of_the_scene_as_it_is_at_a_time():
    fine = fine_scene("moving-toys", 2, 1, size=SIZE_PX, views=(2, 2), seed=1, time_s=0.5)
    samples = render("moving-toys", (4, 4), SIZE_PX, 1, time_s=0.5).light_field
    np.testing.assert_array_equal(fine.samples, samples)
    assert not np.array_equal(samples, render("moving-toys", (4, 4), SIZE_PX, 1).light_field)
    assert open_scene("moving-toys", SIZE_PX, (2, 2)).light_field.shape == (2, 2, *SIZE_PX, 3)


def test_a_scene_that_does_not_move_is_the_same_at_any_time():
    still, later = (render("toy-table", (2, 2), SIZE_PX, time_s=time_s) for time_s in (0.0, 3.0))
    np.testing.assert_array_equal(later.light_field, still.light_field)

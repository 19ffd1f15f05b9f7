"""Worlds that move: where everything is at a time.

Every object is moved by an affine map of (S, T, D), D as quoted, from its place at time 0. A flat
card stays flat under it; a ball stays a ball, whose centre moves as the map says.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.simulators.raycaster import (
    QUOTED,
    Ball,
    Card,
    World,
)

Array = NDArray[np.float64]


def world_at(world: World, time_s: float) -> World:
    """Return the world as it is at a time, in seconds."""
    return replace(
        world,
        cards=tuple(moved_card(card, _map_of(card, world, time_s)) for card in world.cards),
        balls=tuple(_moved_ball(b, _map_of(b, world, time_s), time_s) for b in world.balls),
    )


def _map_of(thing: Card | Ball, world: World, time_s: float) -> Array:
    """Return the affine map (4, 4) of (S, T, D as quoted, 1) from time 0 to a time."""
    motion, centre = thing.motion, _centre(thing)
    swung = np.sin(2 * np.pi * time_s / motion.period_s)
    turn = cv2.Rodrigues(time_s * np.array(motion.turn_rad_s, float))[0]
    if isinstance(thing, Ball):
        # Turned in the space in which the ball is round.
        radii = np.array([thing.radius, thing.radius, thing.depth])
        turn = turn * radii[:, np.newaxis] / radii
    own = np.eye(4)
    own[:3, :3] = turn
    own[:3, 3] = centre[:3] + swung * np.array(motion.swing) - turn @ centre[:3]
    camera = world.camera
    swung = np.sin(2 * np.pi * time_s / camera.period_s)
    seen = np.eye(4)
    seen[:2, 3] = -swung * np.array(camera.pan)
    seen[0, 2] = swung * camera.slide * QUOTED
    if isinstance(thing, Ball):
        # Seen from aside a ball is still a ball, and moves like its centre.
        seen[0, 3] += seen[0, 2] * (own @ centre)[2]
        seen[0, 2] = 0.0
    return seen @ own


def _centre(thing: Card | Ball) -> Array:
    """Return an object's centre at time 0: S, T, D as quoted, 1."""
    if isinstance(thing, Ball):
        return np.array([thing.s, thing.t, thing.disparity, 1.0])
    s, t, scale = np.linalg.solve(thing.to_texture, [0.5, 0.5, 1.0])
    s, t = s / scale, t / scale
    return np.array([s, t, thing.disparity + thing.slope_s * s + thing.slope_t * t, 1.0])


def moved_card(card: Card, moved: Array) -> Card:
    """Return a card whose points went where a map (4, 4) of (S, T, D as quoted, 1) sends them."""
    plane = np.array([card.slope_s, card.slope_t, card.disparity])
    # From (S, T, 1) of the card's points to (S, T, D, 1) where they are.
    there = moved @ np.array([[1, 0, 0], [0, 1, 0], plane, [0, 0, 1]])
    back = np.linalg.inv(there[[0, 1, 3]])
    slope_s, slope_t, disparity = there[2] @ back
    return replace(
        card,
        to_texture=card.to_texture @ back,
        slope_s=slope_s,
        slope_t=slope_t,
        disparity=disparity,
    )


def _moved_ball(ball: Ball, moved: Array, time_s: float) -> Ball:
    """Return a ball whose centre went where a map sends it, turned as it is at a time."""
    s, t, disparity, _ = moved @ _centre(ball)
    about_s, about_t, about_d = ball.motion.turn_rad_s
    turn = about_s * time_s, about_t * time_s, about_d * time_s
    return replace(ball, s=s, t=t, disparity=disparity, turn=turn)

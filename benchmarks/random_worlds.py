"""Random worlds to train on: cards and balls of random textures, places, slopes and depths.

Built-in scenes are no random worlds: no evaluated scene is in the training data.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import Camera
from emmc_rig.simulators import textures
from emmc_rig.simulators.raycaster import Ball, Card, World, tabulated
from emmc_rig.simulators.scenes import rendered

SIDE = 256
"""Texels along a texture: enough for pictures of some 200 pixels."""
DEEPEST_PX = 0.2, 4.0
"""Range from which the largest disparity of a world is drawn, log-uniformly, as quoted."""

WORLD_SIZE = 128, 160
"""Rows and columns of a rendered world, with 5/8 of the quoted disparities."""
WORLDS_AT_HAND = 32
DARKEST = 0.3
"""Least factor on a world's light, drawn log-uniformly up to 1."""


def with_pattern(camera: Camera, mask: str, **changes: object) -> Camera:
    """Return a camera with changed, unchecked settings of the pattern of a mask."""
    changed = camera.masks[mask]
    pattern = changed.pattern.model_copy(update=changes)
    masks = {**camera.masks, mask: changed.model_copy(update={"pattern": pattern})}
    return camera.model_copy(update={"masks": masks})


@lru_cache(maxsize=2 * WORLDS_AT_HAND)
def world(seed: int, number: int, views: tuple[int, int]) -> NDArray[np.float32]:
    """Return the light field of a random world (v, u, y, x, c), of WORLD_SIZE pixels."""
    rng = np.random.default_rng([seed, 0, number])
    return rendered(tabulated(random_world(rng)), views, WORLD_SIZE).light_field


def random_world(rng: np.random.Generator) -> World:
    """Return a world: a tilted background, 4 to 14 cards and up to 3 balls."""
    deepest = float(np.exp(rng.uniform(*np.log(DEEPEST_PX))))
    back, front = sorted(rng.uniform(-deepest, deepest, 2))
    slope = rng.normal(0, 0.5 * deepest, 2)
    size = rng.uniform(0.4, 1.5, 2)
    whole = _placed(0, 0, size[0], size[1], rng.uniform(0, 360))
    cards = [Card(_texture(rng), back, whole, slope[0], slope[1], tiled=True)]
    for disparity in np.sort(rng.uniform(back, front, rng.integers(4, 15))):
        s, t = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4)
        size = np.exp(rng.uniform(np.log(0.06), np.log(0.6), 2))
        slope = rng.normal(0, 0.3 * deepest, 2)
        middle = disparity - slope[0] * s - slope[1] * t
        at = _placed(s, t, size[0], size[1], rng.uniform(0, 360))
        sheen = 0.3 * rng.random() if rng.random() < 0.1 else 0.0
        outlined = _outlined(_texture(rng), rng)
        cards.append(Card(outlined, middle, at, *slope, sheen=sheen, sheen_depth=deepest))
    balls = tuple(
        Ball(
            rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3), rng.uniform(back, front),
            rng.uniform(0.03, 0.12), 0.3 * deepest, _texture(rng),
            gloss=rng.choice([0.0, 0.1, 0.8], p=[0.6, 0.3, 0.1]),
        )
        for _ in range(rng.integers(0, 4))
    )  # fmt: skip
    room = textures.surroundings(rng, *_colours(rng, 3), side=SIDE)
    light = float(np.exp(rng.uniform(np.log(0.15), np.log(1.1))))
    return World(tuple(cards), balls, room, rng.uniform(0.4, 0.7), light)


def _placed(s: float, t: float, width: float, height: float, turn_deg: float) -> np.ndarray:
    """Return the homography from (S, T) to the texture of a card of this middle, size and turn."""
    turn = np.deg2rad(turn_deg)
    cos, sin = np.cos(turn), np.sin(turn)
    rotate = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    move = np.array([[1, 0, -s], [0, 1, -t], [0, 0, 1]])
    return np.array([[1 / width, 0, 0.5], [0, 1 / height, 0.5], [0, 0, 1]]) @ rotate @ move


def _colours(rng: np.random.Generator, count: int) -> list[str]:
    """Return random colours as in HTML, dull ones more often than vivid ones."""
    grey, tint = rng.uniform(0.05, 1, (count, 1)), rng.uniform(-1, 1, (count, 3))
    mixed = np.clip(grey + rng.beta(1, 2) * tint, 0.01, 1)
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in np.rint(255 * mixed).astype(int)]


def _texture(rng: np.random.Generator) -> np.ndarray:
    """Return an opaque texture: cloudy, striped or of patches, through two to four colours."""
    colours = _colours(rng, int(rng.integers(2, 5)))
    along = (1.0, 1.0) if rng.random() < 0.6 else tuple(rng.uniform(0.3, 6, 2))
    finest = np.exp(rng.uniform(np.log(6), np.log(120)))
    shade = textures.noise(rng, SIDE, 1, finest, rng.uniform(0.4, 1.6), along)
    kind = rng.random()
    if kind < 0.3:  # patches with sharp edges, some of them grained
        levels = rng.integers(2, 6)
        grain = rng.choice([0.0, 0.1]) * textures.noise(rng, SIDE, 8, 120, 0.5)
        shade = np.floor(levels * (0.5 + 0.2 * shade)) / levels + grain - 0.5
    elif kind < 0.45:  # stripes, bent by what was cloudy
        p, q = textures.grid(SIDE)
        cycles = rng.integers(2, 40, 2)
        shade = 2 * np.sin(2 * np.pi * (cycles[0] * p + cycles[1] * q) + 0.5 * shade)
    return textures.painted(np.clip(0.5 + 0.25 * shade, 0, 1), *colours)


def _outlined(texture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a texture cut to a rectangle, a disc or blots, at times half transparent."""
    p, q = textures.grid(SIDE)
    kind = rng.random()
    if kind < 0.4:
        alpha = textures.rectangle(SIDE)
    elif kind < 0.7:
        alpha = textures.step(0.48 - np.hypot(p - 0.5, q - 0.5), 0.0, 0.01)
    else:
        blots = textures.noise(rng, SIDE, 1, np.exp(rng.uniform(1, 3.5)), 1.0)
        alpha = textures.rectangle(SIDE) * textures.step(blots, rng.uniform(-0.5, 0.8), 0.1)
    if rng.random() < 0.1:
        alpha = alpha * rng.uniform(0.3, 0.8)
    return np.concatenate([texture[..., :3], alpha[..., np.newaxis]], axis=-1)

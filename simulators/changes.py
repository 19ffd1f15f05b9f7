"""What may become of a built-in scene's world: deeper, moved, overgrown, mirroring; pure functions.

Lengths are in widths of the rendered picture, disparities as `simulators.raycaster` quotes them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from emmc_rig.simulators import textures
from emmc_rig.simulators.moving import moved_card
from emmc_rig.simulators.raycaster import Card, World

LEAF_LAYERS = 4
LEAF_TEXTURE = 1024
LEAF_CYCLES = 60
"""Leaves and gaps along a width of the picture."""
MIRROR_DEPTH = 4.0
"""How far behind a surface what it mirrors appears, as quoted."""


def deepened(world: World, factor: float) -> World:
    """Return the world with all disparities multiplied by a factor above 0."""
    return replace(
        world,
        cards=tuple(
            replace(
                card,
                disparity=card.disparity * factor,
                slope_s=card.slope_s * factor,
                slope_t=card.slope_t * factor,
                sheen_depth=card.sheen_depth * factor,
            )
            for card in world.cards
        ),
        balls=tuple(
            replace(ball, disparity=ball.disparity * factor, depth=ball.depth * factor)
            for ball in world.balls
        ),
    )


def moved(world: World, s: float, t: float, background: bool = False) -> World:
    """Return the world with its things moved by s to the right and t downwards.

    background: whether what fills the picture (tiled cards) moves with them.
    """
    by = np.eye(4)
    by[:2, 3] = s, t
    cards = tuple(
        card if card.tiled and not background else moved_card(card, by) for card in world.cards
    )
    balls = tuple(replace(ball, s=ball.s + s, t=ball.t + t) for ball in world.balls)
    return replace(world, cards=cards, balls=balls)


def overgrown(world: World, share: float, nearest: float, rng: np.random.Generator) -> World:
    """Return the world behind leaves that hide a share of every view, 0 to below 1.

    nearest: disparity of the nearest thing; the leaves hang in layers up to one pixel nearer.
    Leaves of a smaller share lie within those of a larger one.
    """
    gap = (1 - share) ** (1 / LEAF_LAYERS)
    tones = ("#1e3a17", "#5d8a34", "#c9c46a")
    layers = []
    for layer in range(LEAF_LAYERS):
        depth = textures.noise(rng, LEAF_TEXTURE, LEAF_CYCLES / 4, LEAF_CYCLES, 0.5)
        shade = 0.5 + 0.25 * textures.noise(rng, LEAF_TEXTURE, 8, 200, 0.8)
        edge = np.quantile(depth, gap)
        alpha = textures.step(depth, float(edge), 0.1)
        leaf = textures.painted(np.clip(shade, 0, 1), *tones, alpha=alpha)
        # Its middle lies at the middle of the picture.
        placed = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
        disparity = nearest + 0.25 + 0.75 * layer / (LEAF_LAYERS - 1)
        layers.append(Card(leaf, disparity, placed, tiled=True))
    return world if share == 0 else replace(world, cards=(*world.cards, *layers))


def mirroring(world: World, share: float, rng: np.random.Generator) -> World:
    """Return the world whose surfaces mirror a share of a lively room, and are darker themselves.

    Flat surfaces mirror what is MIRROR_DEPTH behind them, balls what their shape shows.
    """
    if share == 0:
        return world
    room = textures.stone(rng, "#0c1a2a", "#7a5c3c", "#f4ecd8", veins=0.5)
    faded: dict[int, np.ndarray] = {}

    def own(texture: np.ndarray) -> np.ndarray:
        if id(texture) not in faded:
            faded[id(texture)] = texture * np.array([1 - share] * 3 + [1], texture.dtype)
        return faded[id(texture)]

    cards = tuple(
        replace(card, texture=own(card.texture), sheen=share, sheen_depth=MIRROR_DEPTH)
        for card in world.cards
    )
    balls = tuple(replace(ball, gloss=share) for ball in world.balls)
    return replace(world, cards=cards, balls=balls, surroundings=room)

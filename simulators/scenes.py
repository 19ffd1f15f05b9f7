"""Built-in procedural scenes: seeded light fields with known disparity, on any grid of views.

Those of `MOVING_SCENES` move: they are known at any time.

Coordinates and disparities are those of `simulators.raycaster`: `Scene.disparity_px` quotes
pixels per view step of 5 views of 256 columns. S runs from -1/2 to 1/2 across the picture, T
downwards, +-3/8 at 3:4.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from emmc_rig.model.errors import SceneError, did_you_mean
from emmc_rig.simulators import textures
from emmc_rig.simulators.moving import world_at
from emmc_rig.simulators.raycaster import (
    Ball,
    CameraMotion,
    Card,
    Motion,
    Tables,
    World,
    first_surfaces,
    paint_view,
    tabulated,
)

_SMALLEST_PX = 16


@dataclass(frozen=True)
class RenderedScene:
    """A light field (v, u, y, x, 3), and the tables of the world that it shows."""

    light_field: np.ndarray
    tables: Tables

    @cached_property
    def disparity_px(self) -> np.ndarray:
        """Disparity (y, x), in pixels per view step, of the centre view (V // 2, U // 2).

        It is that of the first surface seen: a reflecting or transparent ball counts as a surface,
        a card where it is at least half opaque.
        """
        views, size = self.light_field.shape[:2], self.light_field.shape[2:4]
        steps = max(views)
        a_t, a_s = ((n // 2 - (n - 1) / 2) / steps for n in views)
        d = first_surfaces(size, a_s, a_t, self.tables)
        return (d * (size[1] / steps)).astype(np.float32)


@dataclass(frozen=True)
class Scene:
    """A built-in scene: its purpose, range of disparities, and builder of a random world."""

    description: str
    disparity_px: tuple[float, float]
    build: Callable[[np.random.Generator], World]


def render(
    name: str,
    views: tuple[int, int] = (5, 5),
    size: tuple[int, int] = (192, 256),
    seed: int = 0,
    change: Callable[[World], World] | None = None,
    time_s: float = 0.0,
) -> RenderedScene:
    """Render a built-in scene.

    Args:
        name: a key of `SCENES`.
        views: rows and columns of views, 1 or more.
        size: rows and columns of pixels, 16 or more.
        seed: chooses the random textures and places; equal seeds give equal scenes on every grid.
        change: what becomes of the scene's world before it is rendered; see `simulators.changes`.
        time_s: when a scene that moves is seen, without motion blur.

    Returns:
        light_field (v, u, y, x, 3) float32 in [0, 1].

    Raises:
        SceneError: unknown name, a size or number of views too small, or a negative seed.
    """
    _check(name, views, size, seed)
    if change is None:
        return rendered(_tables(name, seed, time_s), views, size)
    return rendered(tabulated(world_at(change(_world(name, seed)), time_s)), views, size)


def rendered(tables: Tables, views: tuple[int, int], size: tuple[int, int]) -> RenderedScene:
    """Return all views of a world that `tabulated` laid out."""
    steps = max(views)
    apertures = [
        ((v - (views[0] - 1) / 2) / steps, (u - (views[1] - 1) / 2) / steps)
        for v, u in np.ndindex(*views)
    ]
    light_field = np.empty((views[0] * views[1], *size, 3), np.float32)

    def paint(i: int) -> None:
        a_t, a_s = apertures[i]
        paint_view(light_field[i], a_s, a_t, tables)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        list(pool.map(paint, range(len(apertures))))
    return RenderedScene(light_field.reshape(*views, *size, 3), tables)


def _check(name: str, views: tuple[int, int], size: tuple[int, int], seed: int) -> None:
    if name not in SCENES:
        hint = did_you_mean(name, SCENES, 0.4)
        raise SceneError(f"no built-in scene '{name}': {hint}built in are {', '.join(SCENES)}")
    if min(views) < 1:
        raise SceneError(f"{views[0]}x{views[1]} views: needs 1x1 or more")
    if min(size) < _SMALLEST_PX:
        raise SceneError(f"{size[0]}x{size[1]} pixels: needs {_SMALLEST_PX}x{_SMALLEST_PX} or more")
    if seed < 0:
        raise SceneError(f"seed {seed}: needs 0 or more")


@lru_cache(maxsize=2)
def _tables(name: str, seed: int, time_s: float) -> Tables:
    """Build a scene into tables; its textures take longer to make than a small view to render."""
    return tabulated(world_at(_world(name, seed), time_s))


@lru_cache(maxsize=2)
def _world(name: str, seed: int) -> World:
    return SCENES[name].build(np.random.default_rng([seed, *name.encode()]))


def _frame(s: float, t: float, width: float, height: float, turn_deg: float = 0.0) -> np.ndarray:
    """Homography from (S, T) to the texture of a card with this centre, size and turn."""
    turn = np.deg2rad(turn_deg)
    cos, sin = np.cos(turn), np.sin(turn)
    move = np.array([[1, 0, -s], [0, 1, -t], [0, 0, 1]])
    rotate = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    fit = np.array([[1 / width, 0, 0.5], [0, 1 / height, 0.5], [0, 0, 1]])
    return fit @ rotate @ move


def _ground(horizon_t: float, repeat: float) -> np.ndarray:
    """Homography from (S, T) to the texture of level ground that vanishes at `horizon_t`."""
    return np.array([[repeat, 0, 0], [0, 0, repeat * 0.5], [0, 1, -horizon_t]], dtype=float)


def _desk(rng: np.random.Generator) -> World:
    def lying(
        texture: np.ndarray,
        lift: float,
        frame: np.ndarray,
        slope_s: float = 0.12,
        slope_t: float = 0.42,
        tiled: bool = False,
    ) -> Card:
        return Card(texture, -0.1 + lift, frame, slope_s, slope_t, tiled)

    def paper(
        texture: np.ndarray,
        lift: float,
        at: tuple[float, float, float, float, float],
        slope_s: float = 0.12,
        slope_t: float = 0.42,
    ) -> list[Card]:
        s, t, width, height, turn_deg = at
        turn_deg += rng.uniform(-5, 5)
        below = _frame(s + 0.012, t + 0.014, width * 1.36, height * 1.36, turn_deg)
        return [
            lying(textures.soft_shadow(0.5), lift / 3, below, slope_s, slope_t),
            lying(texture, lift, _frame(s, t, width, height, turn_deg), slope_s, slope_t),
        ]

    def marble(s: float, t: float, radius: float, **more) -> Ball:
        floor = -0.1 + 0.12 * s + 0.42 * t
        return Ball(s, t, floor + 0.09, radius, 0.09, gloss=0.05, **more)

    wood = textures.wood(rng, "#4a2c17", "#8f5f35", "#c89a63")
    return World(
        cards=(
            lying(wood, 0.0, _frame(0, 0, 1, 1), tiled=True),
            *paper(textures.star_chart(), 0.04, (-0.27, -0.1, 0.36, 0.36, -8)),
            *paper(textures.printed_page(rng), 0.06, (0.26, 0.16, 0.34, 0.44, 12), slope_t=0.75),
            *paper(textures.postcard(rng), 0.12, (0.14, -0.19, 0.4, 0.27, -4), slope_s=0.5),
            lying(
                textures.leaf(rng, "#4c2a12", "#b5651d", "#e8b04a", "#f6dd92"),
                0.1,
                _frame(-0.21, 0.2, 0.4, 0.26, 24),
                slope_s=-0.35,
            ),
        ),
        balls=(
            marble(
                -0.43, 0.26, 0.045, texture=textures.stone(rng, "#12325c", "#3f7fc0", "#d9ecf7")
            ),
            marble(
                -0.02, 0.06, 0.036, texture=textures.segments(rng, "#c8362b", "#f0e4c8", "#2f6f9f")
            ),
            marble(0.44, -0.27, 0.04, texture=textures.stone(rng, "#1d4a2a", "#5fa05a", "#e6efc0")),
        ),
        surroundings=textures.surroundings(rng, "#3a2a1d", "#8b7a66", "#d8cfc0"),
        ambient=0.55,
    )


def _garden(rng: np.random.Generator) -> World:
    def leaves(count: int, length: float, tones: int, disparity: float, *at: float, **more) -> Card:
        greens = (
            ("#20401f", "#3f6b2e", "#7c9a45"),
            ("#2a5a26", "#5f9436", "#b7c95a"),
            ("#5a2a16", "#b0532a", "#e39b3c"),
        )[tones]
        return Card(textures.foliage(rng, count, length, *greens), disparity, _frame(*at), **more)

    side = 1024
    q = textures.grid(side)[1]
    hedge = textures.noise(rng, side, 2, 60, 1.0)
    sky = textures.painted(np.clip(q * 2.6 + 0.05 * hedge, 0, 1), "#6fa4d8", "#bcd8ec", "#f3e8cf")
    trees = textures.painted(np.clip(0.45 + 0.2 * hedge, 0, 1), "#1d331d", "#48703a", "#9db860")
    crowns = 0.34 + 0.06 * textures.noise(rng, side, 1, 24, 1.2)[side // 3][np.newaxis, :]
    backdrop = textures.mixed(sky, trees, textures.step(q - crowns, 0, 0.006))
    lawn = textures.stone(rng, "#2c4a1c", "#5d8a34", "#a9bd5b", side=1024)
    pillar = textures.bricks(rng, rows=18, columns=3, side=512)
    pillar[..., 3] = textures.rectangle(512)
    jitter = rng.uniform(-0.03, 0.03, 8)
    return World(
        cards=(
            Card(backdrop, -2.0, _frame(0, 0.1, 1.3, 1.3), tiled=True),
            Card(lawn, -2.6, _ground(-0.02, 0.5), slope_t=11.0, tiled=True),
            Card(pillar, -1.2, _frame(-0.3 + jitter[0], -0.06, 0.17, 0.55)),
            Card(pillar, -0.9, _frame(0.33 + jitter[1], -0.08, 0.15, 0.62), slope_s=2.0),
            leaves(150, 0.13, 0, -0.5, 0.06 + jitter[2], -0.21, 0.62, 0.42, 0, slope_s=1.2),
            leaves(80, 0.17, 1, 0.6, -0.36, -0.1 + jitter[3], 0.5, 0.5, 0, slope_t=-1.0),
            leaves(46, 0.2, 2, 1.3, 0.42, -0.2 + jitter[4], 0.5, 0.5, 0, slope_s=-1.0),
            Card(
                textures.foliage(rng, 90, 0.8, "#2f5a1f", "#6f9c33", "#c7cf6a", upright=True),
                2.0,
                _frame(0.0, 0.26, 1.25, 0.3),
            ),
        ),
        balls=(
            Ball(
                -0.06 + jitter[5], 0.12, 0.0, 0.105, 0.35,
                textures.segments(rng, "#d0342c", "#f4ead2", "#2d6fb0", "#f0b429"), gloss=0.03,
            ),
            Ball(
                0.23 + jitter[6], 0.21, 0.9, 0.075, 0.3,
                textures.stone(rng, "#5b2f14", "#b06a2f", "#e9b66f", veins=0.3), texture_scale=0.7,
            ),
            Ball(
                -0.33 + jitter[7], 0.2, 1.1, 0.06, 0.25,
                textures.stone(rng, "#6a6f75", "#b9bfc2", "#eef0ee", veins=0.4), texture_scale=0.6,
            ),
        ),
        surroundings=textures.surroundings(rng, "#31461f", "#8fae7a", "#cfe3f2", lamp=1.5),
        ambient=0.5,
    )  # fmt: skip


def _still_life(rng: np.random.Generator) -> World:
    jitter = rng.uniform(-0.02, 0.02, 6)
    wall = textures.stone(rng, "#5e6f78", "#93a3a6", "#c4cdc8", side=1024)
    plaque = textures.wood(rng, "#1a0d08", "#3c1d12", "#5e3320", planks=2, side=512)
    plaque[..., 3] = textures.rectangle(512)
    return World(
        cards=(
            Card(wall, -1.6, _frame(0, 0, 1, 1), tiled=True),
            Card(
                textures.gingham(rng, "#a8322d", 6), -2.1, _ground(-0.06, 0.3), slope_t=9.0,
                tiled=True, sheen=0.06, sheen_depth=1.5,
            ),
            Card(textures.postcard(rng), -1.45, _frame(-0.27 + jitter[0], -0.2, 0.32, 0.23)),
            Card(textures.star_chart(), -1.4, _frame(0.06 + jitter[1], -0.2, 0.25, 0.25)),
            Card(
                plaque, -0.9, _frame(0.36, -0.15, 0.24, 0.36), slope_s=1.5,
                sheen=0.25, sheen_depth=2.5,
            ),
            Card(textures.film("#1f8fb5", 0.42), 1.5, _frame(0.22 + jitter[2], 0.2, 0.25, 0.22, 7)),
        ),
        balls=(
            Ball(
                -0.02 + jitter[3], 0.08, 0.0, 0.135, 0.9, glass=True, gloss=0.04,
                tint=(0.93, 0.98, 0.95),
            ),
            Ball(
                -0.31 + jitter[4], 0.06, -0.2, 0.115, 0.9, gloss=0.85,
                texture=textures.stone(rng, "#777777", "#bbbbbb"),
            ),
            Ball(
                0.29, 0.06, -0.3, 0.1, 0.7, gloss=0.14,
                texture=textures.stone(rng, "#5a0d14", "#a8202a", "#d85a4a"),
            ),
            Ball(
                -0.2, 0.27 + jitter[5] / 2, 1.2, 0.055, 0.5, gloss=0.1,
                texture=textures.segments(rng, "#e8a92c", "#1f3f6f", "#efe6d2"),
            ),
        ),
        surroundings=textures.surroundings(rng, "#6b2a22", "#9c8b78", "#cfc6b6", "#efe9dc"),
    )  # fmt: skip


def _night_blossoms(rng: np.random.Generator) -> World:
    cards = [
        Card(
            textures.stone(rng, "#06100a", "#1c3420", "#4a5a34", side=1024),
            -0.6,
            _frame(0, 0, 1, 1),
            tiled=True,
        )
    ]
    greens = ("#10240f", "#2c4f22", "#6f8a3d")
    for disparity, count in ((-0.4, 130), (-0.15, 80), (0.1, 45)):
        at = _frame(rng.uniform(-0.1, 0.1), rng.uniform(-0.05, 0.1), 1.15, 0.85)
        foliage = textures.foliage(rng, count, 0.15, *greens)
        cards.append(Card(foliage, disparity, at, slope_s=rng.uniform(-0.2, 0.2)))
    palettes = (
        ("#ffe9f2", "#f29ac0", "#b03a78"),
        ("#fffdf5", "#f5efe0", "#c9b8a0"),
        ("#ffe6a0", "#f2a23c", "#b0481c"),
    )
    for i, disparity in enumerate(np.linspace(-0.3, 0.6, 11)):
        bloom = textures.blossom(rng, *palettes[i % 3], petals=5 + i % 2)
        size = rng.uniform(0.13, 0.19) * (1.15 + 0.5 * disparity)
        cell_s, cell_t = (i * 7 % 11) / 11 - 0.45, (i * 5 % 11) / 11 * 0.62 - 0.28
        s, t = cell_s + rng.uniform(-0.04, 0.04), cell_t + rng.uniform(-0.04, 0.04)
        at = _frame(s, t, size, size * rng.uniform(0.75, 1), rng.uniform(0, 90))
        tilt = rng.uniform(-0.8, 0.8, 2)
        middle = disparity - tilt[0] * s - tilt[1] * t
        cards.append(Card(bloom, middle, at, slope_s=tilt[0], slope_t=tilt[1]))
    fruit = textures.stone(rng, "#4a0a10", "#a01c22", "#d8483a")
    return World(
        cards=tuple(cards),
        balls=tuple(
            Ball(*place, 0.04, 0.08, fruit, gloss=0.1)
            for place in ((-0.33, 0.24, 0.4), (-0.27, 0.29, 0.45), (0.38, -0.02, 0.3))
        ),
        surroundings=textures.surroundings(rng, "#0c1410", "#26352c", "#4a5a6a", lamp=60.0),
        ambient=0.5,
        brightness=0.5,
    )


def _avenue(rng: np.random.Generator) -> World:
    side = 1024
    q = textures.grid(side)[1]
    clouds = np.clip(0.5 + 0.25 * textures.noise(rng, side, 1, 30, 1.4, along=(2, 1)), 0, 1)
    sky = textures.painted(
        0.6 * clouds + 0.4 * np.clip(q * 2.3, 0, 1), "#4f86c0", "#a8cbe6", "#fbf3e2"
    )
    paving = textures.bricks(rng, rows=10, columns=5)
    paving[..., :3] = 0.35 * paving[..., :3] + 0.6 * paving[..., 1:2] + 0.12
    trunk = textures.wood(rng, "#2e2219", "#6d5440", "#a58a6b", planks=1, side=512).transpose(
        1, 0, 2
    )
    trunk = np.ascontiguousarray(trunk)
    trunk[..., 3] = textures.rectangle(512, margin=0.06)
    cards = [
        Card(sky, -6.0, _frame(0, 0.1, 1.3, 1.3), tiled=True),
        Card(paving, -8.0, _ground(-0.06, 0.35), slope_t=40.0, tiled=True),
    ]
    # On the ground D = -8 + 40 T: a thing's size, place and height follow from its foot.
    for i, foot in enumerate((0.06, 0.09, 0.14, 0.22)):
        near = foot + 0.06
        for left_or_right in (-1, 1):
            s = left_or_right * near * rng.uniform(1.35, 1.6)
            height = 2.4 * near
            disparity = -8 + 40 * foot
            trunk_at = _frame(s, foot - height / 2, 0.3 * near, height)
            crown_at = _frame(s, foot - height, 2.4 * near, 2.2 * near)
            tones = (
                ("#24431d", "#4f7d31", "#a3b752") if i % 2 else ("#5b3213", "#b5702a", "#e8c05a")
            )
            crown = textures.foliage(rng, 130, 0.16, *tones, side=512)
            cards += [Card(trunk, disparity, trunk_at), Card(crown, disparity + 0.3, crown_at)]
    cards.append(Card(textures.lattice(rng, 7), 10.5, _frame(0.36, 0.25, 0.5, 0.5), slope_s=-5.0))
    return World(
        cards=tuple(cards),
        balls=(
            Ball(
                -0.05, 0.16, 1.6, 0.08, 1.2,
                textures.segments(rng, "#d0342c", "#f4ead2", "#2d6fb0", "#f0b429"), gloss=0.03,
            ),
            Ball(
                -0.3, 0.26, 6.0, 0.09, 1.6,
                textures.stone(rng, "#28323c", "#74828e", "#dfe6e8", veins=0.4), gloss=0.05,
            ),
        ),
        surroundings=textures.surroundings(rng, "#5a5248", "#b8b8b0", "#b4d2ea", lamp=1.5),
        ambient=0.55,
    )  # fmt: skip


def _toy_table(rng: np.random.Generator) -> World:
    jitter = rng.uniform(-0.01, 0.01, 6)
    wall = textures.stone(rng, "#3f6f86", "#6fa3b4", "#a8cbd0", finest=6)

    def block(letter: str, paint: str, disparity: float, *at: float, **more) -> Card:
        return Card(textures.letter_block(letter, paint), disparity, _frame(*at), **more)

    def ball(s: float, t: float, disparity: float, radius: float, *colours: str) -> Ball:
        return Ball(s, t, disparity, radius, 0.5, textures.segments(rng, *colours), gloss=0.04)

    return World(
        cards=(
            Card(wall, -2.0, _frame(0, 0, 1, 1), tiled=True),
            Card(
                textures.gingham(rng, "#c2413a", 3, weave=0.0), -2.4, _ground(-0.2, 0.3),
                slope_t=9.0, tiled=True,
            ),
            Card(textures.postcard(rng), -1.8, _frame(-0.25 + jitter[0], -0.2, 0.36, 0.27)),
            block("E", "#1f5fa8", -0.6, 0.06 + jitter[1], -0.06, 0.2, 0.2, 4),
            block("M", "#d88a1e", -0.5, 0.3 + jitter[2], -0.05, 0.21, 0.21, -5, slope_s=0.8),
            block("C", "#2f8a52", 0.1, 0.17 + jitter[3], 0.13, 0.23, 0.23, -8),
        ),
        balls=(
            ball(-0.24 + jitter[4], 0.06, 0.0, 0.13, "#d0342c", "#f4ead2", "#2d6fb0", "#f0b429"),
            ball(-0.08, 0.23, 1.5, 0.075, "#2d8a6a", "#f4ead2", "#7a3fa0"),
            ball(0.4, 0.24 + jitter[5], 1.8, 0.085, "#f0b429", "#d0342c", "#f4ead2"),
        ),
        surroundings=textures.surroundings(rng, "#5a4a3a", "#a89a86", "#dcd6ca"),
        ambient=0.55,
    )  # fmt: skip


def _moving_toys(rng: np.random.Generator) -> World:
    """The toy table whose blocks turn and whose balls roll, before and behind each other."""
    still = _toy_table(rng)
    blocks = (
        Motion((0.10, 0.02, 0.2), 5.0, (0, 0, 0.35)),
        Motion((-0.12, 0.0, 0.3), 6.0, (0, 0, -0.25)),
        Motion((-0.08, -0.05, 0.2), 4.0, (0, 0, 0.2)),
    )
    balls = (
        Motion((0.13, 0.03, 0.5), 6.0, (0, 0.8, 0)),
        Motion((0.16, 0.02, 0.0), 7.0, (0, 0, 0.9)),
        Motion((-0.12, -0.06, -0.3), 4.5, (0.5, -0.5, 0.3)),
    )
    count = len(still.cards) - len(blocks)
    moving = (
        replace(card, motion=motion)
        for card, motion in zip(still.cards[count:], blocks, strict=True)
    )
    return replace(
        still,
        cards=(*still.cards[:count], *moving),
        balls=tuple(
            replace(ball, motion=motion) for ball, motion in zip(still.balls, balls, strict=True)
        ),
    )


def _panning_desk(rng: np.random.Generator) -> World:
    return replace(_desk(rng), camera=CameraMotion((0.15, 0.05), slide=1.5, period_s=8.0))


STILL_SCENES: dict[str, Scene] = {
    "near-planar": Scene("papers, a leaf and marbles on a tilted desk", (-0.3, 0.3), _desk),
    "deep-occlusions": Scene("a garden behind leaves and grass", (-2.0, 2.0), _garden),
    "non-lambertian": Scene("glass, mirror, gloss and clear film", (-1.6, 1.6), _still_life),
    "dark": Scene("blossoms at night, a few saturated glints", (-0.6, 0.6), _night_blossoms),
    "wide-disparity": Scene("an avenue seen through a fence", (-6.0, 10.0), _avenue),
    "toy-table": Scene("letter blocks and balls on a checked cloth", (-2.0, 2.0), _toy_table),
}
MOVING_SCENES: dict[str, Scene] = {
    "moving-toys": Scene("blocks that turn and balls that roll", (-2.0, 2.0), _moving_toys),
    "panning-desk": Scene("the desk before a camera that pans", (-0.4, 0.4), _panning_desk),
}
SCENES = STILL_SCENES | MOVING_SCENES

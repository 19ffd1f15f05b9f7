"""Built-in procedural scenes: seeded light fields with known disparity, on any grid of views.

Coordinates. A pixel's centre has X = (x + 1/2) / W - 1/2 and Y = (y + 1/2 - H/2) / W: the unit is
the picture's width. The views fill a fixed aperture: view j of n has the aperture coordinate
a = (j - (n - 1) / 2) / n, in (-1/2, 1/2); of unequal row and column counts, n is the larger, so
that a step is as long in u as in v. A scene point (S, T, D) is seen in view a at
X = S + D a_u, Y = T + D a_v: a ray is a straight line in (S, T, D), and nearer points have the
larger D. In pixels per view step the disparity of that point is D W / n.

Scenes are described, and `Scene.disparity_px` quotes, disparities in pixels per view step of
5 views of 256 columns: D = disparity x 5 / 256. Hence n views of width W see
disparity x (5 / n) x (W / 256), and 10 views at twice the size are the same scene sampled finer.

Rays are traced one per view through 2x2 points of every pixel (a pinhole in the middle of each
aperture cell), meet textured cards and balls, and may be reflected or refracted once per ball.
Ball normals are those of a sphere in a space in which D is stretched until the ball is round.
Left out: shadows of cards, objects mirrored in others (mirrors show only the surroundings), light
that bounces between surfaces.
"""

import difflib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numba
import numpy as np
import scipy.fft

from emmc_rig.model.errors import SceneError

_QUOTED_VIEWS, _QUOTED_WIDTH_PX = 5, 256
_START_D = 1.0
"""Rays start nearer than any object."""
_MAX_SURFACES = 24
"""Surfaces one ray may pass before it is given up."""
_SUPERSAMPLES = 2
_SMALLEST_PX = 16
_MISSED = -1


@dataclass(frozen=True)
class RenderedScene:
    """A light field (v, u, y, x, 3) and what is known of it.

    `disparity_px` (y, x), in pixels per view step, is of the first surface seen in the centre
    view (V // 2, U // 2): a reflecting or transparent ball counts as a surface, a card where it
    is at least half opaque.
    """

    light_field: np.ndarray
    disparity_px: np.ndarray


@dataclass(frozen=True)
class Card:
    """A textured plane: D = disparity + slope_s S + slope_t T, disparities as quoted.

    Its texture coordinates are the homography `to_texture` of (S, T); a card that is not `tiled`
    ends where they leave [0, 1). `sheen` adds that much of the surroundings, mirrored as if they
    were `sheen_depth` behind the card.
    """

    texture: np.ndarray
    disparity: float
    to_texture: np.ndarray
    slope_s: float = 0.0
    slope_t: float = 0.0
    tiled: bool = False
    sheen: float = 0.0
    sheen_depth: float = 0.0


@dataclass(frozen=True)
class Ball:
    """A sphere of radius `radius` (in widths) that spans disparity +- `depth`, as quoted.

    `gloss` is the mirror reflectance head on (it rises to 1 at the limb where it is not 0);
    `glass` balls show no texture but what they refract (index 1.5), tinted by `tint`.
    """

    s: float
    t: float
    disparity: float
    radius: float
    depth: float
    texture: np.ndarray | None = None
    texture_scale: float = 0.5
    gloss: float = 0.0
    glass: bool = False
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class World:
    """All objects of a scene, its surroundings (an equal-area map of directions), its light."""

    cards: tuple[Card, ...]
    balls: tuple[Ball, ...]
    surroundings: np.ndarray
    ambient: float = 0.45
    brightness: float = 1.0


@dataclass(frozen=True)
class Scene:
    """A built-in scene: what it is for, its disparities, and how a random generator builds it."""

    description: str
    disparity_px: tuple[float, float]
    build: Callable[[np.random.Generator], World]


def render(
    name: str,
    views: tuple[int, int] = (5, 5),
    size: tuple[int, int] = (192, 256),
    seed: int = 0,
) -> RenderedScene:
    """Render a built-in scene.

    Args:
        name: a key of `SCENES`.
        views: rows and columns of views, 1 or more.
        size: rows and columns of pixels, 16 or more.
        seed: chooses the random textures and places; equal seeds give equal scenes on every grid.

    Returns:
        light_field (v, u, y, x, 3) float32 in [0, 1]; disparity_px (y, x) float32.

    Raises:
        SceneError: unknown name, a size or number of views too small, or a negative seed.
    """
    if name not in SCENES:
        near = difflib.get_close_matches(name, SCENES, n=1, cutoff=0.4)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise SceneError(f"no built-in scene '{name}': {hint}built in are {', '.join(SCENES)}")
    if min(views) < 1:
        raise SceneError(f"{views[0]}x{views[1]} views: needs 1x1 or more")
    if min(size) < _SMALLEST_PX:
        raise SceneError(f"{size[0]}x{size[1]} pixels: needs {_SMALLEST_PX}x{_SMALLEST_PX} or more")
    if seed < 0:
        raise SceneError(f"seed {seed}: needs 0 or more")
    scene = _prepared(name, seed)
    steps = max(views)
    apertures = [
        ((v - (views[0] - 1) / 2) / steps, (u - (views[1] - 1) / 2) / steps)
        for v, u in np.ndindex(*views)
    ]
    light_field = np.empty((views[0] * views[1], *size, 3), np.float32)

    def paint(i: int) -> None:
        a_t, a_s = apertures[i]
        windows = _windows(scene.cards, scene.balls, scene.corners, a_s, a_t)
        _paint_view(light_field[i], a_s, a_t, *windows, *scene.arrays)

    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        list(pool.map(paint, range(len(apertures))))
    disparity = np.empty(size, np.float32)
    a_t, a_s = apertures[views[0] // 2 * views[1] + views[1] // 2]
    windows = _windows(scene.cards, scene.balls, scene.corners, a_s, a_t)
    _measure_disparity(disparity, a_s, a_t, *windows, *scene.arrays)
    disparity *= size[1] / steps
    return RenderedScene(light_field.reshape(*views, *size, 3), disparity)


# Tables the compiled kernels read. Disparities are in widths per aperture here.

_CARD = np.dtype(
    [(f"h{i}{j}", np.float64) for i in range(3) for j in range(3)]
    + [(field, np.float64) for field in ("d", "slope_s", "slope_t", "sheen", "sheen_depth")]
    + [(field, np.int64) for field in ("offset", "side", "tiled")]
)
_BALL = np.dtype(
    [(field, np.float64) for field in ("s", "t", "d", "radius", "depth", "scale", "gloss")]
    + [(field, np.float64) for field in ("tint_r", "tint_g", "tint_b")]
    + [(field, np.int64) for field in ("offset", "side", "glass")]
)
_LIGHT = np.array([-0.45, -0.65, 0.61]) / np.linalg.norm([-0.45, -0.65, 0.61])
"""Towards the lamp: from the left, from above (T grows downwards), from the front."""


@dataclass(frozen=True)
class _Prepared:
    cards: np.ndarray
    balls: np.ndarray
    corners: np.ndarray
    texels: np.ndarray
    surroundings: tuple[int, int]
    lighting: np.ndarray

    @property
    def arrays(self) -> tuple:
        return self.cards, self.balls, self.texels, *self.surroundings, self.lighting


@lru_cache(maxsize=2)
def _prepared(name: str, seed: int) -> _Prepared:
    """Build a scene into tables; its textures take longer to make than a small view to render."""
    world = SCENES[name].build(np.random.default_rng([seed, *name.encode()]))
    quoted = _QUOTED_VIEWS / _QUOTED_WIDTH_PX
    pool: dict[int, tuple[int, int]] = {}
    texels: list[np.ndarray] = []

    def placed(texture: np.ndarray) -> tuple[int, int]:
        if id(texture) not in pool:
            pool[id(texture)] = sum(t.size for t in texels), texture.shape[0]
            texels.append(texture.astype(np.float32).ravel())
        return pool[id(texture)]

    cards = np.zeros(len(world.cards), _CARD)
    corners = np.empty((len(world.cards), 4, 2))
    for row, corner, card in zip(cards, corners, world.cards, strict=True):
        row["d"] = card.disparity * quoted
        row["slope_s"], row["slope_t"] = card.slope_s * quoted, card.slope_t * quoted
        for i, j in np.ndindex(3, 3):
            row[f"h{i}{j}"] = card.to_texture[i, j]
        row["offset"], row["side"] = placed(card.texture)
        row["tiled"] = card.tiled
        row["sheen"], row["sheen_depth"] = card.sheen, card.sheen_depth * quoted
        ends = np.linalg.inv(card.to_texture) @ np.array([[0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1]])
        corner[:] = np.inf if card.tiled else (ends[:2] / ends[2]).T
    balls = np.zeros(len(world.balls), _BALL)
    for row, ball in zip(balls, world.balls, strict=True):
        row["s"], row["t"], row["d"] = ball.s, ball.t, ball.disparity * quoted
        row["radius"], row["depth"] = ball.radius, ball.depth * quoted
        row["scale"], row["gloss"], row["glass"] = ball.texture_scale, ball.gloss, ball.glass
        row["tint_r"], row["tint_g"], row["tint_b"] = ball.tint
        if ball.texture is not None:
            row["offset"], row["side"] = placed(ball.texture)
    surroundings = placed(world.surroundings)
    lighting = np.array([*_LIGHT, world.ambient, world.brightness])
    return _Prepared(cards, balls, corners, np.concatenate(texels), surroundings, lighting)


def _windows(
    cards: np.ndarray, balls: np.ndarray, corners: np.ndarray, a_s: float, a_t: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where in this view each object can be: rows of smallest and largest X, then Y."""
    everywhere = np.array([-np.inf, np.inf, -np.inf, np.inf])
    of_cards = np.tile(everywhere, (len(cards), 1))
    ends = np.isfinite(corners[:, 0, 0])
    s, t = corners[ends, :, 0], corners[ends, :, 1]
    bounded = cards[ends]
    d = (
        bounded["d"][:, np.newaxis]
        + bounded["slope_s"][:, np.newaxis] * s
        + bounded["slope_t"][:, np.newaxis] * t
    )
    x, y = s + d * a_s, t + d * a_t
    of_cards[ends] = np.stack([x.min(1), x.max(1), y.min(1), y.max(1)], axis=1)
    of_balls = np.empty((len(balls), 4))
    for axis, a, centre in ((0, a_s, balls["s"]), (1, a_t, balls["t"])):
        middle = centre + balls["d"] * a
        reach = np.hypot(balls["radius"], balls["depth"] * a)
        of_balls[:, 2 * axis], of_balls[:, 2 * axis + 1] = middle - reach, middle + reach
    return of_cards, of_balls


_compiled = numba.njit(
    nogil=True,
    cache=True,
    error_model="numpy",
    forceinline=True,
    fastmath={"contract", "arcp", "nsz", "reassoc"},
)


@_compiled
def _texel(texels, offset, side, p, q, tiled):
    """Bilinear RGBA at texture coordinates (p, q); `side` is a power of two."""
    x, y = p * side - 0.5, q * side - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    f, g = x - x0, y - y0
    if tiled:
        x1, y1 = (x0 + 1) & (side - 1), (y0 + 1) & (side - 1)
        x0, y0 = x0 & (side - 1), y0 & (side - 1)
    else:
        x1, y1 = min(max(x0 + 1, 0), side - 1), min(max(y0 + 1, 0), side - 1)
        x0, y0 = min(max(x0, 0), side - 1), min(max(y0, 0), side - 1)
    i00, i01 = offset + 4 * (y0 * side + x0), offset + 4 * (y0 * side + x1)
    i10, i11 = offset + 4 * (y1 * side + x0), offset + 4 * (y1 * side + x1)
    w00, w01, w10, w11 = (1 - f) * (1 - g), f * (1 - g), (1 - f) * g, f * g
    r = w00 * texels[i00] + w01 * texels[i01] + w10 * texels[i10] + w11 * texels[i11]
    i00, i01, i10, i11 = i00 + 1, i01 + 1, i10 + 1, i11 + 1
    green = w00 * texels[i00] + w01 * texels[i01] + w10 * texels[i10] + w11 * texels[i11]
    i00, i01, i10, i11 = i00 + 1, i01 + 1, i10 + 1, i11 + 1
    b = w00 * texels[i00] + w01 * texels[i01] + w10 * texels[i10] + w11 * texels[i11]
    i00, i01, i10, i11 = i00 + 1, i01 + 1, i10 + 1, i11 + 1
    alpha = w00 * texels[i00] + w01 * texels[i01] + w10 * texels[i10] + w11 * texels[i11]
    return r, green, b, alpha


@_compiled
def _around(texels, offset, side, x, y, z):
    """The surroundings in a direction: Lambert's equal-area map, its middle towards the viewer."""
    k = 0.5 / np.sqrt(max(2 * (1 + z), 1e-9))
    return _texel(texels, offset, side, 0.5 + k * x, 0.5 + k * y, False)


@_compiled
def _on_card(card, s, t):
    """Texture coordinates of a point of a card."""
    w = 1 / (card.h20 * s + card.h21 * t + card.h22)
    p = (card.h00 * s + card.h01 * t + card.h02) * w
    q = (card.h10 * s + card.h11 * t + card.h12) * w
    return p, q


@_compiled
def _nearest(s, t, d, ds, dt, dd, start, straight, card_windows, ball_windows, cards, balls):
    """First surface along the ray after `start`: distance, and card, or number of cards + ball.

    A `straight` ray has not been bent yet: the windows of its view rule most objects out.
    """
    best, found = 1e9, _MISSED
    for i in range(cards.size):
        if straight and (
            s < card_windows[i, 0]
            or s > card_windows[i, 1]
            or t < card_windows[i, 2]
            or t > card_windows[i, 3]
        ):
            continue
        card = cards[i]
        k = (card.d + card.slope_s * s + card.slope_t * t - d) / (
            dd - card.slope_s * ds - card.slope_t * dt
        )
        if k <= start or k >= best:
            continue
        if not card.tiled:
            p, q = _on_card(card, s + k * ds, t + k * dt)
            if p < 0 or p >= 1 or q < 0 or q >= 1:
                continue
        best, found = k, i
    for i in range(balls.size):
        if straight and (
            s < ball_windows[i, 0]
            or s > ball_windows[i, 1]
            or t < ball_windows[i, 2]
            or t > ball_windows[i, 3]
        ):
            continue
        ball = balls[i]
        ox, oy, oz = (
            (s - ball.s) / ball.radius,
            (t - ball.t) / ball.radius,
            (d - ball.d) / ball.depth,
        )
        dx, dy, dz = ds / ball.radius, dt / ball.radius, dd / ball.depth
        a = dx * dx + dy * dy + dz * dz
        b = ox * dx + oy * dy + oz * dz
        within = b * b - a * (ox * ox + oy * oy + oz * oz - 1)
        if within <= 0:
            continue
        k = (-b - np.sqrt(within)) / a
        if k > start and k < best:
            best, found = k, cards.size + i
    return best, found


@_compiled
def _shadow(s, t, d, balls, lighting):
    """Light that the balls leave at a point of a card, 0 to 1, with a soft edge."""
    light = 1.0
    for i in range(balls.size):
        ball = balls[i]
        x, y, z = (s - ball.s) / ball.radius, (t - ball.t) / ball.radius, (d - ball.d) / ball.depth
        along = -(x * lighting[0] + y * lighting[1] + z * lighting[2])
        if along <= 0:
            continue
        away = np.sqrt(max(x * x + y * y + z * z - along * along, 0.0))
        soft = 0.15 + 0.12 * along
        edge = (away - 1 + soft) / (2 * soft)
        if edge < 1:
            edge = max(edge, 0.0)
            dark = 0.35 if ball.glass else 0.85
            light *= 1 - dark * (1 - edge * edge * (3 - 2 * edge))
    return light


@_compiled
def _paint_view(
    view, a_s, a_t, card_windows, ball_windows,
    cards, balls, texels, around, around_side, lighting,
):  # fmt: skip
    """Fill one view (y, x, 3): the mean over the pixel's sub-samples, each limited to [0, 1].

    One function for all rays, not one per ray: numba counts references at every call.
    """
    height, width = view.shape[:2]
    n = _SUPERSAMPLES
    ambient, brightness = lighting[3], lighting[4]
    view[:] = 0
    for sample in range(height * n * width * n):
        sub_row, sub_column = sample // (width * n), sample % (width * n)
        x = (sub_column + 0.5) / (n * width) - 0.5
        y = ((sub_row + 0.5) / n - height / 2) / width
        # A straight ray is kept as its trace in the plane D = 0, which the windows refer to.
        s, t, d, ds, dt, dd = x, y, 0.0, a_s, a_t, -1.0
        start, straight, passes = -_START_D, True, 1.0
        r, g, b = 0.0, 0.0, 0.0
        tint_r, tint_g, tint_b = 1.0, 1.0, 1.0
        for _ in range(_MAX_SURFACES):
            k, found = _nearest(
                s, t, d, ds, dt, dd, start, straight, card_windows, ball_windows, cards, balls
            )
            if found == _MISSED:
                length = np.sqrt(ds * ds + dt * dt + dd * dd)
                er, eg, eb, _ = _texel(
                    texels,
                    around,
                    around_side,
                    0.5 + 0.3 * ds / length,
                    0.5 + 0.3 * dt / length,
                    False,
                )
                r += passes * tint_r * er
                g += passes * tint_g * eg
                b += passes * tint_b * eb
                break
            hs, ht, hd = s + k * ds, t + k * dt, d + k * dd
            if found < cards.size:
                card = cards[found]
                p, q = _on_card(card, hs, ht)
                cr, cg, cb, alpha = _texel(texels, card.offset, card.side, p, q, card.tiled)
                if alpha > 0:
                    lit = ambient + (1 - ambient) * _shadow(hs, ht, hd, balls, lighting)
                    cr, cg, cb = cr * lit, cg * lit, cb * lit
                    if card.sheen > 0:
                        back = card.sheen_depth / dd
                        er, eg, eb, _ = _texel(
                            texels, around, around_side,
                            0.5 + 0.55 * (hs - back * ds), 0.5 + 0.55 * (ht - back * dt), False,
                        )  # fmt: skip
                        cr, cg, cb = (
                            cr + card.sheen * er,
                            cg + card.sheen * eg,
                            cb + card.sheen * eb,
                        )
                    r += passes * alpha * tint_r * cr
                    g += passes * alpha * tint_g * cg
                    b += passes * alpha * tint_b * cb
                    passes *= 1 - alpha
                if passes < 0.004:
                    break
                start = k + 1e-9
                continue
            ball = balls[found - cards.size]
            nx, ny, nz = (
                (hs - ball.s) / ball.radius,
                (ht - ball.t) / ball.radius,
                (hd - ball.d) / ball.depth,
            )
            vx, vy, vz = ds / ball.radius, dt / ball.radius, dd / ball.depth
            length = np.sqrt(vx * vx + vy * vy + vz * vz)
            vx, vy, vz = vx / length, vy / length, vz / length
            facing = -(vx * nx + vy * ny + vz * nz)
            mirrored = 0.0
            if ball.gloss > 0:
                mirrored = ball.gloss + (1 - ball.gloss) * (1 - facing) ** 5
                er, eg, eb, _ = _around(
                    texels, around, around_side,
                    vx + 2 * facing * nx, vy + 2 * facing * ny, vz + 2 * facing * nz,
                )  # fmt: skip
                r += passes * mirrored * tint_r * er
                g += passes * mirrored * tint_g * eg
                b += passes * mirrored * tint_b * eb
            passes *= 1 - mirrored
            if not ball.glass:
                stretch = ball.scale / (1 + max(nz, 0.0))
                cr, cg, cb, _ = _texel(
                    texels, ball.offset, ball.side, 0.5 + stretch * nx, 0.5 + stretch * ny, True
                )
                lamp = nx * lighting[0] + ny * lighting[1] + nz * lighting[2]
                lit = ambient * (0.75 - 0.25 * ny) + (1 - ambient) * 1.15 * max(lamp, 0.0)
                r += passes * tint_r * cr * lit
                g += passes * tint_g * cg * lit
                b += passes * tint_b * cb * lit
                break
            tint_r, tint_g, tint_b = (
                tint_r * ball.tint_r,
                tint_g * ball.tint_g,
                tint_b * ball.tint_b,
            )
            # Snell's law in and out of a sphere; it cannot be reflected totally inside.
            eta = 1 / 1.5
            push = eta * facing - np.sqrt(1 - eta * eta * (1 - facing * facing))
            vx, vy, vz = eta * vx + push * nx, eta * vy + push * ny, eta * vz + push * nz
            chord = -2 * (vx * nx + vy * ny + vz * nz)
            nx, ny, nz = nx + chord * vx, ny + chord * vy, nz + chord * vz
            leaving = vx * nx + vy * ny + vz * nz
            push = np.sqrt(max(1 - 2.25 * (1 - leaving * leaving), 0.0)) - 1.5 * leaving
            vx, vy, vz = 1.5 * vx + push * nx, 1.5 * vy + push * ny, 1.5 * vz + push * nz
            s, t, d = ball.s + ball.radius * nx, ball.t + ball.radius * ny, ball.d + ball.depth * nz
            ds, dt, dd = ball.radius * vx, ball.radius * vy, ball.depth * vz
            start, straight = 1e-6, False
        row, column = sub_row // n, sub_column // n
        view[row, column, 0] += min(max(r * brightness, 0.0), 1.0) / (n * n)
        view[row, column, 1] += min(max(g * brightness, 0.0), 1.0) / (n * n)
        view[row, column, 2] += min(max(b * brightness, 0.0), 1.0) / (n * n)


@_compiled
def _measure_disparity(
    disparity, a_s, a_t, card_windows, ball_windows,
    cards, balls, texels, around, around_side, lighting,
):  # fmt: skip
    """Fill D (y, x) of the first surface that is at least half opaque; 0 where there is none."""
    height, width = disparity.shape
    for row in range(height):
        for column in range(width):
            x = (column + 0.5) / width - 0.5
            y = (row + 0.5 - height / 2) / width
            start = -_START_D
            disparity[row, column] = 0.0
            for _ in range(_MAX_SURFACES):
                k, found = _nearest(
                    x, y, 0.0, a_s, a_t, -1.0, start, True, card_windows, ball_windows, cards, balls
                )
                if found == _MISSED:
                    break
                if found < cards.size:
                    card = cards[found]
                    p, q = _on_card(card, x + k * a_s, y + k * a_t)
                    alpha = _texel(texels, card.offset, card.side, p, q, card.tiled)[3]
                    if alpha < 0.5:
                        start = k + 1e-9
                        continue
                disparity[row, column] = -k
                break


# Textures: (side, side, 4) RGBA in [0, 1], side a power of two; tiled ones join at their edges.


def _grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates p (along columns) and q (along rows) of every texel."""
    q, p = (np.indices((side, side), dtype=np.float32) + 0.5) / side
    return p, q


def _noise(
    rng: np.random.Generator,
    side: int,
    lowest: float = 2,
    highest: float = 90,
    slope: float = 1.0,
    along: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Periodic noise with amplitude frequency^-slope: mean 0, deviation 1, `along` (p, q) longer.

    Frequencies are cycles per side of the texture.
    """
    fq = np.fft.fftfreq(side, 1 / side)[:, np.newaxis] * along[1]
    fp = np.fft.rfftfreq(side, 1 / side)[np.newaxis, :] * along[0]
    f = np.hypot(fp, fq).astype(np.float32)
    amplitude = np.where(f >= lowest, np.maximum(f, 1) ** -slope, 0) * np.exp(-((f / highest) ** 2))
    phases = rng.standard_normal((*f.shape, 2), dtype=np.float32).view(np.complex64)[..., 0]
    noise = np.asarray(scipy.fft.irfft2(amplitude * phases, s=(side, side), workers=-1))
    return (noise / noise.std()).astype(np.float32)


def _painted(shade: np.ndarray, *colours: str, alpha: np.ndarray | None = None) -> np.ndarray:
    """RGBA from a shade in [0, 1] through evenly spaced colours, written as in HTML."""
    stops = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in colours])
    places = np.linspace(0, 1, len(colours))
    channels = [np.interp(shade, places, stops[:, k]).astype(np.float32) for k in range(3)]
    opaque = np.ones_like(channels[0]) if alpha is None else alpha.astype(np.float32)
    return np.stack([*channels, opaque], axis=-1)


def _mixed(below: np.ndarray, above: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return below + (above - below) * amount[..., np.newaxis]


def _step(x: np.ndarray, edge: float, softness: float) -> np.ndarray:
    """0 below the edge, 1 above, smooth over `softness` on either side."""
    k = np.clip((x - edge) / (2 * softness) + 0.5, 0, 1)
    return k * k * (3 - 2 * k)


def _rectangle(side: int, margin: float = 0.02) -> np.ndarray:
    """Alpha that fades at the edges of a card, so that they are smooth in every view."""
    p, q = _grid(side)
    inside = np.minimum(np.minimum(p, 1 - p), np.minimum(q, 1 - q))
    return _step(inside, margin / 2, margin / 3)


def _wood(rng: np.random.Generator, *colours: str, planks: int = 5, side: int = 1024) -> np.ndarray:
    q = _grid(side)[1]
    row = np.floor(q * planks).astype(int)
    tone, offset = rng.normal(0, 0.09, planks)[row], rng.uniform(0, 1, planks)[row]
    bends = _noise(rng, side, 1, 12, 1.5, along=(4, 1))
    rings = np.sin(2 * np.pi * (9 * (q * planks % 1) + 5 * offset + 0.55 * bends))
    fibres = _noise(rng, side, 8, 150, 0.4, along=(14, 1))
    shade = 0.55 + tone + 0.14 * rings + 0.09 * fibres + 0.05 * bends
    seam = np.abs((q * planks) % 1 - 0.5)
    return _painted(np.clip(shade - 0.6 * _step(seam, 0.485, 0.01), 0, 1), *colours)


def _bricks(rng: np.random.Generator, rows: int, columns: int, side: int = 1024) -> np.ndarray:
    p, q = _grid(side)
    row = np.floor(q * rows).astype(int)
    across = p * columns + 0.5 * (row % 2)
    column = np.floor(across).astype(int) % columns
    tone = rng.normal(0, 0.16, (rows, columns))[row, column]
    grain = _noise(rng, side, 3, 100, 0.7)
    brick = _painted(np.clip(0.5 + tone + 0.12 * grain, 0, 1), "#5a2c22", "#a5583f", "#d29a78")
    mortar = _painted(np.clip(0.5 + 0.2 * grain, 0, 1), "#8d8578", "#cfc8b8")
    wobble = 0.02 * _noise(rng, side, 8, 60, 0.6)
    edge = np.minimum(0.5 - np.abs(q * rows % 1 - 0.5), 2 * (0.5 - np.abs(across % 1 - 0.5)))
    return _mixed(mortar, brick, _step(edge + wobble, 0.09, 0.03))


def _gingham(rng: np.random.Generator, colour: str, squares: int, side: int = 1024) -> np.ndarray:
    p, q = _grid(side)
    warp, weft = np.sin(np.pi * squares * p * 2) > 0, np.sin(np.pi * squares * q * 2) > 0
    weave = 0.06 * np.sin(2 * np.pi * 96 * p) * np.sin(2 * np.pi * 96 * q)
    shade = 0.5 * warp + 0.42 * weft + weave + 0.04 * _noise(rng, side, 2, 60)
    soft = cv2.GaussianBlur(shade.astype(np.float32), (0, 0), side / 700)
    return _painted(np.clip(soft, 0, 1), "#f4f0e6", colour)


def _stone(rng: np.random.Generator, *colours: str, veins: float = 0.0, side: int = 512):
    cloud = _noise(rng, side, 1, 110, 1.0)
    vein = np.exp(-((_noise(rng, side, 2, 30, 1.3) / 0.06) ** 2))
    return _painted(np.clip(0.5 + 0.2 * cloud - veins * vein, 0, 1), *colours)


def _segments(rng: np.random.Generator, *colours: str, side: int = 512) -> np.ndarray:
    """A beach ball: sectors about the middle, a cap, some scuffs."""
    p, q = _grid(side)
    angle = (np.arctan2(q - 0.46, p - 0.53) / (2 * np.pi) + rng.uniform()) % 1
    sector = angle * len(colours)
    shade = (np.floor(sector) % len(colours)) / (len(colours) - 1)
    paint = _painted(shade, *colours)
    cap = _painted(np.ones_like(p), "#000000", "#f6f2e8")
    paint = _mixed(paint, cap, _step(-np.hypot(p - 0.53, q - 0.46), -0.07, 0.006))
    scuffs = 1 - 0.05 * np.abs(_noise(rng, side, 6, 90, 0.5))
    paint = cv2.GaussianBlur(paint, (0, 0), 1.0)
    paint[..., :3] *= np.clip(scuffs, 0, 1)[..., np.newaxis]
    return paint


def _foliage(
    rng: np.random.Generator,
    leaves: int,
    length: float,
    *colours: str,
    upright: bool = False,
    side: int = 1024,
) -> np.ndarray:
    """A card of scattered leaves, or of `upright` blades that grow from its lower edge."""
    stops = _painted(rng.uniform(0, 1, (leaves, 1)), *colours)[:, 0, :3] * 255
    canvas = np.zeros((side, side, 4), np.uint8)
    canvas[..., :3] = stops.mean(axis=0)
    along = np.linspace(0, 1, 12)
    for colour in stops:
        size = length * rng.uniform(0.6, 1.25)
        if upright:
            foot = np.array([rng.uniform(0.02, 0.98), 1.0])
            lean, thick = rng.normal(0, 0.22), 0.022 * size
            spine = np.stack([lean * size * along**2, -size * along], axis=1)
            half = np.stack([thick * (1 - along**2), 0 * along], axis=1)
        else:
            foot = rng.uniform(0.08, 0.92, 2) * (1 - size) + size / 2
            angle = rng.uniform(0, 2 * np.pi)
            axis, normal = (
                np.array([np.cos(angle), np.sin(angle)]),
                np.array([-np.sin(angle), np.cos(angle)]),
            )
            spine = np.outer(size * (along - 0.5), axis)
            half = np.outer(0.21 * size * np.sin(np.pi * along**0.8), normal)
        # Two halves of unlike brightness, and a rib between them, make a leaf look folded.
        for edge, light in ((half, 1.08), (-half, 0.86)):
            outline = np.concatenate([spine + edge, spine[::-1]]) + foot
            points = np.rint(outline * side * 16).astype(np.int32)
            shade = [float(min(255.0, c * light)) for c in colour] + [255.0]
            cv2.fillPoly(canvas, [points], shade, cv2.LINE_AA, shift=4)
        rib = np.rint((spine + foot) * side * 16).astype(np.int32)
        rib_shade = [float(min(255.0, 1.18 * c + 12)) for c in colour] + [255.0]
        cv2.polylines(canvas, [rib], False, rib_shade, max(1, side // 600), cv2.LINE_AA, 4)
    paint = canvas.astype(np.float32) / 255
    # Half a card repeated is as good; blades stand on wide, low cards and are streaked upwards.
    streaks = (0.3, 3.0) if upright else (1.0, 1.0)
    mottle = np.tile(1 + 0.10 * _noise(rng, side // 2, 2, 55, 0.7, along=streaks), (2, 2))
    paint[..., :3] = np.clip(paint[..., :3] * mottle[..., np.newaxis], 0, 1)
    return paint


def _blossom(rng: np.random.Generator, *colours: str, petals: int = 5, side: int = 256):
    p, q = _grid(side)
    angle, radius = np.arctan2(q - 0.5, p - 0.5), 2 * np.hypot(p - 0.5, q - 0.5)
    lobe = np.abs(np.cos(petals / 2 * angle + rng.uniform(0, np.pi))) ** 0.55
    reach = 0.42 + 0.5 * lobe
    streaks = 0.08 * np.sin(petals * 7 * angle) + 0.06 * _noise(rng, side, 3, 60)
    shade = np.clip(radius / reach + streaks - 0.25 * (1 - lobe), 0, 1)
    paint = _painted(shade, *colours, alpha=_step(reach - radius, 0, 0.02))
    heart = _painted(np.clip(0.5 + 0.3 * _noise(rng, side, 8, 70, 0.3), 0, 1), "#8a5a10", "#ffe27a")
    return _mixed(paint, heart, _step(-radius, -0.2, 0.03) * (paint[..., 3] > 0))


def _star_chart(side: int = 512) -> np.ndarray:
    """A resolution target: Siemens star, zone rings and bars of rising frequency."""
    p, q = _grid(side)
    angle, radius = np.arctan2(q - 0.42, p - 0.5), np.hypot(p - 0.5, q - 0.42)
    star = 0.5 + 0.5 * np.tanh(4 * np.sin(24 * angle) * np.minimum(1, radius * 8))
    bars = 0.5 + 0.5 * np.tanh(3 * np.sin(2 * np.pi * (8 * p + 14 * p * p)))
    shade = np.ones_like(p)
    shade = np.where(radius < 0.33, star, shade)
    shade = np.where((np.abs(radius - 0.345) < 0.008), 0, shade)
    shade = np.where((np.abs(q - 0.88) < 0.055) & (np.abs(p - 0.5) < 0.42), bars, shade)
    shade = cv2.GaussianBlur(shade.astype(np.float32), (0, 0), 1.2)
    return _painted(shade, "#161616", "#f3f1ea", alpha=_rectangle(side))


def _postcard(rng: np.random.Generator, side: int = 512) -> np.ndarray:
    """A painted landscape with a white border: sky, sun, three ranges of hills, a lake."""
    p, q = _grid(side)
    clouds = np.clip(0.6 * _noise(rng, side, 2, 40, 1.3, along=(2.5, 1)), 0, 1)
    sky = _painted(np.clip(q * 1.7, 0, 1), "#3f7fc4", "#9cc8e8", "#f7dcb4")
    paint = _mixed(sky, np.ones_like(sky), 0.7 * clouds * (q < 0.55))
    sun = np.hypot(p - rng.uniform(0.25, 0.75), q - 0.3)
    paint = _mixed(paint, _painted(0 * p, "#fff3c4", "#fff3c4"), _step(-sun, -0.06, 0.01))
    grain = _noise(rng, side, 4, 100, 0.6)
    for base, colours in (
        (0.5, ("#5c7391", "#93a7bd")),
        (0.6, ("#2f5a4a", "#6d9a70")),
        (0.74, ("#2b3f1e", "#7d9440")),
    ):
        ridge = base + 0.045 * _noise(rng, side, 1, 14, 1.2)[side // 2][np.newaxis, :]
        hill = _painted(np.clip(0.5 + 0.22 * grain + 0.8 * (q - base), 0, 1), *colours)
        paint = _mixed(paint, hill, _step(q - ridge, 0, 0.004))
    border = np.minimum(np.minimum(p, 1 - p), np.minimum(q, 1 - q))
    paint = _mixed(np.full_like(paint, 0.95), paint, _step(border, 0.06, 0.004))
    paint[..., 3] = _rectangle(side)
    return paint


def _printed_page(rng: np.random.Generator, side: int = 512) -> np.ndarray:
    """A page of invented letters in words and lines, under a coloured headline."""
    p, q = _grid(side)
    lines, letters = 17, 44
    row, column = np.floor(q * lines).astype(int), np.floor(p * letters).astype(int)
    is_letter = rng.uniform(size=(lines, letters)) > 0.17
    is_letter[:, :3] = is_letter[:, -3:] = False
    is_letter[[0, 1, 2, 3, -1], :] = False
    stroke = _noise(rng, side, 25, 60, 0.0) > 0.15
    body = (np.abs(q * lines % 1 - 0.5) < 0.3) & (np.abs(p * letters % 1 - 0.5) < 0.42)
    ink = (is_letter[row, column] & body & stroke).astype(np.float32)
    page = _painted(1 - cv2.GaussianBlur(ink, (0, 0), 1.0), "#1c1a18", "#f1ead9")
    headline = (np.abs(q - 0.14) < 0.035) & (np.abs(p - 0.5) < 0.4) & (stroke | (p % 0.09 < 0.05))
    red = _painted(0 * p, "#a32a22", "#a32a22")
    page = _mixed(page, red, cv2.GaussianBlur(headline.astype(np.float32), (0, 0), 1.0))
    page[..., 3] = _rectangle(side)
    return page


def _leaf(rng: np.random.Generator, *colours: str, side: int = 512) -> np.ndarray:
    """One big leaf with its veins, tip to the right."""
    p, q = _grid(side)
    half = 0.34 * np.sin(np.pi * np.clip(p * 1.04 - 0.02, 0, 1) ** 0.75)
    half = half * (1 + 0.04 * np.sin(2 * np.pi * 19 * p))
    off = q - 0.5 - 0.03 * np.sin(2 * np.pi * p)
    veins = np.exp(-((((p - 0.55 * np.abs(off)) * 11 % 1) - 0.5) ** 2) / 0.006)
    rib = np.exp(-((off / 0.008) ** 2))
    shade = 0.42 + 0.13 * _noise(rng, side, 2, 100, 0.9) + 0.28 * np.maximum(veins * 0.7, rib)
    shade = shade + 0.08 * np.sign(off)
    return _painted(np.clip(shade, 0, 1), *colours, alpha=_step(half - np.abs(off), 0, 0.006))


def _film(colour: str, opacity: float, side: int = 256) -> np.ndarray:
    """A clear coloured sheet with a light rim."""
    p, q = _grid(side)
    border = np.minimum(np.minimum(p, 1 - p), np.minimum(q, 1 - q))
    rim = 1 - _step(border, 0.045, 0.008)
    paint = _mixed(_painted(0 * p, colour, colour), np.full((side, side, 4), 0.93), 0.8 * rim)
    paint[..., 3] = np.maximum(opacity, 0.85 * rim) * _rectangle(side)
    return paint


def _lattice(rng: np.random.Generator, cells: int, side: int = 1024) -> np.ndarray:
    """Round wires, woven diagonally, shaded across."""
    p, q = _grid(side)
    one, other = (p + q) * cells, (p - q) * cells
    near = np.minimum(np.abs(one % 1 - 0.5), np.abs(other % 1 - 0.5)) / 0.075
    light = np.sqrt(np.clip(1 - near * near, 0, 1))
    rust = 0.16 * _noise(rng, side, 3, 80)
    shade = np.clip(0.15 + 0.65 * light + rust, 0, 1)
    return _painted(shade, "#3c4438", "#93a08c", "#e8ecdc", alpha=_step(1 - near, 0, 0.12))


def _soft_shadow(strength: float, side: int = 128) -> np.ndarray:
    """What a lifted sheet of paper leaves on the table: a dark card with blurred edges."""
    inside = np.pad(np.full((side * 3 // 4, side * 3 // 4), strength, np.float32), side // 8)
    alpha = cv2.GaussianBlur(inside, (0, 0), side / 28)
    return _painted(np.zeros_like(alpha), "#140c06", "#140c06", alpha=alpha)


def _surroundings(
    rng: np.random.Generator, *colours: str, lamp: float = 2.5, side: int = 512
) -> np.ndarray:
    """A room, from floor through walls to ceiling, with a window and a strip of light.

    Lambert's equal-area map of directions, middle towards the viewer; a lamp may exceed 1.
    """
    p, q = _grid(side)
    x, y = 2 * (p - 0.5), 2 * (q - 0.5)
    z = np.clip(1 - 2 * (x * x + y * y), -1, 1)
    scale = np.sqrt(2 * (1 + z))
    x, y = x * scale, y * scale
    room = _painted(np.clip(0.5 - 0.5 * y + 0.06 * _noise(rng, side, 2, 40), 0, 1), *colours)
    shelves = (np.sin(26 * x + 3 * np.sin(5 * y)) > 0.2) & (np.abs(y - 0.12) < 0.16)
    room[..., :3] *= 1 - 0.45 * shelves[..., np.newaxis]
    ahead = np.maximum(z, 0.05)
    across, down = x / ahead + 0.75, y / ahead + 0.95
    window = (np.abs(across) < 0.42) & (np.abs(down) < 0.5) & (z > 0.1)
    window &= (np.abs(across) > 0.035) & (np.abs(down + 0.05) > 0.035)
    strip = (np.abs(x - 0.8) < 0.05) & (np.abs(y + 0.1) < 0.4) & (z > 0)
    light = cv2.GaussianBlur((window + 0.7 * strip).astype(np.float32), (0, 0), side / 250)
    room[..., :3] += lamp * light[..., np.newaxis] * np.array([1.0, 0.97, 0.9], np.float32)
    return room


# Scenes: S runs from -1/2 to 1/2 across the picture, T downwards, +-3/8 at 3:4.


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
            lying(_soft_shadow(0.5), lift / 3, below, slope_s, slope_t),
            lying(texture, lift, _frame(s, t, width, height, turn_deg), slope_s, slope_t),
        ]

    def marble(s: float, t: float, radius: float, **more) -> Ball:
        floor = -0.1 + 0.12 * s + 0.42 * t
        return Ball(s, t, floor + 0.09, radius, 0.09, gloss=0.05, **more)

    wood = _wood(rng, "#4a2c17", "#8f5f35", "#c89a63")
    return World(
        cards=(
            lying(wood, 0.0, _frame(0, 0, 1, 1), tiled=True),
            *paper(_star_chart(), 0.04, (-0.27, -0.1, 0.36, 0.36, -8)),
            *paper(_printed_page(rng), 0.06, (0.26, 0.16, 0.34, 0.44, 12), slope_t=0.75),
            *paper(_postcard(rng), 0.12, (0.14, -0.19, 0.4, 0.27, -4), slope_s=0.5),
            lying(
                _leaf(rng, "#4c2a12", "#b5651d", "#e8b04a", "#f6dd92"),
                0.1,
                _frame(-0.21, 0.2, 0.4, 0.26, 24),
                slope_s=-0.35,
            ),
        ),
        balls=(
            marble(-0.43, 0.26, 0.045, texture=_stone(rng, "#12325c", "#3f7fc0", "#d9ecf7")),
            marble(-0.02, 0.06, 0.036, texture=_segments(rng, "#c8362b", "#f0e4c8", "#2f6f9f")),
            marble(0.44, -0.27, 0.04, texture=_stone(rng, "#1d4a2a", "#5fa05a", "#e6efc0")),
        ),
        surroundings=_surroundings(rng, "#3a2a1d", "#8b7a66", "#d8cfc0"),
        ambient=0.55,
    )


def _garden(rng: np.random.Generator) -> World:
    def leaves(count: int, length: float, tones: int, disparity: float, *at: float, **more) -> Card:
        greens = (
            ("#20401f", "#3f6b2e", "#7c9a45"),
            ("#2a5a26", "#5f9436", "#b7c95a"),
            ("#5a2a16", "#b0532a", "#e39b3c"),
        )[tones]
        return Card(_foliage(rng, count, length, *greens), disparity, _frame(*at), **more)

    side = 1024
    q = _grid(side)[1]
    hedge = _noise(rng, side, 2, 60, 1.0)
    sky = _painted(np.clip(q * 2.6 + 0.05 * hedge, 0, 1), "#6fa4d8", "#bcd8ec", "#f3e8cf")
    trees = _painted(np.clip(0.45 + 0.2 * hedge, 0, 1), "#1d331d", "#48703a", "#9db860")
    crowns = 0.34 + 0.06 * _noise(rng, side, 1, 24, 1.2)[side // 3][np.newaxis, :]
    backdrop = _mixed(sky, trees, _step(q - crowns, 0, 0.006))
    lawn = _stone(rng, "#2c4a1c", "#5d8a34", "#a9bd5b", side=1024)
    pillar = _bricks(rng, rows=18, columns=3, side=512)
    pillar[..., 3] = _rectangle(512)
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
                _foliage(rng, 90, 0.8, "#2f5a1f", "#6f9c33", "#c7cf6a", upright=True),
                2.0,
                _frame(0.0, 0.26, 1.25, 0.3),
            ),
        ),
        balls=(
            Ball(
                -0.06 + jitter[5], 0.12, 0.0, 0.105, 0.35,
                _segments(rng, "#d0342c", "#f4ead2", "#2d6fb0", "#f0b429"), gloss=0.03,
            ),
            Ball(
                0.23 + jitter[6], 0.21, 0.9, 0.075, 0.3,
                _stone(rng, "#5b2f14", "#b06a2f", "#e9b66f", veins=0.3), texture_scale=0.7,
            ),
            Ball(
                -0.33 + jitter[7], 0.2, 1.1, 0.06, 0.25,
                _stone(rng, "#6a6f75", "#b9bfc2", "#eef0ee", veins=0.4), texture_scale=0.6,
            ),
        ),
        surroundings=_surroundings(rng, "#31461f", "#8fae7a", "#cfe3f2", lamp=1.5),
        ambient=0.5,
    )  # fmt: skip


def _still_life(rng: np.random.Generator) -> World:
    jitter = rng.uniform(-0.02, 0.02, 6)
    wall = _stone(rng, "#5e6f78", "#93a3a6", "#c4cdc8", side=1024)
    plaque = _wood(rng, "#1a0d08", "#3c1d12", "#5e3320", planks=2, side=512)
    plaque[..., 3] = _rectangle(512)
    return World(
        cards=(
            Card(wall, -1.6, _frame(0, 0, 1, 1), tiled=True),
            Card(
                _gingham(rng, "#a8322d", 6), -2.1, _ground(-0.06, 0.3), slope_t=9.0, tiled=True,
                sheen=0.06, sheen_depth=1.5,
            ),
            Card(_postcard(rng), -1.45, _frame(-0.27 + jitter[0], -0.2, 0.32, 0.23)),
            Card(_star_chart(), -1.4, _frame(0.06 + jitter[1], -0.2, 0.25, 0.25)),
            Card(
                plaque, -0.9, _frame(0.36, -0.15, 0.24, 0.36), slope_s=1.5,
                sheen=0.25, sheen_depth=2.5,
            ),
            Card(_film("#1f8fb5", 0.42), 1.5, _frame(0.22 + jitter[2], 0.2, 0.25, 0.22, 7)),
        ),
        balls=(
            Ball(
                -0.02 + jitter[3], 0.08, 0.0, 0.135, 0.9, glass=True, gloss=0.04,
                tint=(0.93, 0.98, 0.95),
            ),
            Ball(
                -0.31 + jitter[4], 0.06, -0.2, 0.115, 0.9, gloss=0.85,
                texture=_stone(rng, "#777777", "#bbbbbb"),
            ),
            Ball(
                0.29, 0.06, -0.3, 0.1, 0.7, gloss=0.14,
                texture=_stone(rng, "#5a0d14", "#a8202a", "#d85a4a"),
            ),
            Ball(
                -0.2, 0.27 + jitter[5] / 2, 1.2, 0.055, 0.5, gloss=0.1,
                texture=_segments(rng, "#e8a92c", "#1f3f6f", "#efe6d2"),
            ),
        ),
        surroundings=_surroundings(rng, "#6b2a22", "#9c8b78", "#cfc6b6", "#efe9dc"),
    )  # fmt: skip


def _night_blossoms(rng: np.random.Generator) -> World:
    cards = [
        Card(
            _stone(rng, "#06100a", "#1c3420", "#4a5a34", side=1024),
            -0.6,
            _frame(0, 0, 1, 1),
            tiled=True,
        )
    ]
    greens = ("#10240f", "#2c4f22", "#6f8a3d")
    for disparity, count in ((-0.4, 130), (-0.15, 80), (0.1, 45)):
        at = _frame(rng.uniform(-0.1, 0.1), rng.uniform(-0.05, 0.1), 1.15, 0.85)
        foliage = _foliage(rng, count, 0.15, *greens)
        cards.append(Card(foliage, disparity, at, slope_s=rng.uniform(-0.2, 0.2)))
    palettes = (
        ("#ffe9f2", "#f29ac0", "#b03a78"),
        ("#fffdf5", "#f5efe0", "#c9b8a0"),
        ("#ffe6a0", "#f2a23c", "#b0481c"),
    )
    for i, disparity in enumerate(np.linspace(-0.3, 0.6, 11)):
        bloom = _blossom(rng, *palettes[i % 3], petals=5 + i % 2)
        size = rng.uniform(0.13, 0.19) * (1.15 + 0.5 * disparity)
        cell_s, cell_t = (i * 7 % 11) / 11 - 0.45, (i * 5 % 11) / 11 * 0.62 - 0.28
        s, t = cell_s + rng.uniform(-0.04, 0.04), cell_t + rng.uniform(-0.04, 0.04)
        at = _frame(s, t, size, size * rng.uniform(0.75, 1), rng.uniform(0, 90))
        tilt = rng.uniform(-0.8, 0.8, 2)
        middle = disparity - tilt[0] * s - tilt[1] * t
        cards.append(Card(bloom, middle, at, slope_s=tilt[0], slope_t=tilt[1]))
    fruit = _stone(rng, "#4a0a10", "#a01c22", "#d8483a")
    return World(
        cards=tuple(cards),
        balls=tuple(
            Ball(*place, 0.04, 0.08, fruit, gloss=0.1)
            for place in ((-0.33, 0.24, 0.4), (-0.27, 0.29, 0.45), (0.38, -0.02, 0.3))
        ),
        surroundings=_surroundings(rng, "#0c1410", "#26352c", "#4a5a6a", lamp=60.0),
        ambient=0.5,
        brightness=0.5,
    )


def _avenue(rng: np.random.Generator) -> World:
    side = 1024
    q = _grid(side)[1]
    clouds = np.clip(0.5 + 0.25 * _noise(rng, side, 1, 30, 1.4, along=(2, 1)), 0, 1)
    sky = _painted(0.6 * clouds + 0.4 * np.clip(q * 2.3, 0, 1), "#4f86c0", "#a8cbe6", "#fbf3e2")
    paving = _bricks(rng, rows=10, columns=5)
    paving[..., :3] = 0.35 * paving[..., :3] + 0.6 * paving[..., 1:2] + 0.12
    trunk = _wood(rng, "#2e2219", "#6d5440", "#a58a6b", planks=1, side=512).transpose(1, 0, 2)
    trunk = np.ascontiguousarray(trunk)
    trunk[..., 3] = _rectangle(512, margin=0.06)
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
            crown = _foliage(rng, 130, 0.16, *tones, side=512)
            cards += [Card(trunk, disparity, trunk_at), Card(crown, disparity + 0.3, crown_at)]
    cards.append(Card(_lattice(rng, 7), 10.5, _frame(0.36, 0.25, 0.5, 0.5), slope_s=-5.0))
    return World(
        cards=tuple(cards),
        balls=(
            Ball(
                -0.05, 0.16, 1.6, 0.08, 1.2,
                _segments(rng, "#d0342c", "#f4ead2", "#2d6fb0", "#f0b429"), gloss=0.03,
            ),
            Ball(
                -0.3, 0.26, 6.0, 0.09, 1.6,
                _stone(rng, "#28323c", "#74828e", "#dfe6e8", veins=0.4), gloss=0.05,
            ),
        ),
        surroundings=_surroundings(rng, "#5a5248", "#b8b8b0", "#b4d2ea", lamp=1.5),
        ambient=0.55,
    )  # fmt: skip


SCENES: dict[str, Scene] = {
    "near-planar": Scene("papers, a leaf and marbles on a tilted desk", (-0.3, 0.3), _desk),
    "deep-occlusions": Scene("a garden behind leaves and grass", (-2.0, 2.0), _garden),
    "non-lambertian": Scene("glass, mirror, gloss and clear film", (-1.6, 1.6), _still_life),
    "dark": Scene("blossoms at night, a few saturated glints", (-0.6, 0.6), _night_blossoms),
    "wide-disparity": Scene("an avenue seen through a fence", (-6.0, 10.0), _avenue),
}

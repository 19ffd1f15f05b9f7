"""Ray casting: fills a view of a world of textured cards and balls with colours or disparities.

Coordinates. A pixel's centre has X = (x + 1/2) / W - 1/2 and Y = (y + 1/2 - H/2) / W: the unit is
the picture's width. The views fill a fixed aperture: view j of n has the aperture coordinate
a = (j - (n - 1) / 2) / n, in (-1/2, 1/2); of unequal row and column counts, n is the larger, so
that a step is as long in u as in v. A scene point (S, T, D) is seen in view a at
X = S + D a_u, Y = T + D a_v: a ray is a straight line in (S, T, D), and nearer points have the
larger D. In pixels per view step the disparity of that point is D W / n.

Worlds are described in disparities as quoted: in pixels per view step of 5 views of 256 columns,
D = disparity x 5 / 256. Hence n views of width W see disparity x (5 / n) x (W / 256), and 10 views
at twice the size are the same world sampled finer.

Rays are traced one per view through 2x2 points of every pixel (a pinhole in the middle of each
aperture cell), meet textured cards and balls, and may be reflected or refracted once per ball.
Ball normals are those of a sphere in a space in which D is stretched until the ball is round.
Left out: shadows cast by cards, objects mirrored in others (mirrors show only the surroundings),
light that bounces between surfaces.

Textures are (side, side, 4) RGBA in [0, 1], side a power of two.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from emmc_rig.model.compiling import njit

QUOTED = 5 / 256
"""D, in widths per aperture, of a disparity as quoted of 1."""
_START_D = 1.0
"""Rays start nearer than any object."""
_MAX_SURFACES = 24
"""Surfaces one ray may pass before it is given up."""
_SUPERSAMPLES = 2
_MISSED = -1


@dataclass(frozen=True)
class Motion:
    """An object's motion: a swing to either side of its place, and a turn about its centre.

    swing: farthest in S and T, in widths, and in disparity, as quoted; it goes to and fro once in
    `period_s`, fastest at time 0. turn_rad_s: about the axes S, T and D; a card turns about D
    alone.
    """

    swing: tuple[float, float, float] = (0.0, 0.0, 0.0)
    period_s: float = 1.0
    turn_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)


STILL = Motion()


@dataclass(frozen=True)
class CameraMotion:
    """How the camera moves, to and fro once in `period_s`, fastest at time 0.

    pan: to the right and downwards, in widths, as it turns: the whole picture moves the other way.
    slide: in apertures, to where views of larger u see the scene from: near things move most.
    """

    pan: tuple[float, float] = (0.0, 0.0)
    slide: float = 0.0
    period_s: float = 1.0


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
    motion: Motion = STILL


@dataclass(frozen=True)
class Ball:
    """A sphere of radius `radius` (in widths) that spans disparity +- `depth`, as quoted.

    `gloss` is the mirror reflectance head on (it rises to 1 at the limb where it is not 0);
    `glass` balls show no texture but what they refract (index 1.5), tinted by `tint`. `turn` is
    the rotation vector, in radians, by which the ball and its texture are turned.
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
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    motion: Motion = STILL


@dataclass(frozen=True)
class World:
    """All objects of a scene, its surroundings (an equal-area map of directions), its light.

    camera: how the camera moves, see `simulators.moving`.
    """

    cards: tuple[Card, ...]
    balls: tuple[Ball, ...]
    surroundings: np.ndarray
    ambient: float = 0.45
    brightness: float = 1.0
    camera: CameraMotion = CameraMotion()


# Rows of the tables that the compiled kernels read.
_CARD = np.dtype(
    [(f"h{i}{j}", np.float64) for i in range(3) for j in range(3)]
    + [(field, np.float64) for field in ("d", "slope_s", "slope_t", "sheen", "sheen_depth")]
    + [(field, np.int64) for field in ("offset", "side", "tiled")]
)
_BALL = np.dtype(
    [(field, np.float64) for field in ("s", "t", "d", "radius", "depth", "scale", "gloss")]
    + [(field, np.float64) for field in ("tint_r", "tint_g", "tint_b")]
    + [(f"r{i}{j}", np.float64) for i in range(3) for j in range(3)]
    + [(field, np.int64) for field in ("offset", "side", "glass")]
)
_LIGHT = np.array([-0.45, -0.65, 0.61]) / np.linalg.norm([-0.45, -0.65, 0.61])
"""Towards the lamp: from the left, from above (T grows downwards), from the front."""


@dataclass(frozen=True)
class Tables:
    """A world as the compiled kernels read it, disparities in widths per aperture.

    `cards` and `balls` are structured arrays of one row per object; `corners` (card, 4, 2) are
    the S and T of a card's corners, infinite where it is tiled; `texels` holds all textures one
    after the other; `surroundings` is the offset and side of theirs; `lighting` is the direction
    of the lamp, the ambient part and the brightness.
    """

    cards: np.ndarray
    balls: np.ndarray
    corners: np.ndarray
    texels: np.ndarray
    surroundings: tuple[int, int]
    lighting: np.ndarray


def tabulated(world: World) -> Tables:
    """Lay out a world for `paint_view` and `first_surfaces`."""
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
        row["d"] = card.disparity * QUOTED
        row["slope_s"], row["slope_t"] = card.slope_s * QUOTED, card.slope_t * QUOTED
        for i, j in np.ndindex(3, 3):
            row[f"h{i}{j}"] = card.to_texture[i, j]
        row["offset"], row["side"] = placed(card.texture)
        row["tiled"] = card.tiled
        row["sheen"], row["sheen_depth"] = card.sheen, card.sheen_depth * QUOTED
        ends = np.linalg.inv(card.to_texture) @ np.array([[0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1]])
        corner[:] = np.inf if card.tiled else (ends[:2] / ends[2]).T
    balls = np.zeros(len(world.balls), _BALL)
    for row, ball in zip(balls, world.balls, strict=True):
        row["s"], row["t"], row["d"] = ball.s, ball.t, ball.disparity * QUOTED
        row["radius"], row["depth"] = ball.radius, ball.depth * QUOTED
        row["scale"], row["gloss"], row["glass"] = ball.texture_scale, ball.gloss, ball.glass
        row["tint_r"], row["tint_g"], row["tint_b"] = ball.tint
        turned = cv2.Rodrigues(np.array(ball.turn))[0]
        for i, j in np.ndindex(3, 3):
            row[f"r{i}{j}"] = turned[j, i]
        if ball.texture is not None:
            row["offset"], row["side"] = placed(ball.texture)
    surroundings = placed(world.surroundings)
    lighting = np.array([*_LIGHT, world.ambient, world.brightness])
    return Tables(cards, balls, corners, np.concatenate(texels), surroundings, lighting)


def paint_view(view: np.ndarray, a_s: float, a_t: float, tables: Tables) -> None:
    """Fill one view (y, x, 3), float32, with the colours seen from an aperture coordinate."""
    _trace_colours(view, a_s, a_t, *_kernel_arguments(a_s, a_t, tables))


def first_surfaces(size: tuple[int, int], a_s: float, a_t: float, tables: Tables) -> np.ndarray:
    """Return D, in widths per aperture, of what is seen at the centres of a view's pixels: (y, x).

    It is that of the first surface that is at least half opaque, a ball always; 0 where there is
    none.
    """
    d = np.zeros(size)
    _trace_surfaces(d, a_s, a_t, *_kernel_arguments(a_s, a_t, tables))
    return d


def _kernel_arguments(a_s: float, a_t: float, tables: Tables) -> tuple:
    cards, balls = tables.cards, tables.balls
    windows = _windows(cards, balls, tables.corners, a_s, a_t)
    return *windows, cards, balls, tables.texels, *tables.surroundings, tables.lighting


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


_rules: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz", "reassoc"},
}
_kernel, _helper = njit(cache=True, **_rules), njit(forceinline=True, **_rules)


@_helper
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


@_helper
def _around(texels, offset, side, x, y, z):
    """The surroundings in a direction: Lambert's equal-area map, its middle towards the viewer."""
    k = 0.5 / np.sqrt(max(2 * (1 + z), 1e-9))
    return _texel(texels, offset, side, 0.5 + k * x, 0.5 + k * y, False)


@_helper
def _on_card(card, s, t):
    """Texture coordinates of a point of a card."""
    w = 1 / (card.h20 * s + card.h21 * t + card.h22)
    p = (card.h00 * s + card.h01 * t + card.h02) * w
    q = (card.h10 * s + card.h11 * t + card.h12) * w
    return p, q


@_helper
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


@_helper
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


@_kernel
def _trace_colours(
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
                own_x = ball.r00 * nx + ball.r01 * ny + ball.r02 * nz
                own_y = ball.r10 * nx + ball.r11 * ny + ball.r12 * nz
                own_z = ball.r20 * nx + ball.r21 * ny + ball.r22 * nz
                stretch = ball.scale / (1 + max(own_z, 0.0))
                cr, cg, cb, _ = _texel(
                    texels, ball.offset, ball.side,
                    0.5 + stretch * own_x, 0.5 + stretch * own_y, True,
                )  # fmt: skip
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


@_kernel
def _trace_surfaces(
    d, a_s, a_t, card_windows, ball_windows,
    cards, balls, texels, around, around_side, lighting,
):  # fmt: skip
    """Fill D (y, x) of the first surface at each pixel's centre that is at least half opaque."""
    height, width = d.shape
    for row in range(height):
        for column in range(width):
            x = (column + 0.5) / width - 0.5
            y = (row + 0.5 - height / 2) / width
            start = -_START_D
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
                d[row, column] = -k
                break

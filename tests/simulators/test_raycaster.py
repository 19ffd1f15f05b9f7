"""Built-in scenes against closed-form geometry: planes, balls, glass, shadows, changed worlds."""

import itertools

import numpy as np
import pytest
from smooth_texture import SIDE, SMOOTH, UNLIT

from emmc_rig.model.errors import SceneError
from emmc_rig.model.lightfield import centre_view, psnr_db
from emmc_rig.simulators.changes import deepened, moved
from emmc_rig.simulators.raycaster import Ball, Card, World, tabulated
from emmc_rig.simulators.scenes import SCENES, Scene, render, rendered

SIZE_PX = (48, 64)
_names = (f"test world {i}" for i in itertools.count())


def smooth(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """The texture SMOOTH written as a function."""
    return np.stack(
        [
            0.5 + 0.3 * np.sin(2 * np.pi * 2 * p) * np.cos(2 * np.pi * q),
            0.5 + 0.3 * np.cos(2 * np.pi * (p + 2 * q)),
            0.5 + 0.3 * np.sin(2 * np.pi * (2 * p - q)),
        ],
        axis=-1,
    )


# Texture coordinates (S + 1/2, T + 1/2).
PICTURE_PLANE = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]], dtype=float)


@pytest.fixture
def build(monkeypatch):
    """Put a world among the built-in scenes, evenly lit, and return its name."""

    def add(*objects: Card | Ball) -> str:
        cards = tuple(o for o in objects if isinstance(o, Card))
        balls = tuple(o for o in objects if isinstance(o, Ball))
        name = next(_names)
        world = World(cards, balls, UNLIT, ambient=1.0)
        monkeypatch.setitem(SCENES, name, Scene("a test", (0, 0), lambda _rng: world))
        return name

    return add


def quoted(disparity_px: float, n: int = 5, width_px: int = SIZE_PX[1]) -> float:
    """The quoted disparity of what n views of this width see as `disparity_px`."""
    return disparity_px * (n / 5) * (256 / width_px)


def picture_points(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """X and Y of every pixel's centre, in widths."""
    y, x = np.indices(size)
    return (x + 0.5) / size[1] - 0.5, (y + 0.5 - size[0] / 2) / size[1]


def subsampled(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """X and Y of 2x2 points in every pixel."""
    x, y = picture_points((2 * size[0], 2 * size[1]))
    return x, y


def pixel_mean(samples: np.ndarray) -> np.ndarray:
    height, width, colours = samples.shape
    return samples.reshape(height // 2, 2, width // 2, 2, colours).mean(axis=(1, 3))


def test_a_plane_of_whole_disparity_moves_by_exactly_that_many_pixels_per_view(build):
    name = build(Card(SMOOTH, quoted(2), PICTURE_PLANE, tiled=True))
    scene = render(name, (5, 5), SIZE_PX)
    np.testing.assert_allclose(scene.disparity_px, 2, atol=1e-6)
    centre = centre_view(scene.light_field)
    for v, u in ((0, 0), (0, 4), (2, 3), (4, 1)):
        dy, dx = 2 * (v - 2), 2 * (u - 2)
        moved = np.roll(scene.light_field[v, u], (-dy, -dx), axis=(0, 1))
        np.testing.assert_allclose(moved[4:-4, 4:-4], centre[4:-4, 4:-4], atol=2e-6)


def test_a_texture_is_sampled_where_the_rule_of_the_aperture_says(build):
    """View j of n has aperture (j - (n - 1) / 2) / n, here for an even and an odd count."""
    disparity_px = 1.3
    name = build(Card(SMOOTH, quoted(disparity_px, n=6), PICTURE_PLANE, tiled=True))
    views = (3, 6)
    light_field = render(name, views, SIZE_PX).light_field
    x, y = subsampled(SIZE_PX)
    for v, u in ((0, 0), (1, 2), (2, 5)):
        shift_x, shift_y = (
            disparity_px * (j - (n - 1) / 2) / SIZE_PX[1] for j, n in ((u, views[1]), (v, views[0]))
        )
        expected = pixel_mean(smooth(x - shift_x + 0.5, y - shift_y + 0.5))
        np.testing.assert_allclose(light_field[v, u], expected, atol=1e-3)


def test_a_slanted_plane_has_the_disparity_of_its_equation(build):
    name = build(
        Card(SMOOTH, quoted(0.5), PICTURE_PLANE, slope_s=quoted(3), slope_t=quoted(-2), tiled=True)
    )
    scene = render(name, (5, 5), SIZE_PX)
    s, t = picture_points(SIZE_PX)
    disparity_px = 0.5 + 3 * s - 2 * t
    np.testing.assert_allclose(scene.disparity_px, disparity_px, atol=1e-5)
    # In view (4, 0): where does the point seen at X lie? S = X - D a, D = D(S, T), solved by hand.
    x, y = subsampled(SIZE_PX)
    step = 1 / SIZE_PX[1]
    a_s, a_t = -2 * step, 2 * step
    d = (0.5 + 3 * x - 2 * y) / (1 + 3 * a_s - 2 * a_t)
    expected = pixel_mean(smooth(x - d * a_s + 0.5, y - d * a_t + 0.5))
    np.testing.assert_allclose(scene.light_field[4, 0], expected, atol=1e-3)


def test_a_nearer_card_hides_a_farther_one_and_half_opaque_film_mixes_with_it(build):
    red, film = UNLIT.copy(), UNLIT.copy()
    red[..., 0] = red[..., 3] = 1
    film[..., 2], film[..., 3] = 1, 0.25
    name = build(
        Card(film, quoted(1), PICTURE_PLANE, tiled=True),
        Card(red, quoted(0), PICTURE_PLANE, tiled=True),
        Card(SMOOTH, quoted(-1), PICTURE_PLANE, tiled=True),
    )
    scene = render(name, (2, 2), SIZE_PX)
    expected = np.broadcast_to([0.75, 0, 0.25], scene.light_field.shape)
    np.testing.assert_allclose(scene.light_field, expected, atol=1e-6)
    np.testing.assert_allclose(scene.disparity_px, 0, atol=1e-6)


def patch(rows: slice, columns: slice) -> np.ndarray:
    """Texture coordinates of a card over these pixels of the centre view."""
    height, width = rows.stop - rows.start, columns.stop - columns.start
    across, down = SIZE_PX[1] / width, SIZE_PX[1] / height
    left, top = columns.start / SIZE_PX[1] - 0.5, (rows.start - SIZE_PX[0] / 2) / SIZE_PX[1]
    return np.array([[across, 0, -across * left], [0, down, -down * top], [0, 0, 1]])


def test_a_card_ends_where_its_corners_are_in_every_view(build):
    rows, columns = slice(12, 36), slice(16, 40)
    white = np.ones((SIDE, SIDE, 4), np.float32)
    name = build(Card(white, quoted(2), patch(rows, columns)))
    light_field = render(name, (5, 5), SIZE_PX).light_field
    for v, u in np.ndindex(5, 5):
        expected = np.zeros(SIZE_PX)
        expected[rows, columns] = 1
        expected = np.roll(expected, (2 * (v - 2), 2 * (u - 2)), axis=(0, 1))
        np.testing.assert_allclose(light_field[v, u, ..., 1], expected, atol=1e-6)


def test_a_ball_s_shadow_falls_along_the_light_onto_the_card_behind_it():
    """The lamp stands at (-0.45, -0.65, 0.61), in the ball's radii; the ball is 4 depths before."""
    radius, depth = 0.03, quoted(0.5)
    ball = Ball(-0.1, -0.1, quoted(2), radius, depth, texture=np.ones_like(SMOOTH))
    card = Card(np.ones_like(SMOOTH), 0.0, PICTURE_PLANE, tiled=True)
    tables = tabulated(World((card,), (ball,), UNLIT, ambient=0.0))
    view = rendered(tables, (1, 1), (96, 128)).light_field[0, 0]
    assert np.ptp(view, axis=-1).max() < 1e-6, "white in white light has no colour"
    dark = 1 - view[..., 1]
    x, y = picture_points((96, 128))
    dark[np.hypot(x + 0.1, y + 0.1) < 1.2 * radius] = 0
    shift = 4 * radius / 0.61
    assert np.average(x, weights=dark) == pytest.approx(-0.1 + 0.45 * shift, abs=0.004)
    assert np.average(y, weights=dark) == pytest.approx(-0.1 + 0.65 * shift, abs=0.004)
    assert dark.max() == pytest.approx(0.85, abs=0.01)


def test_a_changed_world_is_as_much_deeper_or_further_aside():
    slanted = Card(SMOOTH, quoted(0.5), patch(slice(12, 36), slice(16, 40)), slope_s=quoted(3))
    ball = Ball(0.0, 0.2, quoted(2), 0.05, quoted(0.7), texture=SMOOTH)
    world = World((slanted,), (ball,), UNLIT)

    def disparity_px(changed: World) -> np.ndarray:
        return rendered(tabulated(changed), (1, 1), SIZE_PX).disparity_px

    before = disparity_px(world)
    assert np.ptp(before[16:32, 20:36]) > 0.5
    np.testing.assert_allclose(disparity_px(deepened(world, 1.5)), 1.5 * before, atol=1e-5)
    aside = disparity_px(moved(world, 8 / 64, -4 / 64))
    np.testing.assert_allclose(aside, np.roll(before, (-4, 8), axis=(0, 1)), atol=1e-5)


def test_a_ball_bulges_by_its_depth_like_half_an_ellipsoid(build):
    ball = Ball(0.05, -0.02, quoted(0.2), 0.2, quoted(0.7), texture=SMOOTH)
    name = build(ball, Card(SMOOTH, quoted(-1), PICTURE_PLANE, tiled=True))
    disparity_px = render(name, (5, 5), SIZE_PX).disparity_px
    s, t = picture_points(SIZE_PX)
    height = 1 - ((s - 0.05) ** 2 + (t + 0.02) ** 2) / 0.2**2
    expected = np.where(height > 0, 0.2 + 0.7 * np.sqrt(np.maximum(height, 0)), -1)
    np.testing.assert_allclose(disparity_px, expected, atol=1e-5)


def test_glass_refracts_by_snells_law_in_and_out(build):
    """The kernel's rays against vector refraction written in NumPy, in a view off the axis."""
    radius, depth, back = 0.2, quoted(0.6), quoted(-2.5)
    name = build(
        Ball(0, 0, 0, radius, depth, glass=True, tint=(0.9, 0.8, 0.7)),
        Card(SMOOTH, back, PICTURE_PLANE, tiled=True),
    )
    view = render(name, (5, 5), SIZE_PX).light_field[1, 4]
    to_widths = 5 / 256
    scale = np.array([radius, radius, depth * to_widths])
    x, y = subsampled(SIZE_PX)
    origin = np.stack([x, y, np.zeros_like(x)], axis=-1) / scale
    ray = np.array([2 / 5, -1 / 5, -1.0]) / scale
    ray = np.broadcast_to(ray / np.linalg.norm(ray), origin.shape)

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.sum(a * b, axis=-1, keepdims=True)

    def refracted(ray: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
        across = ratio * (ray - dot(ray, normal) * normal)
        return across - np.sqrt(1 - dot(across, across)) * normal

    along = dot(origin, ray)
    within = along**2 - dot(origin, origin) + 1
    # Rays near the rim leave so flat that they meet the card far outside the picture.
    inside = within[..., 0] > 0.25
    origin, ray, along, within = origin[inside], ray[inside], along[inside], within[inside]
    entry = origin + (-along - np.sqrt(within)) * ray
    bent = refracted(ray, entry, 1 / 1.5)
    leave = entry - 2 * dot(bent, entry) * bent
    out = refracted(bent, -leave, 1.5) * scale
    leave = leave * scale
    hit = leave + (back * to_widths - leave[:, 2:]) / out[:, 2:] * out
    colour = np.full((*inside.shape, 3), np.nan)
    colour[inside] = smooth(hit[:, 0] + 0.5, hit[:, 1] + 0.5) * [0.9, 0.8, 0.7]
    expected = pixel_mean(colour)
    compared = np.isfinite(expected)
    assert np.count_nonzero(compared) > 1000
    np.testing.assert_allclose(view[compared], expected[compared], atol=2e-3)


@pytest.mark.parametrize("gloss", [0.0, 0.3])
def test_a_ball_is_lit_by_lambert_s_law_and_mirrors_more_towards_its_rim(gloss):
    """Schlick's rim, a mirrored room in Lambert's equal-area map, the lamp 1.15 times as bright."""
    grey = np.full_like(SMOOTH, 0.5)
    ball = Ball(0, 0, 0, 0.25, quoted(0.6), texture=grey, gloss=gloss)
    tables = tabulated(World((), (ball,), SMOOTH, ambient=0.0))
    view = rendered(tables, (1, 1), SIZE_PX).light_field[0, 0]
    x, y = (part / 0.25 for part in subsampled(SIZE_PX))
    inside = np.hypot(x, y) < 0.9
    z = np.sqrt(np.where(inside, 1 - x**2 - y**2, 1))
    lamp = np.array([-0.45, -0.65, 0.61]) / np.linalg.norm([-0.45, -0.65, 0.61])
    lit = 0.5 * 1.15 * np.maximum(x * lamp[0] + y * lamp[1] + z * lamp[2], 0)
    mirrored = gloss + (1 - gloss) * (1 - z) ** 5 if gloss else 0 * z
    # The ray straight ahead leaves along (2 z x, 2 z y, 2 z^2 - 1).
    to_map = 0.5 * 2 * z / np.sqrt(2 * 2 * z**2)
    room = smooth(0.5 + to_map * x, 0.5 + to_map * y)
    expected = mirrored[..., None] * room + ((1 - mirrored) * lit)[..., None]
    compared = pixel_mean(inside[..., None].astype(float))[..., 0] == 1
    np.testing.assert_allclose(view[compared], pixel_mean(expected)[compared], atol=2e-3)


@pytest.mark.parametrize("name", SCENES)
def test_a_built_in_scene_is_a_light_field_within_its_quoted_disparities(name):
    scene = render(name, (3, 3), (96, 128))
    assert scene.light_field.shape == (3, 3, 96, 128, 3)
    assert scene.light_field.dtype == scene.disparity_px.dtype == np.float32
    assert scene.light_field.min() >= 0
    assert scene.light_field.max() <= 1
    at_5_views_of_256 = scene.disparity_px * (3 / 5) * (256 / 128)
    low, high = SCENES[name].disparity_px
    margin = 0.1 * (high - low)
    assert low - margin <= at_5_views_of_256.min() <= low + 2.5 * margin
    assert high - 2.5 * margin <= at_5_views_of_256.max() <= high + margin


def test_the_same_seed_gives_the_same_scene_and_another_seed_another():
    first = render("dark", (2, 2), (48, 64), seed=3)
    again = render("dark", (2, 2), (48, 64), seed=3)
    other = render("dark", (2, 2), (48, 64), seed=4)
    np.testing.assert_array_equal(first.light_field, again.light_field)
    np.testing.assert_array_equal(first.disparity_px, again.disparity_px)
    assert psnr_db(other.light_field, first.light_field) < 35


def test_the_dark_scene_is_dark_with_a_few_saturated_samples():
    light_field = render("dark", (2, 2), (192, 256)).light_field
    assert 0.05 < light_field.mean() < 0.2
    assert 1e-5 < np.mean(light_field > 0.999) < 0.02


def test_an_unknown_scene_names_the_nearest_and_lists_all():
    with pytest.raises(SceneError) as error:
        render("deep-oclusion")
    assert "did you mean 'deep-occlusions'?" in str(error.value)
    assert all(name in str(error.value) for name in SCENES)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"size": (15, 64)}, "15x64 pixels: needs 16x16"),
        ({"size": (64, 0)}, "64x0 pixels"),
        ({"views": (0, 5)}, "0x5 views: needs 1x1"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_a_scene_that_cannot_be_rendered_says_why(settings, complaint):
    with pytest.raises(SceneError, match=complaint):
        render("dark", **settings)

"""The mask's shadow: the camera model where nothing is wrong, and derivatives that are its own."""

from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.parametric import psi_at, shot_stages
from emmc_rig.calibration.placement import (
    LEAST_BLUR_UM,
    SCALARS,
    designed_placement,
    labels,
    with_aperture_mean_one,
)
from emmc_rig.calibration.shadow import (
    ANY_COLOUR,
    OF_VIEW,
    TABLE_STEPS,
    Shadow,
    pupil_steps,
    shadow_mask,
    share_tables,
)
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.pupil import Pupil, Rim

SIZE = (16, 22)
VIEWS = (3, 4)


def camera_of(cfa="rggb", binning=1, pattern=None, **more):
    return Camera.model_validate(
        {
            "title": "test",
            "views": VIEWS,
            "sensor": {"cfa": cfa, "binning": binning},
            "masks": {
                "code": {
                    "distance_mm": 0.2,
                    "cell_um": 40,
                    "pattern": pattern or {"kind": "uniform_colour", "seed": 4},
                }
            },
            "shots": [{}, {"offset_um": {"code": [52.0, -31.0]}}],
            **more,
        }
    )


def sharp(camera):
    return replace(designed_placement(camera), blur_um=LEAST_BLUR_UM)


def everywhere(size=SIZE):
    return np.moveaxis(np.mgrid[: size[0], : size[1]], 0, -1).reshape(-1, 2)


@pytest.mark.parametrize(("cfa", "binning"), [("rggb", 1), ("mono", 1), ("rggb", 2), ("mono", 2)])
def test_a_mask_that_sits_as_designed_casts_the_shadow_of_the_camera_model(cfa, binning):
    camera = camera_of(cfa, binning)
    design = build_imaging_matrix(camera, SIZE)
    shadow = Shadow(shadow_mask(camera, SIZE), sharp(camera))
    found = psi_at(shadow, design, shot_stages(camera))
    # The shadow's edges are LEAST_BLUR_UM soft, and its tables are linear between their places.
    assert found.relative_difference(design) < 5e-4


@pytest.mark.parametrize("rim", [None, {"diameter_mm": 17.0, "shift": -6.0}])
def test_behind_pupil_and_rim_the_shadow_is_that_of_the_camera_model(rim):
    camera = camera_of(lens={"pupil": {"diameter_mm": 19.0, "rim": rim}})
    design = build_imaging_matrix(camera, SIZE)
    shadow = Shadow(shadow_mask(camera, SIZE), sharp(camera))
    found = psi_at(shadow, design, shot_stages(camera))
    # Both cut a view into boxes, of other numbers; the camera model's masks have sharp edges.
    assert found.relative_difference(design) < 3e-3


def askew(camera):
    rng = np.random.default_rng(0)
    weights = tuple(tuple(1 + 0.1 * row) for row in rng.standard_normal(VIEWS))
    return replace(
        designed_placement(camera),
        offset_x_um=7.0,
        offset_y_um=-5.0,
        rotation_rad=0.004,
        scale=1.003,
        skew=0.002,
        distance_share=0.1,
        distortion_um=5.0,
        blur_um=4.0,
        clear=0.93,
        leak=0.04,
        vignetting=0.1,
        falloff=-0.2,
        aperture=weights,
    )


ROUND = Pupil(diameter_mm=19.0, centre_mm=(0.5, -0.3))
"""Before the 3 x 4 views of 5 mm: the corners are less than half open, and most views are cut."""
BEHIND_A_RIM = Pupil(diameter_mm=19.0, rim=Rim(diameter_mm=17.0, shift=-6.0))
"""Before pictures of half a millimetre, over which it moves by a view."""
PARAMETERS = [*SCALARS, "aperture_0_0", "aperture_2_1"]


@pytest.mark.parametrize("binning", [1, 2])
@pytest.mark.parametrize(
    ("name", "pupil"),
    [
        (name, pupil)
        for name in PARAMETERS
        for pupil in (None, ROUND, BEHIND_A_RIM)
        if (pupil or "pupil" not in name) and ("rim" not in name or pupil is BEHIND_A_RIM)
    ],
)
def test_derivatives_are_those_of_the_readings(name, pupil, binning):
    camera = camera_of(binning=binning)
    mask, at = shadow_mask(camera, SIZE), replace(askew(camera), pupil=pupil)
    pixels = everywhere(mask.pixel_shape())
    colours = np.arange(len(pixels), dtype=np.uint8) % 4
    open_views = np.random.default_rng(1).random(VIEWS) < 0.6
    place = labels(VIEWS).index(name)
    _, slopes = Shadow(mask, at).with_slopes(pixels, colours, open_views, (12.0, 3.0))
    step = np.zeros(len(at.vector()))
    # A small step would see the tables' interpolation, and the lines that cut a pupil.
    large = {"blur_um": 0.2, **pupil_steps(mask, at)}
    step[place] = large.get(name, 1e-3 * max(abs(at.vector()[place]), 0.01))
    ahead, behind = (
        Shadow(mask, at.moved(sign * step)).readings(pixels, colours, open_views, (12.0, 3.0))
        for sign in (1, -1)
    )
    expected = (ahead - behind) / (2 * step[place])
    error = np.linalg.norm(slopes[:, place] - expected) / np.linalg.norm(expected)
    assert error < 0.01


@pytest.mark.parametrize(
    "stage_um", [(0.0, 0.0), (1500.0, -1400.0)], ids=["whole", "beyond its rim"]
)
def test_what_each_view_adds_to_a_derivative_is_all_of_it(stage_um):
    camera = camera_of()
    shadow = Shadow(shadow_mask(camera, SIZE), askew(camera))
    pixels, colours = everywhere(), np.full(SIZE[0] * SIZE[1], ANY_COLOUR, np.uint8)
    every = np.ones(VIEWS, dtype=bool)
    slopes, by_view = shadow.slopes_by_view(pixels, colours, every, stage_um)
    sums = by_view.reshape(len(pixels), -1, OF_VIEW).sum(axis=1)
    softer = SCALARS.index("blur_um")
    np.testing.assert_allclose(sums[:, :2], slopes[:, :2], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sums[:, 2] + sums[:, 3], slopes[:, softer], rtol=1e-9, atol=1e-12)


def test_a_cut_view_casts_the_shadow_of_its_open_part():
    camera = camera_of(cfa="mono", pattern={"kind": "random_rgbw", "seed": 2})
    even = replace(askew(camera), vignetting=0.0, falloff=0.0, aperture=((1.0,) * 4,) * 3)
    mask, pixels = shadow_mask(camera, SIZE), everywhere()
    channels = np.full(len(pixels), ANY_COLOUR, np.uint8)
    cut = Shadow(mask, replace(even, pupil=ROUND, pupil_x_um=200.0, pupil_share=0.02))
    found = cut.coefficients(pixels, channels)
    # The same by many small whole views, of which those in the disk are open.
    fine = 20
    cell_um = mask.aperture_cell_um / fine
    v_um, u_um = (centred_grid(count * fine, cell_um) for count in VIEWS)
    inside = np.hypot(v_um[:, None] + 300.0, u_um - 700.0) < 9500.0 * 1.02
    points = replace(
        mask, views=inside.shape, aperture_cell_um=cell_um, aperture_um=cell_um
    )  # fmt: skip
    rows = tuple(tuple(map(float, row)) for row in inside)
    every = Shadow(points, replace(even, aperture=rows)).coefficients(pixels, channels)
    expected = every.reshape(len(pixels), 3, fine, 4, fine).sum(axis=(2, 4))
    opened = inside.reshape(3, fine, 4, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(cut.opened, opened, atol=5e-3)
    assert (cut.opened < 0.5).any()
    for light, by_rays in ((found, expected), (found / cut.opened, expected / opened)):
        off = np.linalg.norm(light - by_rays) / np.linalg.norm(by_rays)
        assert off < 4e-3


def test_brightness_of_the_whole_aperture_cancels_against_the_reference():
    camera = camera_of()
    mask, at = shadow_mask(camera, SIZE), askew(camera)
    pixels, colours = everywhere(), np.zeros(SIZE[0] * SIZE[1], np.uint8)
    every = np.ones(VIEWS, dtype=bool)
    brighter = replace(at, aperture=tuple(tuple(3 * w for w in row) for row in at.aperture))
    read = Shadow(mask, at).readings(pixels, colours, every)
    np.testing.assert_allclose(read, Shadow(mask, brighter).readings(pixels, colours, every))
    normal = with_aperture_mean_one(brighter)
    assert np.mean(normal.aperture) == pytest.approx(1)


@pytest.mark.parametrize("blur_um", [0.3, 3.0, 12.0])
def test_the_shares_of_the_cells_sum_to_one_and_their_derivatives_to_none(blur_um):
    camera = camera_of()
    mask = shadow_mask(camera, SIZE)
    tables, reach = share_tables(mask, replace(designed_placement(camera), blur_um=blur_um))
    tables = tables[:, 0]
    np.testing.assert_allclose(tables[0].sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(tables[1:].sum(axis=2), 0, atol=1e-6)
    assert (tables[0] > -1e-9).all()
    # The same by brute force: three kernels convolved on a fine grid, centred at the reach.
    grain = 5e-4
    grid = np.arange(-2.5, 2.5, grain)
    ratio = mask.distance_um / mask.lens_um
    widths = (1 - ratio) * mask.pixel_um / mask.cell_um, ratio * mask.aperture_um / mask.cell_um
    density = np.exp(-0.5 * (grid / (blur_um / mask.cell_um)) ** 2)
    for width in widths:
        density = np.convolve(density, np.abs(grid) <= width / 2, mode="same")
    density /= density.sum()
    for place in (0, 100, 200):
        at = grid + reach + place / TABLE_STEPS
        shares, _ = np.histogram(at, np.arange(tables.shape[2] + 1), weights=density)
        np.testing.assert_allclose(tables[0][place], shares, atol=2e-3)


def test_a_camera_without_one_mask_before_its_sensor_is_sent_to_method_free():
    camera = camera_of(masks={}, shots=[{}])
    with pytest.raises(CalibrationError, match="0 masks: use method free"):
        shadow_mask(camera, SIZE)

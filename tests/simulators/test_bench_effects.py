"""What can be wrong with the simulated bench, each against its own optics; Psi by integration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import erf, fresnel

from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.compiling import njit
from emmc_rig.model.noise import SensorNoise
from emmc_rig.simulators.bench import NO_ERRORS, Bench, MaskRow, _find_cells, _met
from emmc_rig.simulators.flaws import BoardFlaws, LampFlaws, OpticsFlaws, SensorFlaws, diffracted

SIZE = (12, 18)
LENS_UM, DISTANCE_UM = 50_000.0, 400.0
CAMERA = Camera.model_validate(
    {
        "title": "test",
        "views": [3, 3],
        "sensor": {"cfa": "rggb"},
        "masks": {"code": {"distance_mm": 0.3, "cell_um": 40, "pattern": {"kind": "random_rgbw"}}},
    }
)
OPEN = {"mask_x": 0.0, "mask_y": 0.0, "aperture_x": 1e5, "aperture_y": 0.0}


def bench_of(errors=NO_ERRORS, rays=256, at_um=OPEN, seconds=0.0, **flaws):
    scene = np.ones((3, 3, *SIZE, 3), np.float32)
    bench = Bench(
        CAMERA, scene, SIZE, lambda: at_um, 1e5, np.random.default_rng(0), errors, rays,
        seconds=lambda: seconds, **flaws,
    )  # fmt: skip
    bench.target, bench.lamp = "whiteboard", "white"
    return bench


def own_colour(psi, colour):
    return np.take_along_axis(psi, colour[0][None, None, :, None, :].astype(int), axis=3)


def test_psi_by_integration_is_the_imaging_matrix_of_a_perfect_bench():
    design = build_imaging_matrix(CAMERA, SIZE)
    true = bench_of(rays=1024).true_psi(0)
    found = own_colour(true, design.colour)
    off = np.linalg.norm(found - design.weights[0]) / np.linalg.norm(design.weights)
    assert off < 0.01
    assert np.count_nonzero(true) == np.count_nonzero(found)


def test_true_coefficients_sum_to_the_open_whiteboard_whatever_is_wrong_with_the_optics():
    errors = replace(NO_ERRORS, tilt_deg=(0.5, -0.3), bow_um=12.0, substrate_um=150.0)
    optics = OpticsFlaws(0.05, 1.0, microlens_power=6.0, chief_ray_error=0.4)
    bench = bench_of(errors, optics=optics)
    open_board = bench.readings()
    bench.masks_in = False
    white = bench.readings()
    bench.masks_in = True
    np.testing.assert_allclose(bench.true_psi(0).sum(axis=(0, 1, 3)), open_board / white, rtol=2e-6)


def test_psi_by_integration_knows_neither_lamp_nor_board_nor_sensor():
    plain = bench_of().true_psi(0)
    other = bench_of(
        board=BoardFlaws(0.2, 0.3, 2.0), lamp=LampFlaws(0.1, 0.05),
        sensor=SensorFlaws(response_spread=0.1), seconds=100.0,
    )  # fmt: skip
    np.testing.assert_array_equal(other.true_psi(0), plain)


def test_crosstalk_gives_neighbouring_colours_their_share():
    psi = bench_of(sensor=SensorFlaws(crosstalk=0.1)).true_psi(0)
    bench = bench_of(sensor=SensorFlaws(crosstalk=0.1))
    bench.masks_in, bench.lamp = False, "green"
    assert bench.readings()[0, 0] == pytest.approx(0.1, rel=1e-5)
    assert (psi[:, :, 0, 1, 0] <= 0.1 / 9 + 1e-6).all()


def snell(x, u, thickness, index):
    """Where the ray from x to u leaves glass that lies on the sensor, by Snell's law alone."""

    def missed(sine):
        inside = sine / index
        above = (LENS_UM - thickness) * sine / np.sqrt(1 - sine**2)
        return thickness * inside / np.sqrt(1 - inside**2) + above - (u - x)

    sine = float(brentq(missed, -0.9, 0.9, xtol=1e-14))  # type: ignore[arg-type]
    inside = sine / index
    below = thickness * inside / np.sqrt(1 - inside**2)
    return x + below + (DISTANCE_UM - thickness) * sine / np.sqrt(1 - sine**2)


def test_glass_bends_rays_by_snells_law():
    for x, u in ((0.0, 9_000.0), (2_500.0, -12_000.0)):
        found = _met.py_func(x, 0.0, u, 0.0, LENS_UM, DISTANCE_UM, 0.0, 0.0, 0.0, 300.0, 1.52)
        assert found[0] == pytest.approx(snell(x, u, 300.0, 1.52), abs=1e-4)
        assert found[1] == 0


def test_a_tilted_mask_is_met_where_the_ray_crosses_its_plane():
    x, u, slope = 2_000.0, -8_000.0, np.tan(np.deg2rad(1.0))
    to = (u - x) / LENS_UM
    # x + to z with z = d + slope (x + to z)
    z = (DISTANCE_UM + slope * x) / (1 - slope * to)
    found = _met.py_func(x, 0.0, u, 0.0, LENS_UM, DISTANCE_UM, slope, 0.0, 0.0, 0.0, 1.52)
    assert found[0] == pytest.approx(x + to * z, abs=1e-3)


THIN_AND_FLAT = MaskRow(
    DISTANCE_UM, x_um=3.0, y_um=-5.0, column_per_x=2.0, column_per_y=0.1, row_per_x=-0.1,
    row_per_y=2.0, bend_per_um2=0.0, edge_um=2.0, slope_x=0.0, slope_y=0.0, sag_per_um=0.0,
    glass_um=0.0, index=1.52,
)  # fmt: skip


@njit
def find_cells(place, plate, shape, first_x, ray_y, ray_u, ray_v, blur_x, blur_y, pitch_um):
    _find_cells(
        place, plate, 1, shape, first_x, ray_y, ray_u, ray_v, blur_x, blur_y, LENS_UM, pitch_um
    )


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"bend_per_um2": 4e-6},
        {"slope_x": 0.3, "slope_y": -0.2, "sag_per_um": 1e-3},
        {"glass_um": 150.0, "bend_per_um2": -4e-6},
    ],
)
def test_a_row_of_rays_finds_the_cells_where_each_ray_meets_the_mask(changes):
    mask, rows, columns, pitch_um = THIN_AND_FLAT._replace(**changes), 600, 800, 4.0
    first_x, ray_y, ray_u, ray_v, blur_x, blur_y = -80.0, 50.0, 900.0, -700.0, 1.5, -0.5
    place, shape = np.empty(40, np.int64), np.array([rows, columns])
    ray = first_x, ray_y, ray_u, ray_v, blur_x, blur_y
    find_cells(place, np.array(mask), shape, *ray, pitch_um)
    for x, found in enumerate(place):
        at = np.array([first_x + x * pitch_um, ray_y])
        met = np.array(_met.py_func(*at, ray_u, ray_v, LENS_UM, mask.distance_um, *mask[9:]))
        met += mask.bend_per_um2 * (at @ at) * at - [mask.x_um, mask.y_um]
        met += mask.edge_um * np.array([blur_x, blur_y])
        column = np.floor(met @ [mask.column_per_x, mask.column_per_y] + columns / 2)
        row = np.floor(met @ [mask.row_per_x, mask.row_per_y] + rows / 2)
        assert found == 1 + row * columns + column


def test_an_edge_diffracts_as_fresnel_integrals_say():
    grain_um, distance_um, wavelength_um = 2.0, 2_000.0, 0.55
    edge = np.zeros((8, 4000), np.float32)
    edge[:, 2000:] = 1
    found = diffracted(edge, grain_um, distance_um, wavelength_um)[4, 1900:2100]
    # Samples stand for cells: the edge lies half a grain before the first that is open.
    x_um = (np.arange(-100, 100) + 0.5) * grain_um
    s, c = fresnel(x_um * np.sqrt(2 / (wavelength_um * distance_um)))
    expected = 0.5 * ((0.5 + c) ** 2 + (0.5 + s) ** 2)
    np.testing.assert_allclose(found, expected, atol=0.03)
    assert found.max() == pytest.approx(1.37, abs=0.02)


def test_light_falls_off_by_the_fourth_power_of_the_cosine():
    falls = OpticsFlaws(vignetting=1.0).falloff((5, 9), (3, 3), (50_000.0, 2_000.0, 5_000.0))
    # The view at (v, u) = (-5, 5) mm at the lens, from the pixel at (y, x) = (4, -8) mm.
    slope2 = ((4 + 5) ** 2 + (-8 - 5) ** 2) / 50**2
    assert falls[0, 2, 4, 0] == pytest.approx((1 + slope2) ** -2)
    assert falls[1, 1, 2, 4] == 1


def test_a_microlens_sees_the_light_along_its_axis_best():
    flaws = OpticsFlaws(microlens_power=8.0, chief_ray_error=0.5)
    falls = flaws.falloff((5, 9), (3, 3), (50_000.0, 2_000.0, 5_000.0))
    # Half the chief ray's slope missed: at x = 8 mm the axis meets the lens at 4 mm, not at 0.
    assert falls[1, 2, 2, 8] == pytest.approx((1 + (1 / 50) ** 2) ** -4)
    assert falls[0, 1, 0, 4] == pytest.approx((1 + (3 / 50) ** 2) ** -4)
    np.testing.assert_allclose(falls, falls[::-1, ::-1, ::-1, ::-1])


def test_open_and_closed_cells_pass_their_shares_and_dust_dims_its_disc():
    cells = np.ones((30, 30, 3), np.float32)
    cells[:, 15:] = 0
    plain, side_um = OpticsFlaws(clear=0.9, leak=0.1).soiled(cells, 36.0, 300.0)
    assert side_um == 36
    np.testing.assert_allclose(plain, np.where(cells > 0, 0.9, 0.1), rtol=1e-6)
    dusty = OpticsFlaws(dust_specks=1, dust_radius_um=(50.0, 50.0), dust_transmittance=0.25)
    fine, side_um = dusty.soiled(np.ones((30, 30, 3), np.float32), 36.0, 300.0)
    assert side_um == 6
    specks = fine[..., 0] == 0.25
    assert ((fine[..., 0] == 1) | specks).all()
    assert specks.sum() * 6**2 == pytest.approx(np.pi * 50**2, rel=0.05)


def test_a_blurred_edge_is_the_integral_of_a_normal_distribution():
    cells = np.zeros((4, 8, 3), np.float32)
    cells[:, 4:] = 1
    fine, side_um = OpticsFlaws(colour_blur_um=(0.0, 12.0, 0.0)).soiled(cells, 36.0, 300.0)
    x_um = (np.arange(48) + 0.5 - 24) * side_um
    np.testing.assert_array_equal(fine[0, :, 0], x_um > 0)
    np.testing.assert_allclose(fine[0, :, 1], (1 + erf(x_um / 12 / 2**0.5)) / 2, atol=0.01)


NOISE = SensorNoise(
    electrons_per_s=1e5, gain_dn_per_electron=0.5, read_noise_electrons=2.0, black_level_dn=100
)


def electrons(flaws, reading=0.0, exposure_s=1.0, seconds=0.0):
    """A frame (y, x) of an evenly lit sensor, in electrons above black."""
    lit = np.full((200, 200), reading)
    frame = flaws.expose_dn(NOISE, lit, exposure_s, 1.0, np.random.default_rng(0), seconds)
    return (frame - 100.0) / 0.5


def test_dark_current_collects_with_time_and_doubles_every_6_5_kelvin():
    warming = SensorFlaws(dark_electrons_per_s=10_000.0, warming_k=6.5)
    for seconds, times in ((0.0, 1.0), (120.0, 2 ** (1 - np.exp(-1))), (1e6, 2.0)):
        collected = electrons(warming, exposure_s=0.5, seconds=seconds)
        assert collected.mean() == pytest.approx(5_000 * times, rel=1e-3)
        assert collected.var() == pytest.approx(5_000 * times, rel=0.05)


def test_hot_pixels_collect_without_light_and_dead_ones_hardly_any():
    flaws = SensorFlaws(bad_share=0.1)
    hot, dead = flaws.bad((200, 200))
    assert (hot.mean(), dead.mean()) == pytest.approx((0.05, 0.05), abs=0.005)
    seen = electrons(flaws, reading=1.0, exposure_s=0.1)
    assert seen[hot].mean() == pytest.approx(10_000 + 40_000, rel=0.01)
    assert seen[dead].mean() == pytest.approx(0.02 * 10_000, rel=0.01)
    assert seen[~hot & ~dead].mean() == pytest.approx(10_000, rel=0.01)


def test_a_full_well_holds_no_more_and_the_response_bends_towards_it():
    flaws = SensorFlaws(full_well_electrons=80_000.0, bend=0.1)
    # A tenth is lost at full well, a twentieth at half.
    assert electrons(flaws, reading=2.0).mean() == pytest.approx(72_000, rel=1e-4)
    assert electrons(flaws, reading=0.4).mean() == pytest.approx(38_000, rel=1e-3)


def test_pixels_differ_in_response_and_black_and_rows_in_their_noise():
    uneven = electrons(SensorFlaws(response_spread=0.05), reading=0.5)
    assert uneven.var() == pytest.approx((0.05 * 50_000) ** 2 + 50_000, rel=0.05)
    black = electrons(SensorFlaws(offset_spread_dn=10.0))
    assert black.var() == pytest.approx((10 / 0.5) ** 2 + 2**2, rel=0.05)
    rows = electrons(SensorFlaws(row_noise_electrons=50.0), reading=0.01)
    assert rows.mean(axis=1).std() == pytest.approx(50, rel=0.15)
    assert rows.mean(axis=0).std() < 5


def test_filters_pass_their_share_of_the_neighbouring_colours_and_open_pixels_all():
    mixed = SensorFlaws(crosstalk=0.1).mixed(np.eye(3, dtype=np.float32))
    np.testing.assert_allclose(mixed, [[0.9, 0.1, 0], [0.05, 0.9, 0.05], [0, 0.1, 0.9]])
    white = np.ones((1, 3), np.float32)
    np.testing.assert_array_equal(SensorFlaws(crosstalk=0.1).mixed(white), white)


def test_a_board_out_of_focus_is_seen_shifted_by_its_parallax():
    seen = BoardFlaws(place_spread=0.2, parallax_px=3.0).radiance((12, 18), (5, 5), 0.0)
    np.testing.assert_allclose(seen[4, 2, :-3], seen[2, 2, 3:], rtol=1e-6)
    np.testing.assert_allclose(seen[2, 0, :, 3:], seen[2, 2, :, :-3], rtol=1e-6)
    assert np.ptp(seen[2, 2]) > 0.1


def test_a_turned_board_turns_its_unevenness_and_keeps_its_mean():
    flaws = BoardFlaws(angle_spread=0.1)
    upright, turned = (flaws.radiance(SIZE, (5, 5), turn)[:, :, 0, 0] for turn in (0.0, 90.0))
    assert upright.mean() == pytest.approx(1, abs=1e-6)
    assert np.ptp(upright) == pytest.approx(0.1, rel=0.3)
    np.testing.assert_allclose(turned, np.rot90(upright, -1), atol=1e-6)


def test_the_lamp_warms_up_and_its_colours_drift_apart():
    cold, warm = (bench_of(seconds=s, lamp=LampFlaws(0.02, 0.01)) for s in (0.0, 1e6))
    for bench in (cold, warm):
        bench.masks_in = False
    ratio = warm.readings() / cold.readings()
    assert ratio[0, 0] == pytest.approx(1.03, rel=1e-4)
    assert ratio[1, 1] == pytest.approx(1.01, rel=1e-4)
    warming = LampFlaws(0.02, 0.01).levels(120.0)
    np.testing.assert_allclose(warming, 1 + (1 - np.exp(-1)) * np.array([0.03, 0.02, 0.01]))


def test_glare_lifts_black_before_the_filters_by_colour_and_behind_them_by_all():
    plain, before, after = (
        bench_of(optics=flaws).true_psi(0)
        for flaws in (OpticsFlaws(), OpticsFlaws(glare=0.01), OpticsFlaws(glare_after=0.01))
    )
    own = own_colour(np.ones_like(plain), bench_of()._response[0].argmax(-1)[None]) > 0
    assert own.all()
    lifted = before - 0.99 * plain
    assert lifted.sum((0, 1)).max() < 0.011
    assert before.sum(axis=3) == pytest.approx(before.max(axis=3))
    # Behind the filters pixels see colours that theirs do not pass.
    assert (after > 0).sum() > 2.5 * (plain > 0).sum()


def test_a_turned_plate_moves_its_pinhole_about_the_axis_and_a_mask_creeps():
    at_um = {"mask_x": 1.0, "mask_y": 0.0, "aperture_x": 3000.0, "aperture_y": 0.0}
    found = OpticsFlaws(plate_turn_deg=2.0, creep_um_per_s=0.1, warming_um=100.0).moved(at_um, 60.0)
    assert found["aperture_y"] == pytest.approx(3000 * np.sin(np.deg2rad(2.0)))
    assert found["mask_x"] == pytest.approx(7.0)
    assert found["lens"] == pytest.approx(100 * (1 - np.exp(-0.5)))


def test_a_hole_passes_light_by_its_area():
    optics = OpticsFlaws(hole_spread=0.2)
    at_um = {**OPEN, "aperture_x": 0.0}
    plain, spread = (
        bench_of(at_um=at_um, rays=4096, optics=how) for how in (OpticsFlaws(), optics)
    )
    for bench in (plain, spread):
        bench.masks_in = False
    area = optics.hole_areas(CAMERA.views)[1, 1]
    assert spread.readings().mean() / plain.readings().mean() == pytest.approx(area, rel=0.02)


def test_odd_columns_are_brighter_by_their_gain_and_offset():
    odd = SensorFlaws(odd_gain=0.1, odd_dn=5.0)
    noise = SensorNoise()
    light, dark = (
        odd.expose_dn(noise, np.full((40, 40), level), 0.1, 1.0, np.random.default_rng(0)).astype(
            float
        )
        for level in (0.5, 0.0)
    )
    assert np.diff([dark[:, k::2].mean() for k in (0, 1)])[0] == pytest.approx(5.0, abs=1.0)
    above = [(light - dark)[:, k::2].mean() for k in (0, 1)]
    assert above[1] / above[0] == pytest.approx(1.1, rel=0.02)

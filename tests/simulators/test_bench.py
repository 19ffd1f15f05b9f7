"""The simulated bench follows its own rays, and agrees with the camera model in the limit."""

import numpy as np
import pytest
from scipy.stats.qmc import Sobol

from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.masks import CFA
from emmc_rig.model.pupil import Pupil
from emmc_rig.simulators.bench import NO_ERRORS, Bench, MountingErrors, lens_points_um, ray_points
from emmc_rig.simulators.flaws import OpticsFlaws
from emmc_rig.simulators.sobol import AXES, sobol_points

SIZE = (12, 18)
CENTRED = {"mask_x": 0.0, "mask_y": 0.0, "aperture_x": 0.0, "aperture_y": 0.0}
WINDOW_UM = 50_000.0
OPEN = {**CENTRED, "aperture_x": WINDOW_UM}
WARM_MASK = {
    "code": {"distance_mm": 0.2, "cell_um": 40, "pattern": {"kind": "uniform_colour", "seed": 4}}
}


def coded(cfa="rggb", binning=1, masks=None, shots=({},)):
    return Camera.model_validate(
        {
            "title": "test",
            "sensor": {"cfa": cfa, "binning": binning},
            "masks": WARM_MASK if masks is None else masks,
            "shots": list(shots),
        }
    )


def light_field(seed=0, size=SIZE, views=(5, 5)):
    return np.random.default_rng(seed).random((*views, *size, 3)).astype(np.float32)


def bench_for(camera, scene, at_um, errors=NO_ERRORS, rays=1024, size=SIZE):
    rng = np.random.default_rng(0)
    bench = Bench(camera, scene, size, lambda: at_um, WINDOW_UM, rng, errors, rays)
    bench.lamp = "white"
    return bench


def relative_error(found, expected):
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("cfa", list(CFA))
def test_an_open_camera_reads_one_from_a_whiteboard(cfa):
    bench = bench_for(coded(cfa, masks={}), light_field(), OPEN, rays=16)
    bench.target = "whiteboard"
    np.testing.assert_allclose(bench.readings(), 1, rtol=1e-6)


@pytest.mark.parametrize(
    ("cfa", "binning"), [("rggb", 1), ("mono", 1), ("mono", 2), ("x-trans", 1)]
)
def test_rays_through_one_mask_sum_to_the_imaging_matrix(cfa, binning):
    camera, scene = coded(cfa, binning), light_field()
    expected = build_imaging_matrix(camera, SIZE).forward(scene)[0]
    assert relative_error(bench_for(camera, scene, OPEN).readings(), expected) < 3e-3


def test_rays_through_two_masks_sum_to_the_imaging_matrix():
    masks = {
        **WARM_MASK,
        "far": {
            "distance_mm": 25,
            "cell_um": 3000,
            "pattern": {"kind": "uniform_colour", "seed": 9},
        },
    }
    camera, scene = coded(masks=masks), light_field()
    expected = build_imaging_matrix(camera, SIZE).forward(scene)[0]
    assert relative_error(bench_for(camera, scene, OPEN).readings(), expected) < 5e-3


def test_the_pinhole_shows_one_view_only():
    camera = coded()
    psi = build_imaging_matrix(camera, SIZE)
    at_um = {**CENTRED, "aperture_x": -10_000.0, "aperture_y": 5_000.0}
    bench = bench_for(camera, light_field(), at_um)
    bench.target = "whiteboard"
    assert relative_error(bench.readings(), psi.weights[0, 3, 0, :, 0, :]) < 1e-2


def test_a_plate_between_pinhole_and_window_blocks_the_light():
    at_um = {**CENTRED, "aperture_x": 0.4 * WINDOW_UM}
    bench = bench_for(coded(), light_field(), at_um, rays=16)
    assert not bench.readings().any()


def test_the_lamp_colour_lights_its_own_pixels_only():
    bench = bench_for(coded("rggb", masks={}), light_field(), OPEN, rays=16)
    bench.target, bench.lamp = "whiteboard", "blue"
    readings = bench.readings()
    np.testing.assert_allclose(readings[1::2, 1::2], 1, rtol=1e-6)
    assert not readings[::2].any()
    assert not readings[1::2, ::2].any()


@pytest.mark.parametrize(
    ("at_um", "errors"),
    [
        (OPEN, MountingErrors((30.0, -17.0), 0.0, 1.0)),
        ({**OPEN, "mask_x": 30.0, "mask_y": -17.0}, NO_ERRORS),
    ],
)
def test_a_misplaced_mask_and_one_that_the_stage_moved_read_as_the_imaging_matrix(at_um, errors):
    camera = coded(shots=[{"offset_um": {"code": [30.0, -17.0]}}])
    expected = build_imaging_matrix(camera, SIZE).forward(light_field())[0]
    found = bench_for(camera, light_field(), at_um, errors).readings()
    assert relative_error(found, expected) < 3e-3


@pytest.mark.parametrize("skew", [0.0, 0.25])
def test_a_mask_turned_by_a_right_angle_turns_its_shadow(skew):
    """A mask's cells are the columns x + skew y and the rows y, both turned with the mask."""
    camera, size = coded("mono"), (24, 24)

    def shadow(turn_deg):
        errors = MountingErrors((0.0, 0.0), turn_deg, 1.0, skew=skew)
        bench = bench_for(camera, light_field(size=size), OPEN, errors, size=size)
        bench.target = "whiteboard"
        return bench.readings()

    upright = shadow(0.0)
    assert relative_error(shadow(90.0), np.rot90(upright, -1)) < 5e-3
    assert relative_error(np.rot90(upright), upright) > 0.1


def test_a_mask_s_columns_lean_by_its_skew():
    """By half a pixel a row, with skew 1/2: each two rows shift the stripes by a whole one."""
    stripes = {"kind": "tile", "cells": [[1, 0]]}
    mask = {"code": {"distance_mm": 0.02, "cell_um": 96, "pattern": stripes}}
    camera, size = coded("mono", masks=mask), (16, 24)
    errors = MountingErrors((0.0, 0.0), 0.0, 1.0, skew=0.5)
    bench = bench_for(camera, light_field(size=size), OPEN, errors, size=size)
    bench.target = "whiteboard"
    readings = bench.readings()
    np.testing.assert_allclose(readings[2:, :-1], readings[:-2, 1:], atol=0.01)
    assert np.ptp(readings) > 0.9


@pytest.mark.parametrize(("finer", "focus_um"), [(1, 100.0), (2, 50.0)])
def test_out_of_focus_every_view_moves_by_its_steps_from_the_middle(finer, focus_um):
    """A hundredth of a sample per um and view: here one sample of the scene, however fine."""
    camera = coded("mono", masks={})
    scene = light_field(size=(finer * SIZE[0], finer * SIZE[1]))
    moved = scene.copy()
    for v, u in np.ndindex(5, 5):
        moved[v, u] = np.roll(scene[v, u], (v - 2, u - 2), axis=(0, 1))
    found = bench_for(camera, scene, {**OPEN, "focus": focus_um}).readings()
    expected = bench_for(camera, moved, OPEN).readings()
    np.testing.assert_allclose(found[2:-2, 2:-2], expected[2:-2, 2:-2], rtol=1e-5)


def test_a_finer_scene_whose_blocks_average_to_the_light_field_reads_nearly_the_same():
    scene = light_field()
    fine = scene.repeat(2, axis=2).repeat(2, axis=3).repeat(2, axis=0).repeat(2, axis=1)
    coarse = bench_for(coded(), scene, OPEN).readings()
    np.testing.assert_allclose(bench_for(coded(), fine, OPEN).readings(), coarse, rtol=1e-9)


def test_a_scene_that_is_no_finer_grid_is_refused():
    with pytest.raises(ValueError, match="no finer grid"):
        bench_for(coded(), light_field(size=(13, 18)), OPEN)


def test_a_frame_has_the_noise_of_its_exposure():
    camera = coded(masks={})
    bench = bench_for(camera, light_field(), OPEN, rays=16)
    bench.target = "whiteboard"
    noise = camera.sensor.noise
    frames = np.array([bench.expose(0.01) for _ in range(200)], dtype=float)
    electrons = noise.electrons_per_s * 0.01
    expected = noise.gain_dn_per_electron**2 * (electrons + noise.read_noise_electrons**2) + 1 / 12
    assert frames.var(axis=0, ddof=1).mean() == pytest.approx(expected, rel=0.03)
    assert frames.mean() == pytest.approx(
        noise.black_level_dn + noise.gain_dn_per_electron * electrons, rel=1e-3
    )


def test_rays_meet_the_lens_in_the_open_part_of_their_aperture_cell():
    points = ray_points((2, 3), 64)
    at_um = lens_points_um(points, 1000.0, 0.8)
    assert at_um.shape == (2, 3, 64, 2)
    middles_um = np.array([[[-1000, -500], [0, -500], [1000, -500]],
                           [[-1000, 500], [0, 500], [1000, 500]]])  # fmt: skip
    away_um = at_um - middles_um[:, :, np.newaxis]
    assert 380 < np.abs(away_um).max() <= 400
    np.testing.assert_allclose(away_um[1, 2, :, 0], 800 * (points[1, 2, :, 2] - 0.5), atol=1e-9)


@pytest.mark.parametrize("axes", range(1, AXES + 1))
@pytest.mark.parametrize("count", [1, 2, 8, 128])
def test_sobol_points_are_those_of_scipy(count, axes):
    theirs = Sobol(axes, rng=np.random.default_rng(5)).random(count)
    ours = sobol_points(count, axes, np.random.default_rng(5))
    np.testing.assert_array_equal(ours, theirs)


PUPILS = {
    "round": {"diameter_mm": 25},
    "decentred": {"diameter_mm": 22, "centre_mm": [1.2, -0.7]},
    "blades": {"shape": "polygon", "blades": 5, "diameter_mm": 27, "turn_deg": 11},
    "square": {"shape": "square", "diameter_mm": 21, "turn_deg": 20},
    "behind a rim": {"diameter_mm": 25, "rim": {"diameter_mm": 24, "shift": -20}},
}


@pytest.mark.parametrize("name", PUPILS)
def test_rays_inside_the_pupil_sum_to_its_imaging_matrix(name):
    camera, scene = coded(), light_field()
    lens = camera.lens.model_copy(update={"pupil": Pupil.model_validate(PUPILS[name])})
    camera = camera.model_copy(update={"lens": lens})
    psi = build_imaging_matrix(camera, SIZE)
    bench = bench_for(camera, scene, OPEN)
    true = bench.true_psi(0).sum(axis=3)  # pixels see one colour
    assert relative_error(true, psi.weights[0, :, :, :, 0]) < 1e-2
    coded_readings = bench.readings()
    bench.target, bench.masks_in = "whiteboard", False
    open_board = bench.readings()
    # The light that the pupil stops is lost.
    pupil = camera.lens.pupil
    assert pupil is not None
    if pupil.rim is None:
        assert open_board.mean() == pytest.approx(camera.view_shares().mean(), rel=2e-3)
    assert relative_error(coded_readings / open_board, psi.forward(scene)[0]) < 4e-3


def test_the_real_pupil_of_a_bench_need_not_be_the_described_one():
    pupil = Pupil(diameter_mm=20)
    bench = Bench(
        coded(masks={}), light_field(), SIZE, lambda: OPEN, WINDOW_UM, np.random.default_rng(0),
        optics=OpticsFlaws(pupil=pupil),
    )  # fmt: skip
    bench.lamp, bench.target = "white", "whiteboard"
    np.testing.assert_allclose(bench.readings(), np.pi * 10**2 / 25**2, rtol=1e-2)

"""Geometry: where rays meet masks, against closed forms and against rays traced one by one."""

import numpy as np
import pytest

from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.errors import CameraError
from emmc_rig.model.geometry import (
    CellWeights,
    Footprint,
    cell_weights,
    centred_grid,
    fresnel_number,
    mask_position,
)

LENS_MM = 50.0
APERTURE_CELL_MM = 5.0
PITCH_UM = 24.0


def camera(distance_mm, cell_um, pattern, views=(3, 3), aperture_fill=1.0, pixel_fill=1.0):
    return Camera.model_validate(
        {
            "title": "one mask",
            "views": views,
            "lens": {
                "distance_mm": LENS_MM,
                "aperture_cell_mm": APERTURE_CELL_MM,
                "aperture_fill": aperture_fill,
            },
            "sensor": {"sample_pitch_um": PITCH_UM, "pixel_fill": pixel_fill},
            "masks": {"m": {"distance_mm": distance_mm, "cell_um": cell_um, "pattern": pattern}},
        }
    )


def transmittance(described, size):
    """Return what every view's rays pass, (v, u, y, x), of a monochrome camera with grey masks."""
    psi = build_imaging_matrix(described, size)
    views_v, views_u = described.views
    return psi.weights[0].sum(axis=-2) * views_v * views_u


def grey_cells(line, rows):
    """Return a mask of `rows` equal rows of cells."""
    return {"kind": "parameters", "cells": [[float(value) for value in line]] * rows}


def traced_weights(x_um, u_um, pixel_um, aperture_um, distance_um, lens_um, cell_um, cells, rays):
    """Return the share of the rays between a pixel and an aperture cell through every mask cell.

    Every ray is a straight line from (x, 0) to (u, D), cut at height d.
    """
    steps = (np.arange(rays) + 0.5) / rays - 0.5
    x = x_um + pixel_um * steps[:, None]
    u = u_um + aperture_um * steps[None, :]
    slope = (u - x) / lens_um
    met = (x + slope * distance_um).ravel()
    index = np.floor(met / cell_um + cells / 2).astype(int)
    return np.bincount(index, minlength=cells) / met.size


def test_a_grid_is_centred_and_equally_spaced():
    np.testing.assert_allclose(centred_grid(4, 2.0), [-3, -1, 1, 3])
    np.testing.assert_allclose(centred_grid(3, 5.0), [-5, 0, 5])
    np.testing.assert_allclose(centred_grid(1, 7.0), [0])


@pytest.mark.parametrize("distance", [0.0, 0.3, 25.0, 50.0])
def test_a_ray_meets_the_mask_on_the_straight_line_from_sensor_to_lens(distance):
    x, u = np.meshgrid(centred_grid(5, 0.7), centred_grid(4, 3.0))
    slope = (u - x) / LENS_MM
    np.testing.assert_allclose(
        mask_position(x, u, distance, LENS_MM), x + slope * distance, atol=1e-12
    )


def test_every_view_sees_the_same_of_a_mask_in_contact():
    seen = transmittance(camera(0.0, PITCH_UM, {"kind": "random_binary", "seed": 3}), (8, 10))
    assert set(np.unique(seen.round(6))) == {0.0, 1.0}
    np.testing.assert_allclose(seen, np.broadcast_to(seen[:1, :1], seen.shape), atol=1e-6)


def test_a_view_sees_one_value_of_a_mask_at_the_lens():
    cells = np.arange(1, 10).reshape(3, 3) / 10
    pattern = {"kind": "parameters", "cells": cells.tolist()}
    seen = transmittance(camera(LENS_MM, APERTURE_CELL_MM * 1e3, pattern), (6, 8))
    np.testing.assert_allclose(seen, np.broadcast_to(cells[:, :, None, None], seen.shape), 1e-6)


@pytest.mark.parametrize("distance_mm", [0.24, 2.0, 20.0])
def test_the_penumbra_of_an_edge_is_as_wide_as_the_aperture_seen_from_the_mask(distance_mm):
    ratio = distance_mm / LENS_MM
    described = camera(distance_mm, 1e5, grey_cells([0, 1], 2), pixel_fill=0.0)
    seen = transmittance(described, (1, 300))
    width_um = ratio * APERTURE_CELL_MM * 1e3
    for u, lens_um in enumerate(centred_grid(3, APERTURE_CELL_MM * 1e3)):
        met_um = (1 - ratio) * centred_grid(300, PITCH_UM) + ratio * lens_um
        np.testing.assert_allclose(seen[0, u, 0], np.clip(met_um / width_um + 0.5, 0, 1), atol=1e-6)
        inside = (seen[0, u, 0] > 1e-6) & (seen[0, u, 0] < 1 - 1e-6)
        on_sensor_um = min(width_um / (1 - ratio), 300 * PITCH_UM)
        shadow_um = np.count_nonzero(inside) * PITCH_UM
        assert shadow_um <= on_sensor_um + PITCH_UM


def test_the_edge_of_a_shadow_moves_from_view_to_view_by_the_magnified_share_of_the_lens_step():
    ratio = 0.1
    described = camera(
        ratio * LENS_MM, 1e5, grey_cells([0, 1], 2), aperture_fill=0.0, pixel_fill=0.0
    )
    seen = transmittance(described, (1, 200))
    x_um = centred_grid(200, PITCH_UM)
    for u, lens_um in enumerate(centred_grid(3, APERTURE_CELL_MM * 1e3)):
        edge_um = -ratio * lens_um / (1 - ratio)
        np.testing.assert_array_equal(seen[0, u, 0].round(6), x_um > edge_um)


@pytest.mark.parametrize("distance_mm", [0.5, 5.0, 23.0])
def test_a_point_source_in_the_lens_magnifies_the_shadow_of_a_cell(distance_mm):
    ratio = distance_mm / LENS_MM
    cell_um = 600.0
    line = np.ones(101)
    line[52] = 0
    described = camera(
        distance_mm, cell_um, grey_cells(line, 101), aperture_fill=0.0, pixel_fill=0.0
    )
    seen = transmittance(described, (1, 601))
    x_um = centred_grid(601, PITCH_UM)
    for u, lens_um in enumerate(centred_grid(3, APERTURE_CELL_MM * 1e3)):
        left_um = (1.5 * cell_um - ratio * lens_um) / (1 - ratio)
        right_um = (2.5 * cell_um - ratio * lens_um) / (1 - ratio)
        assert right_um - left_um == pytest.approx(cell_um / (1 - ratio))
        shadow = (x_um > left_um) & (x_um < right_um)
        assert shadow.any()
        np.testing.assert_array_equal(seen[0, u, 0].round(6), ~shadow)


def test_a_mask_of_magnified_cells_shows_one_cell_to_one_sample_shifted_by_whole_cells():
    ratio = 0.2
    cell_um = (1 - ratio) * PITCH_UM
    lens_step_um = cell_um / ratio
    x_um = centred_grid(9, PITCH_UM)
    for step in (-2, 0, 1):
        met_um = mask_position(x_um, step * lens_step_um, ratio, 1.0)
        weights = cell_weights(met_um, Footprint(cell_um, 0.0), cell_um, 13).toarray()
        expected = np.zeros((9, 13))
        expected[np.arange(9), np.arange(9) + 2 + step] = 1
        np.testing.assert_allclose(weights, expected, atol=1e-9)


@pytest.mark.parametrize("cell_um", [5.0, 19.0, 80.0])
@pytest.mark.parametrize(
    ("pixel_um", "aperture_um"),
    [(0, 0), (24, 0), (0, 24), (17, 31), (31, 17), (24, 24), (24, 1e-6)],
)
def test_the_weights_of_every_footprint_sum_to_one(cell_um, pixel_um, aperture_um):
    positions_um = np.concatenate([centred_grid(40, 7.3), [-cell_um, -cell_um / 2, 0.0, cell_um]])
    count = int(np.ceil(400 / cell_um))
    weights = cell_weights(positions_um, Footprint(pixel_um, aperture_um), cell_um, count).toarray()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-12)
    assert weights.min() >= 0


@pytest.mark.parametrize("cell_um", [7.0, 24.0, 65.0])
@pytest.mark.parametrize(
    ("pixel_um", "aperture_um", "distance_mm"),
    [
        (24.0, 5000.0, 0.24),
        (24.0, 5000.0, 0.1),
        (24.0, 0.0, 0.5),
        (0.0, 5000.0, 0.4),
        (24.0, 5000.0, 0.0),
        (18.0, 700.0, 2.0),
        (24.0, 5000.0, 0.2388535),
    ],
)
def test_weights_are_the_shares_of_dense_rays(pixel_um, aperture_um, distance_mm, cell_um):
    """400 x 400 rays; a ray set counts a box to 1/400 of its width."""
    cells, lens_um, distance_um = 2 * int(600 / cell_um) + 1, LENS_MM * 1e3, distance_mm * 1e3
    ratio = distance_mm / LENS_MM
    footprint = Footprint((1 - ratio) * pixel_um, ratio * aperture_um)
    for x_um, u_um in [(0.0, 0.0), (100.0, 5000.0), (-71.3, -5000.0), (12.0, 2500.0)]:
        met_um = mask_position(x_um, u_um, distance_um, lens_um)
        weights = cell_weights(np.array([met_um]), footprint, cell_um, cells).toarray()[0]
        rays = traced_weights(
            x_um, u_um, pixel_um, aperture_um, distance_um, lens_um, cell_um, cells, 400
        )
        np.testing.assert_allclose(weights, rays, atol=1 / 400)


def test_a_beam_wider_than_the_mask_is_refused_and_the_cells_needed_are_named():
    footprint = Footprint(24.0, 24.0)
    with pytest.raises(CameraError, match=r"smaller than the beam: it has 10 cells.*needs 11"):
        cell_weights(np.array([-100.0, 100.0]), footprint, 24.0, 10)
    with pytest.raises(CameraError, match="enlarge the mask or reduce its offset"):
        cell_weights(np.array([200.0]), footprint, 24.0, 11)


def test_a_beam_that_just_fills_the_mask_is_accepted():
    footprint = Footprint(24.0, 24.0)
    weights = cell_weights(np.array([-96.0, 96.0]), footprint, 24.0, 10).toarray()
    np.testing.assert_allclose(weights.sum(axis=1), 1)


def test_the_fresnel_number_is_a_squared_over_lambda_d():
    assert fresnel_number(24.0, 1.0) == pytest.approx(12.0**2 / (0.55 * 1000))
    assert fresnel_number(48.0, 1.0) == pytest.approx(4 * fresnel_number(24.0, 1.0))
    assert fresnel_number(24.0, 2.0) == pytest.approx(fresnel_number(24.0, 1.0) / 2)
    assert fresnel_number(24.0, 0.0) == np.inf


def test_weights_of_cells_multiply_as_the_matrix_they_stand_for():
    footprint = Footprint(31.0, 17.0)
    weights = cell_weights(np.array([-90.0, 3.0, 40.0, 95.0]), footprint, 24.0, 10)
    cells = np.random.default_rng(0).random((10, 6))
    assert weights.splits_cells
    np.testing.assert_allclose(weights @ cells, weights.toarray() @ cells, rtol=1e-12)
    assert not cell_weights(np.array([-12.0, 12.0]), Footprint(24.0, 0.0), 24.0, 10).splits_cells


def test_weights_of_views_are_summed_as_the_matrices_they_stand_for():
    footprint = Footprint(31.0, 17.0)
    places = ([-90.0, 3.0], [-40.0, -60.0], [90.0, 0.0])
    views = [cell_weights(np.array(at), footprint, 24.0, 10) for at in places]
    summed = CellWeights.summed(views).toarray()
    np.testing.assert_allclose(summed, sum(view.toarray() for view in views), rtol=1e-12)

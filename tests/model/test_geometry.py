"""Geometry: where rays meet masks, against closed forms and against rays traced one by one."""

import numpy as np
import pytest

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

"""DV_K: derivatives against an explicit matrix, norms, and the sweep against plain NumPy."""

from functools import partial
from itertools import product
from math import comb, factorial
from unittest.mock import patch

import numba
import numpy as np
import pytest
from variation import AXIS, difference_matrix, gradient, variation

from emmc_rig.model.bands import in_bands
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.reconstruction import kernels
from emmc_rig.reconstruction.differences import (
    fitting_indices,
    multi_indices,
    norm_squared,
    stencils,
)
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.problem import colour_metric

EPS = float(np.finfo(np.float32).eps)
SHAPES = [(2, 3, 4, 5, 3), (1, 1, 4, 6, 3), (3, 1, 2, 4, 3), (1, 4, 1, 5, 3)]


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Small arrays: waking threads would take longer than the work."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_the_multi_indices_are_the_distinct_ones_of_the_order(order):
    found = multi_indices(order)
    assert len(found) == len(set(found)) == comb(order + 3, 3)
    assert {sum(index) for index in found} == {order}
    assert set(found) == {i for i in product(range(order + 1), repeat=4) if sum(i) == order}


def test_a_light_field_may_lie_in_memory_as_it_likes():
    light_field = np.random.default_rng(0).random(SHAPES[0]).astype(np.float32)
    stored = np.asfortranarray(light_field)
    assert variation(stored, 2) == variation(light_field, 2)


def test_derivatives_that_fit_nowhere_are_left_out():
    assert fitting_indices(2, (1, 1, 5, 5, 3)) == [(2, 0, 0, 0), (1, 1, 0, 0), (0, 2, 0, 0)]
    assert fitting_indices(5, (5, 5, 9, 9))[-1] == (0, 0, 1, 4)
    assert len(fitting_indices(5, (5, 5, 9, 9))) == comb(8, 3) - 2
    assert len(gradient(np.zeros((1, 2, 3, 4, 3)), 6)) == 1


def test_an_order_that_fits_nowhere_or_is_none_is_refused():
    with pytest.raises(ReconstructionError, match="no derivative of order 7 fits 1x2 views of 3x4"):
        variation(np.zeros((1, 2, 3, 4, 3)), 7)
    with pytest.raises(ReconstructionError, match="order must be at least 1"):
        multi_indices(0)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_dv_k_of_a_polynomial_of_lower_degree_is_zero(order):
    """DV_2 of an affine light field is 0, up to its borders: stencils do not look beyond them."""
    v, u, y, x = np.indices((4, 4, 6, 7)).astype(np.float64)
    colours = np.array([1.0, -0.5, 2.0])
    plane = 0.3 + 0.2 * x - 0.7 * y + 0.4 * u + 0.1 * v
    flat = (plane ** (order - 1))[..., None] * colours
    assert variation(flat, order) < 1e-9
    steep = (plane**order)[..., None] * colours
    assert variation(steep, order) > 0.1


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("entry", range(4))
def test_dv_k_of_a_power_is_its_factorial_times_the_places_where_it_exists(order, entry):
    shape = (4, 5, 6, 7, 3)
    colours = np.array([0.2, -0.4, 0.4])
    place = np.indices(shape[:4])[AXIS[entry]].astype(np.float64)
    light_field = (place**order)[..., None] * colours
    places = np.prod(shape[:4]) / shape[AXIS[entry]] * (shape[AXIS[entry]] - order)
    expected = factorial(order) * np.linalg.norm(colours) * places
    assert variation(light_field, order) == pytest.approx(expected, rel=1e-12)


def test_a_mixed_derivative_counts_once():
    """DV_2 of x u is one derivative of 1 per place; of 4^K ordered derivatives it would be two."""
    _, u, _, x = np.indices((1, 4, 1, 5)).astype(np.float64)
    light_field = (x * u)[..., None] * np.array([1.0, 0, 0])
    assert variation(light_field, 2) == pytest.approx(3 * 4)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_dv_k_couples_directions_and_weighted_colours_under_the_root(order):
    light_field = np.random.default_rng(3).random((3, 2, 5, 6, 3))
    metric = colour_metric(2.0)
    found = gradient(light_field @ metric.T, order)
    expected = np.sqrt(np.square(found).sum(axis=(0, -1))).sum()
    assert variation(light_field, order, metric) == pytest.approx(expected, rel=1e-12)
    assert variation(light_field, order, colour_metric(1.0)) == pytest.approx(
        variation(light_field, order), rel=1e-12
    )


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_the_bound_of_the_norm_holds_and_is_tight(shape, order):
    exact = np.linalg.norm(difference_matrix((*shape[:4], 1), order).toarray(), 2) ** 2
    bound = norm_squared(order, shape)
    assert exact <= bound * (1 + 1e-12)
    assert bound <= exact * (1 + 1e-12 if order == 1 else 1.12)


def test_an_endless_axis_bounds_every_size_and_is_reached():
    for order in (1, 2, 3):
        endless = norm_squared(order, (5, 5, None, None))
        sizes = [norm_squared(order, (5, 5, n, n)) for n in (3, 8, 40, 10**6)]
        assert sizes == sorted(sizes)
        assert sizes[-1] == endless
        assert norm_squared(order, (None,) * 4) == pytest.approx(comb(order + 3, 3) * 4**order)


def plain_step(psi, usable, frames, light_field, dual, steps, order, pull=None):
    """Return one over-relaxed primal-dual step on flattened arrays, by dense matrices.

    pull: (rho W per sample of a flattened light field, target), or None.
    """
    metric, gamma, sigma, mu, relax = steps
    dense = psi.to_scipy().toarray().astype(np.float64)[usable.ravel()]
    shape = psi.light_field_shape
    difference = difference_matrix(shape, order) @ np.kron(np.eye(np.prod(shape[:4])), metric)
    descended = light_field - gamma * difference.T @ dual
    weight, target = pull or (np.zeros(light_field.size), 0)
    system = np.diag(1 / gamma + weight) + dense.T @ dense
    right = descended / gamma + weight * target + dense.T @ frames[usable]
    new = np.linalg.solve(system, right)
    raised = dual + sigma * difference @ (2 * new - light_field)
    by_sample = raised.reshape(-1, np.prod(shape[:4]), 3)
    length = np.sqrt(np.square(by_sample).sum(axis=(0, 2)))[None, :, None]
    raised = (by_sample / np.maximum(length / mu, 1)).ravel()
    return relax * new + (1 - relax) * light_field, relax * raised + (1 - relax) * dual


STEPS = (colour_metric(2.0), 0.7, 1 / (4 * 1300 * 0.7), 0.3, 1.9)


def swept(psi, usable, frames, light_field, dual, order, bands, pull=None, count=3):
    """Return what `count` sweeps of the kernel make of arrays in natural order."""
    metric, gamma, sigma, mu, relax = STEPS
    kind = np.float32
    weight = np.zeros(psi.size) if pull is None else pull[0]
    pixels = weight[:: psi.binning, :: psi.binning]
    inverse = psi.inverted_blocks(np.where(usable, 1 / gamma + pixels, np.inf))
    data = kernels.FrameFit(psi.weights, psi.colour_map, inverse, frames, psi.binning)
    if pull is not None:
        share = 1 / (1 + gamma * weight)
        pulled = np.swapaxes(pull[1], -1, -2) * (1 - share)[:, None, :]
        data = data._replace(share=share.astype(kind), pulled=pulled.astype(kind).copy())
    steps = kernels.Steps(kind(gamma), kind(sigma), kind(mu), kind(relax), metric.astype(kind))
    state = np.ascontiguousarray(np.swapaxes(light_field, -1, -2), dtype=kind)
    room = np.empty_like(state)
    dual_state = np.ascontiguousarray(dual.transpose(1, 2, 3, 0, 5, 4), dtype=kind)
    moved = np.zeros((psi.frames_shape[1], 2))
    taps = stencils(order, psi.light_field_shape, np.dtype(kind))
    with patch("emmc_rig.reconstruction.kernels.in_bands", partial(in_bands, bands=bands)):
        for _ in range(count):
            kernels.sweep(data, steps, taps, state, dual_state, room, moved)
    return np.swapaxes(state, -1, -2), dual_state.transpose(3, 0, 1, 2, 5, 4), moved


def begin(psi, order, seed=0):
    rng = np.random.default_rng(seed)
    frames = rng.random(psi.frames_shape).astype(np.float32)
    light_field = rng.random(psi.light_field_shape).astype(np.float32)
    dual = gradient(rng.standard_normal(psi.light_field_shape), order).astype(np.float32) * 0.3
    usable = rng.random(psi.frames_shape) < 0.8
    k = psi.binning
    weight = np.kron(rng.random(psi.frames_shape[1:]) * 2, np.ones((k, k)))
    weight[:k] = 0
    pull = weight, rng.random(psi.light_field_shape)
    return frames, light_field, dual, usable, pull


@pytest.mark.parametrize("with_pull", [False, True])
@pytest.mark.parametrize(
    ("order", "cfa", "binning", "shots", "views"),
    [
        (1, "rggb", 1, 2, (2, 2)),
        (1, "mono", 2, 1, (2, 2)),
        (2, "rggb", 1, 1, (2, 3)),
        (2, "mono", 2, 2, (2, 2)),
        (3, "rggb", 2, 2, (2, 2)),
        (3, "mono", 1, 1, (1, 4)),
        (1, "mono", 1, 3, (1, 1)),
        (1, "rggb", 2, 1, (3, 1)),
        (1, "filters", 1, 3, (2, 2)),
    ],
)
def test_the_fused_sweep_is_the_plain_primal_dual_step(
    coded_psi, order, cfa, binning, shots, views, with_pull
):
    if cfa == "filters":
        seen = [{"filter": "red"}, {"filter": "green"}, {"filter": "blue"}]
        filtered = Camera.model_validate({"title": "filters", "views": views, "shots": seen})
        psi = build_imaging_matrix(filtered, (6, 4))
    else:
        psi = coded_psi(cfa, binning, shots, size=(6, 4), views=views)
    frames, light_field, dual, usable, pull = begin(psi, order)
    pull = pull if with_pull else None
    found, found_dual, moved = swept(psi, usable, frames, light_field, dual, order, 2, pull)
    flat_pull = None
    if pull is not None:
        spread = np.broadcast_to(pull[0][..., None], psi.light_field_shape)
        flat_pull = spread.ravel(), pull[1].ravel()
    flat, flat_dual = light_field.astype(np.float64).ravel(), dual.astype(np.float64).ravel()
    before = flat
    for _ in range(3):
        before = flat
        flat, flat_dual = plain_step(psi, usable, frames, flat, flat_dual, STEPS, order, flat_pull)
    np.testing.assert_allclose(found.ravel(), flat, atol=100 * EPS * np.abs(flat).max())
    np.testing.assert_allclose(found_dual.ravel(), flat_dual, atol=200 * EPS)
    change = np.sum(np.square((flat - before) / STEPS[4]))
    assert moved.sum(axis=0) == pytest.approx([change, np.sum(flat**2)], rel=1e-4)


@pytest.mark.parametrize(("order", "binning"), [(2, 1), (3, 1), (3, 2)])
def test_a_sweep_does_not_depend_on_how_the_rows_are_shared(coded_psi, order, binning):
    psi = coded_psi("rggb", binning, 2, size=(8, 6), views=(2, 3))
    frames, light_field, dual, usable, _ = begin(psi, order)
    whole = swept(psi, usable, frames, light_field, dual, order, 1)
    for bands in (2, 3, psi.frames_shape[1]):
        shared = swept(psi, usable, frames, light_field, dual, order, bands)
        for item, other in zip(shared, whole, strict=True):
            np.testing.assert_array_equal(item, other)

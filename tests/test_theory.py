"""Theory of Psi: the algebra against draws, dense matrices and estimators that it bounds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.errors import ReconstructionError
from reconstruction.theory.bounds import (
    disparity_information,
    distances,
    uniform_variance,
    ziv_zakai,
)
from reconstruction.theory.conditioning import (
    condition,
    ray_coherence,
    sensed,
    spot_coherence,
    subspace,
    unexplained,
    union,
)
from reconstruction.theory.patch import PatchModel, Texture

TEXTURE = Texture(0.02, 0.1)
DISPARITY, VARIANCE = 0.6, 1e-5


@pytest.fixture(scope="module", params=[("rggb", 1, 1), ("mono", 1, 2), ("rggb", 2, 2)])
def patch(request, coded_psi):
    cfa, binning, shots = request.param
    return PatchModel.of(coded_psi(cfa, binning, shots, (8, 8), (3, 3)), (0, 0))


@pytest.fixture(scope="module")
def bayer_patch(coded_psi):
    return PatchModel.of(coded_psi(size=(8, 8), views=(3, 3)), (0, 0))


def drawn(patch, disparity, count, seed=0, variance=VARIANCE):
    """Light-field patches (draw, ray, c) of the prior, and their noisy readings (draw, reading)."""
    rng = np.random.default_rng(seed)
    alike = patch.alike(disparity, TEXTURE)
    root = np.linalg.cholesky(alike + 1e-10 * np.eye(len(alike)))
    white = rng.standard_normal((count, 3, len(alike)))
    opponent = np.sqrt(TEXTURE.variances)[None, :, None] * (white @ root.T)
    readings = np.einsum("omr,nor->nm", patch.opponent, opponent, optimize=True)
    readings += np.sqrt(variance) * rng.standard_normal(readings.shape)
    return np.einsum("nor,oc->nrc", opponent, OPPONENT), readings


def test_the_patch_is_psi_in_opponent_colours(coded_psi):
    psi = coded_psi("rggb", 2, 2, (10, 12), (3, 3))
    patch = PatchModel.of(psi, (2, 4))
    rng = np.random.default_rng(0)
    light_field = np.zeros(psi.light_field_shape, np.float32)
    light_field[:, :, 2:10, 4:12] = rng.random((3, 3, 8, 8, 3))
    rays = light_field[:, :, 2:10, 4:12].reshape(-1, 3) @ OPPONENT.T
    expected = psi.forward(light_field)[:, 1:5, 2:6]
    got = np.einsum("omr,ro->m", patch.opponent, rays)
    np.testing.assert_allclose(got, expected.ravel(), rtol=1e-5)
    with pytest.raises(ReconstructionError, match="leaves a light field"):
        PatchModel.of(psi, (4, 4))


def test_the_error_expected_is_that_of_draws(patch):
    rays, readings = drawn(patch, DISPARITY, 400)
    estimates = patch.estimate(DISPARITY, TEXTURE, VARIANCE, readings)
    errors = np.square(estimates - rays[:, patch.middle]).mean(axis=(1, 2))
    expected = patch.expected(DISPARITY, TEXTURE, VARIANCE)
    assert abs(errors.mean() - expected.error) < 4 * errors.std() / 20
    assert 0 < expected.error < expected.prior
    assert 0 < expected.degrees_of_freedom < patch.readings


def test_the_noise_gain_is_the_slope_of_the_error_and_what_noise_alone_does(patch):
    expected = patch.expected(DISPARITY, TEXTURE, VARIANCE)
    step = 0.02 * VARIANCE
    ahead, behind = (
        patch.expected(DISPARITY, TEXTURE, VARIANCE + move).error for move in (step, -step)
    )
    assert (ahead - behind) / (2 * step) == pytest.approx(expected.noise_gain**2, rel=1e-3)
    noise = np.random.default_rng(0).standard_normal((300, patch.readings))
    passed = patch.estimate(DISPARITY, TEXTURE, VARIANCE, noise)
    assert np.sqrt(np.mean(np.square(passed))) == pytest.approx(expected.noise_gain, rel=0.1)


def test_a_reading_of_endless_noise_is_one_not_used(bayer_patch):
    some = np.where(np.arange(bayer_patch.readings) % 2, VARIANCE, 1e6)
    half = PatchModel(bayer_patch.opponent[:, 1::2], bayer_patch.views, bayer_patch.side)
    got = bayer_patch.expected(DISPARITY, TEXTURE, some).error
    assert got == pytest.approx(half.expected(DISPARITY, TEXTURE, VARIANCE).error, rel=1e-5)


def test_the_slope_of_the_covariance_is_its_derivative(patch):
    step = 1e-4
    for texture in (TEXTURE, replace(TEXTURE, mean_known=True)):
        ahead, behind = (patch.alike(DISPARITY + move, texture) for move in (step, -step))
        slope = patch.alike_slope(DISPARITY, texture)
        np.testing.assert_allclose((ahead - behind) / (2 * step), slope, atol=1e-6)


def test_a_known_mean_leaves_only_what_departs_from_it(bayer_patch):
    known = replace(TEXTURE, mean_known=True)
    rays = drawn(bayer_patch, DISPARITY, 2000)[0]
    rest = rays - rays.mean(axis=1, keepdims=True)
    flat = (rest @ OPPONENT.T)[:, :, 0]
    expected = TEXTURE.amplitude * bayer_patch.alike(DISPARITY, known)
    assert np.abs(flat.T @ flat / 2000 - expected).max() < 0.2 * TEXTURE.amplitude
    found, usual = (bayer_patch.expected(DISPARITY, one, VARIANCE) for one in (known, TEXTURE))
    assert found.prior < usual.prior
    assert found.error < usual.error


def test_fisher_information_is_the_variance_of_the_score(bayer_patch):
    step, count = 1e-3, 1500
    _, readings = drawn(bayer_patch, DISPARITY, count)
    likelihood = [
        multivariate_normal(
            np.zeros(bayer_patch.readings),
            bayer_patch.signal(bayer_patch.alike(d, TEXTURE), TEXTURE)
            + VARIANCE * np.eye(bayer_patch.readings),
        ).logpdf(readings)
        for d in (DISPARITY + step, DISPARITY - step)
    ]
    score = (likelihood[0] - likelihood[1]) / (2 * step)
    information = disparity_information(bayer_patch, DISPARITY, TEXTURE, VARIANCE)
    assert abs(score.mean()) < 4 * np.sqrt(information / count)
    assert score.var() == pytest.approx(information, rel=0.15)


@pytest.mark.parametrize("variance", [1e-5, 1e-3])
def test_no_estimate_of_the_disparity_beats_the_bounds(bayer_patch, variance):
    grid = np.linspace(-1, 1, 9)
    rng = np.random.default_rng(1)
    inverses = {}

    def surprise(d, reading):
        key = round(float(d), 3)
        if key not in inverses:
            covariance = bayer_patch.signal(bayer_patch.alike(key, TEXTURE), TEXTURE)
            covariance += variance * np.eye(len(covariance))
            inverses[key] = np.linalg.inv(covariance), np.linalg.slogdet(covariance)[1]
        inverse, log_det = inverses[key]
        return reading @ inverse @ reading + log_det

    misses = []
    for draw in range(40):
        true = round(float(rng.uniform(-1, 1)), 2)
        reading = drawn(bayer_patch, true, 1, seed=draw, variance=variance)[1][0]
        coarse = np.linspace(-1, 1, 21)
        best = coarse[int(np.argmin([surprise(d, reading) for d in coarse]))]
        fine = minimize_scalar(
            lambda d, reading=reading: surprise(d, reading),
            bounds=(max(best - 0.1, -1), min(best + 0.1, 1)),
            method="bounded",
            options={"xatol": 2e-3},
        )
        misses.append(fine.x - true)
    squares = np.square(misses)
    sampling = 3 * squares.std() / np.sqrt(len(squares))
    bound = ziv_zakai(grid, distances(bayer_patch, grid, TEXTURE, variance))
    assert bound <= squares.mean() + sampling
    local = np.mean([1 / disparity_information(bayer_patch, d, TEXTURE, variance) for d in grid])
    if local < 0.01:  # where no disparity far off is confused with the true one
        assert local <= squares.mean() + sampling


def test_without_readings_the_disparity_is_as_uncertain_as_its_prior():
    grid = np.linspace(-2, 2, 401)
    bound = ziv_zakai(grid, np.zeros((401, 401)))
    assert bound <= uniform_variance(grid)
    assert bound == pytest.approx(uniform_variance(grid), rel=0.02)
    assert ziv_zakai(grid, np.full((401, 401), 50.0)) < 1e-12


def test_columns_of_one_shot_are_parallel_and_those_of_several_are_not(coded_psi):
    one, two = (coded_psi(shots=shots, size=(8, 8), views=(3, 3)) for shots in (1, 2))
    assert ray_coherence(one) == pytest.approx(1)
    # Against the columns of the dense matrix.
    dense = two.to_scipy().toarray()
    columns = dense.reshape(-1, *two.light_field_shape)
    cosines = []
    for axis in (1, 2):
        first = np.take(columns, range(2), axis=axis).reshape(len(columns), -1)
        second = np.take(columns, range(1, 3), axis=axis).reshape(len(columns), -1)
        product = np.linalg.norm(first, axis=0) * np.linalg.norm(second, axis=0)
        cosines.append((first * second).sum(axis=0)[product > 0] / product[product > 0])
    expected = float(np.concatenate(cosines).mean())
    assert ray_coherence(two) == pytest.approx(expected, rel=1e-6)
    assert expected < 0.99


def test_a_mask_in_contact_does_not_tell_views_apart(coded_psi, bayer_patch):
    psi = coded_psi(size=(8, 8), views=(3, 3))
    same = np.broadcast_to(psi.weights[:, 1:2, 1:2], psi.weights.shape).copy()
    contact = PatchModel.of(ImagingMatrix(same, psi.colour), (0, 0))
    apart, blind = (
        disparity_information(one, 0.0, TEXTURE, VARIANCE) for one in (bayer_patch, contact)
    )
    # At disparity 0 all views see the same, and being nearer or further blurs alike.
    assert blind < 1e-9 * apart
    spots = [spot_coherence(one, np.array([-2.0, 2.0]))[0, 1] for one in (contact, bayer_patch)]
    assert spots[0] == pytest.approx(1)
    assert spots[1] < 0.95
    modes = [
        unexplained(one, *(subspace(one, d, TEXTURE, 12) for d in (-0.5, 0.5)))
        for one in (contact, bayer_patch)
    ]
    assert modes[0] == pytest.approx(0, abs=1e-6)
    assert modes[1] > 100 * modes[0] + 0.005


def test_condition_and_gain_are_those_of_the_dense_matrix(patch):
    space = subspace(patch, DISPARITY, TEXTURE, 8)
    assert space.size == 8
    read = sensed(patch, space)
    found = condition(patch, space)
    singular = np.linalg.svd(read, compute_uv=False)
    assert found.number == pytest.approx(singular[0] / singular[-1])
    # Least squares on draws of noise: error of the light field's values.
    noise = np.random.default_rng(0).standard_normal((patch.readings, 4000))
    coefficients = np.linalg.lstsq(read, noise, rcond=None)[0]
    values = 3 * patch.opponent.shape[2]
    per_value = np.sqrt(np.square(coefficients).sum(axis=0).mean() / values)
    assert found.gain == pytest.approx(per_value, rel=0.03)


def test_more_modes_than_readings_cannot_be_determined(patch):
    both = union([subspace(patch, d, TEXTURE, patch.readings) for d in (-1.5, 1.5)])
    assert both.size > patch.readings
    assert condition(patch, both).number == np.inf


def test_the_union_holds_both_subspaces(bayer_patch):
    spaces = [subspace(bayer_patch, d, TEXTURE, 10) for d in (0.0, 1.0)]
    both = union(spaces)
    for colour in range(3):
        basis = both.basis[colour][:, : both.counts[colour]]
        np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-9)
        for space in spaces:
            own = space.basis[colour][:, : space.counts[colour]]
            left = own - basis @ (basis.T @ own)
            assert np.linalg.norm(left, axis=0).max(initial=0) < 0.2
    assert condition(bayer_patch, both).number > condition(bayer_patch, spaces[0]).number

"""The mean of models by their residuals of held-out readings: weights, light field, spread."""

import numpy as np
import pytest

from emmc_rig.reconstruction.adaptive.mixture import (
    HIDDEN,
    PATCHES_CHANCE,
    PATCHES_POWER,
    averaged,
    beside_patches,
    excess,
    shares_of,
    stored,
)

SHAPE, NOISE = (2, 60, 80), 1e-6


@pytest.fixture
def held():
    return np.random.default_rng(0).random(SHAPE[1:])[None].repeat(2, axis=0) < 0.1


def misses(*deviations):
    rng = np.random.default_rng(1)
    return [rng.normal(0, (deviation**2 + NOISE) ** 0.5, SHAPE) for deviation in deviations]


def noise():
    return np.full(SHAPE, NOISE)


def test_a_model_of_half_the_error_weighs_sixteen_times_as_much(held):
    share = shares_of(misses(0.01, 0.02), noise(), held)
    np.testing.assert_allclose(share.sum(axis=0), 1, rtol=1e-5)
    assert np.median(share[0] / share[1]) == pytest.approx(16, rel=0.4)


def test_the_better_model_may_differ_from_place_to_place(held):
    left = np.arange(SHAPE[2]) < SHAPE[2] // 2
    first, second = misses(1.0, 1.0)
    missed = [first * np.where(left, 0.01, 0.1), second * np.where(left, 0.1, 0.01)]
    share = shares_of(missed, noise(), held)
    assert share[0, :, :10].min() > 0.9 > 0.1 > share[0, :, -10:].max()


def test_models_that_miss_no_more_than_the_noise_weigh_alike(held):
    share = shares_of(misses(0.0, 0.0), noise(), held)
    assert np.abs(share - 0.5).max() < 0.45
    assert np.abs(share.mean(axis=(1, 2)) - 0.5).max() < 0.2


def test_surfaces_that_err_alike_count_once_beside_patches(held):
    surfaces, patches = misses(0.01, 0.01)
    share = beside_patches([surfaces, surfaces, patches], noise(), held)
    np.testing.assert_allclose(share.sum(axis=0), 1, rtol=1e-5)
    np.testing.assert_allclose(share[0], share[1], rtol=1e-5)
    odds = np.median(share[2] / (share[0] + share[1]))
    assert odds == pytest.approx(PATCHES_CHANCE * HIDDEN**PATCHES_POWER, rel=0.3)


def test_patches_that_err_by_noise_as_surfaces_do_have_a_small_share(held):
    surfaces, patches = misses(0.0, 0.0)
    share = beside_patches([surfaces, patches], noise(), held)
    odds = share[1].mean() / share[0].mean()
    assert odds == pytest.approx(PATCHES_CHANCE, rel=0.3)


@pytest.mark.parametrize(("surface", "patch"), [(0.02, 0.01), (0.01, 0.02)])
def test_surfaces_or_patches_of_half_the_error_take_nearly_all(held, surface, patch):
    surfaces, patches = misses(surface, patch)
    share = beside_patches([surfaces, patches], noise(), held)
    assert share[int(patch < surface)].min() > 0.9


def test_the_mean_of_light_fields_follows_the_shares_of_pixels():
    shares = np.stack([np.full((2, 3), 0.25), np.full((2, 3), 0.75)]).astype(np.float32)
    fields = [np.full((3, 3, 4, 6, 3), value, np.float32) for value in (0.4, 0.8)]
    fields = [stored(field) for field in fields]
    mean, _, _ = averaged(fields, shares, 2, fields[1])
    np.testing.assert_allclose(mean, 0.7, rtol=2e-5)


def test_the_spread_is_the_weighted_variance_of_light_fields():
    rng = np.random.default_rng(3)
    fields = rng.random((2, 3, 3, 4, 6, 3)).astype(np.float32)
    first, other = fields
    coarse = rng.random((2, 3)).astype(np.float32)
    models = [stored(field) for field in fields]
    mean, spread, apart = averaged(models, np.stack([coarse, 1 - coarse]), 2, models[1])
    share = coarse.repeat(2, axis=0).repeat(2, axis=1)
    square = np.square(first - other).mean(axis=-1)
    expected = share[..., None] * first + (1 - share[..., None]) * other
    np.testing.assert_allclose(mean, expected, atol=1e-5)
    np.testing.assert_allclose(spread, share * (1 - share) * square, atol=2e-5)
    np.testing.assert_allclose(apart, np.square(share) * square, atol=2e-5)


def test_the_excess_of_residuals_is_their_square_beyond_the_noise_and_never_0(held):
    (missed,) = misses(0.01)
    assert excess(missed, noise(), held) == pytest.approx(1e-4, rel=0.1)
    assert excess(np.zeros(SHAPE), noise(), held) == pytest.approx(NOISE * (2 / held.sum()) ** 0.5)

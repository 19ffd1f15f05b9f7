"""What surfaces miss, as a light field of its own: only where held-out readings speak for it."""

import numpy as np
import pytest

from emmc_rig.files.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from reconstruction.adaptive.rest import misfit_of, rest
from reconstruction.adaptive.uncertainty import held_out
from reconstruction.choices import choose_mu

SIGMA = 0.001


@pytest.fixture(scope="module")
def psi():
    return build_imaging_matrix(find_camera("rgbw-bayer-3shots"), (40, 48))


def asked(psi, missing, seed=0):
    """The rest that is returned when a light field misses `missing`, and readings their noise."""
    noise = np.random.default_rng(seed).normal(0, SIGMA, psi.frames_shape)
    missed = (psi.forward(missing) + noise).astype(np.float32)
    held = held_out(np.ones(missed.shape, bool), 0.06)
    frames = missed + psi.forward(np.full(psi.light_field_shape, 0.3, np.float32))
    mu = choose_mu(psi, frames[~held], SIGMA)
    return rest(psi, missed, mu, SIGMA, ~held, held, 60)


def test_what_is_missed_in_one_view_is_put_back(psi):
    missing = np.zeros(psi.light_field_shape, np.float32)
    missing[:, :2, 8:32, 10:40] = 0.2
    found = asked(psi, missing)
    assert found is not None
    assert np.square(found - missing).mean() < 0.5 * np.square(missing).mean()


def test_noise_alone_has_no_rest(psi):
    nothing = np.zeros(psi.light_field_shape, np.float32)
    got = [asked(psi, nothing, seed) for seed in range(3)]
    assert sum(one is None for one in got) >= 2


def test_misfit_is_one_at_the_noise_and_says_where_it_is_more():
    rng = np.random.default_rng(2)
    missed = rng.normal(0, SIGMA, (2, 60, 80))
    noise, fitted = np.full(missed.shape, SIGMA**2), np.ones(missed.shape, bool)
    assert misfit_of(missed, noise, fitted).times == pytest.approx(1, abs=0.05)
    missed[:, 40:46, 20:26] *= 30
    found = misfit_of(missed, noise, fitted)
    assert abs(found.row - 42.5) < 2
    assert abs(found.column - 22.5) < 2

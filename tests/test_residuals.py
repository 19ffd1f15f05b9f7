"""Residuals against the noise: noise alone is 1 and white, what Psi does not explain is neither."""

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.residuals import check_residuals

SHAPE = (2, 60, 80)
USABLE = np.ones(SHAPE, dtype=bool)
VARIANCE = np.full(SHAPE, 0.04)


def noise(seed):
    return np.random.default_rng(seed).normal(0, 0.2, SHAPE)


def test_noise_alone_lies_within_its_deviations():
    found = [check_residuals(noise(seed), VARIANCE, USABLE) for seed in range(60)]
    assert np.std([one.chi2_deviations for one in found]) == pytest.approx(1, abs=0.3)
    assert np.std([one.correlation_deviations for one in found]) == pytest.approx(1, abs=0.3)
    assert abs(np.mean([one.chi2_deviations for one in found])) < 0.5


def test_structure_is_neither_small_nor_white():
    y, x = np.mgrid[: SHAPE[1], : SHAPE[2]]
    found = check_residuals(noise(0) + 0.2 * np.sin(x / 4) * np.cos(y / 5), VARIANCE, USABLE)
    assert found.chi2_deviations > 5
    assert found.correlation_deviations > 5


def test_pixels_not_to_use_do_not_count():
    spoilt, usable = noise(1), USABLE.copy()
    spoilt[:, 10:20, 10:20] = np.nan
    usable[:, 10:20, 10:20] = False
    assert abs(check_residuals(spoilt, VARIANCE, usable).chi2_deviations) < 4
    with pytest.raises(CalibrationError, match="too few to judge"):
        check_residuals(spoilt, VARIANCE, np.zeros(SHAPE, dtype=bool))

"""The sensor's noise, eq. 14: moments against theory, range, exposure and light."""

import numpy as np
import pytest
from scipy.stats import chi2

from emmc_rig.model.noise import SensorNoise

COUNT = 40_000
EXPOSURE_S = 0.05


def exposed(sensor, reading, exposure_s=EXPOSURE_S, light=1.0, seed=0, count=COUNT):
    """Return `count` normalised readings of one true reading."""
    rng = np.random.default_rng(seed)
    dn = sensor.expose_dn(np.full(count, reading), exposure_s, light, rng)
    return sensor.normalise(dn, exposure_s, light).astype(np.float64)


def assert_moments(samples, mean, variance):
    """Check mean and variance at a two-sided significance of 1e-5 (normal samples)."""
    assert abs(samples.mean() - mean) < 4.42 * np.sqrt(variance / samples.size)
    low, high = chi2.ppf([5e-6, 1 - 5e-6], samples.size - 1) * variance / (samples.size - 1)
    assert low < samples.var(ddof=1) < high


class Silent:
    """A random number generator without chance: every draw is its mean."""

    def poisson(self, mean):
        return np.asarray(mean)

    def normal(self, mean, deviation, shape):
        return np.full(shape, mean)


@pytest.mark.parametrize("light", [1.0, 3.0, 4.0, 12.0])
@pytest.mark.parametrize("reading", [0.02, 0.3, 1.0])
def test_a_reading_has_the_mean_and_variance_of_shot_read_and_quantisation_noise(reading, light):
    sensor = SensorNoise(electrons_per_s=24_000)
    electrons = reading * 24_000 * EXPOSURE_S * light
    variance_dn = 0.8**2 * (electrons + 2.5**2) + 1 / 12
    expected = variance_dn / (0.8 * 24_000 * EXPOSURE_S * light) ** 2
    assert_moments(exposed(sensor, reading, light=light), reading, expected)
    assert sensor.variance(np.array(reading), EXPOSURE_S, light) == pytest.approx(expected)


@pytest.mark.parametrize("read_noise", [0.0, 2.5, 20.0])
def test_a_dark_frame_holds_read_and_quantisation_noise_around_the_black_level(read_noise):
    sensor = SensorNoise(read_noise_electrons=read_noise, black_level_dn=500)
    dn = sensor.expose_dn(np.zeros(COUNT), EXPOSURE_S, 1.0, np.random.default_rng(1))
    if read_noise == 0:
        assert (dn == 500).all()
    else:
        assert_moments(dn.astype(float), 500, 0.8**2 * read_noise**2 + 1 / 12)


def test_without_chance_normalise_inverts_expose_to_half_a_digital_number():
    sensor = SensorNoise(electrons_per_s=240_000)
    readings = np.linspace(0, 1, 1001)
    for exposure_s, light in [(0.05, 1.0), (0.01, 3.0), (0.02, 4.0)]:
        dn = sensor.expose_dn(readings, exposure_s, light, Silent())  # type: ignore[arg-type]
        half_dn = 0.5 / (0.8 * 240_000 * exposure_s * light)
        again = sensor.normalise(dn, exposure_s, light)
        assert again.dtype == np.float32
        np.testing.assert_allclose(again, readings, atol=half_dn + 1e-7)


def test_the_sensor_clips_at_its_white_level_and_says_where():
    sensor = SensorNoise(white_level_dn=4095, black_level_dn=256)
    rng = np.random.default_rng(3)
    dn = sensor.expose_dn(np.array([[0.1, 0.9], [0.2, 30.0]]), EXPOSURE_S, 1.0, rng)
    assert dn.dtype == np.uint16
    np.testing.assert_array_equal(dn == 4095, [[False, True], [False, True]])
    np.testing.assert_array_equal(sensor.saturated(dn), dn == 4095)
    full = SensorNoise(electrons_per_s=10e6)
    assert full.expose_dn(np.ones(9), 1.0, 1.0, rng).tolist() == [65_535] * 9


def test_light_and_exposure_may_differ_from_pixel_to_pixel_and_shot_to_shot():
    sensor = SensorNoise(electrons_per_s=240_000)
    light = np.array([[1.0, 3.0], [2.0, 1.0]])
    exposure_s = np.array([0.01, 0.02, 0.03])[:, None, None]
    readings = np.full((3, 2, 2), 0.5)
    electrons = sensor.electrons(readings, exposure_s, light)
    np.testing.assert_allclose(electrons, 0.5 * 240_000 * exposure_s * light)
    dn = sensor.expose_dn(readings, exposure_s, light, np.random.default_rng(5))
    sigma = np.sqrt(sensor.variance(readings, exposure_s, light))
    assert (np.abs(sensor.normalise(dn, exposure_s, light) - readings) < 5 * sigma).all()


def test_a_pixel_that_no_light_reaches_reads_0_and_has_no_weight():
    sensor = SensorNoise()
    light = np.array([1.0, 0.0])
    dn = sensor.expose_dn(np.array([0.5, 0.0]), EXPOSURE_S, light, np.random.default_rng(6))
    readings = sensor.normalise(dn, EXPOSURE_S, light)
    assert readings[1] == 0
    variance = sensor.variance(readings, EXPOSURE_S, light)
    assert np.isfinite(variance[0])
    assert variance[1] == np.inf


def test_the_sensor_clips_at_zero_below_the_black_level():
    sensor = SensorNoise(black_level_dn=0, read_noise_electrons=10)
    dn = sensor.expose_dn(np.zeros(COUNT), EXPOSURE_S, 1.0, np.random.default_rng(4))
    assert dn.max() < 100
    assert (dn == 0).mean() == pytest.approx(0.5, abs=0.05)

"""The map of where readings are missed: one where the light field explains them, more elsewhere."""

import numpy as np

import emmc_rig as emmc
from reconstruction.verdict.kept import missed_readings


def test_readings_are_missed_where_the_light_field_is_wrong_and_nowhere_else():
    psi = emmc.camera("rgbw-bayer-1shot").psi((48, 64))
    rng = np.random.default_rng(3)
    light_field = rng.uniform(0.3, 0.6, psi.light_field_shape).astype(np.float32)
    readings = psi.forward(light_field)
    noise = 0.01
    noisy = (readings + rng.normal(0, noise, readings.shape)).astype(np.float32)
    usable = np.ones(readings.shape, bool)
    right = missed_readings(psi, light_field, noisy, noise, usable)
    assert right.shape == (48, 64)
    # 81 readings: the root mean square of normal values is within 5 sqrt(1 / 162) of 1.
    assert np.abs(right - 1)[4:-4, 4:-4].max() < 5 * np.sqrt(1 / 162)
    wrong = light_field.copy()
    wrong[:, :, 20:30, 30:40] += 0.2
    missed = missed_readings(psi, wrong, noisy, noise, usable)
    assert missed[22:28, 32:38].min() > 3
    np.testing.assert_array_equal(missed[:, :20], right[:, :20])


def test_places_without_usable_readings_count_as_explained():
    psi = emmc.camera("rgbw-bayer-1shot").psi((24, 32))
    nothing = np.zeros(psi.frames_shape, np.float32)
    unusable = np.zeros(psi.frames_shape, bool)
    dark = np.zeros(psi.light_field_shape, np.float32)
    np.testing.assert_array_equal(missed_readings(psi, dark, nothing, 0.1, unusable), 1)

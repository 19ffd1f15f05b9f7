"""Frames: readings with a common deviation or a deviation each, cut and averaged."""

import numpy as np
import pytest

from emmc_rig.model.errors import SensingError
from emmc_rig.model.frames import Frames, even_frames

RNG = np.random.default_rng(0)
READINGS = RNG.random((2, 4, 6), dtype=np.float32)


@pytest.mark.parametrize("sigma", [0.0, 0.003, 1 / 3])
def test_one_deviation_for_all_is_returned_to_the_last_bit_whatever_is_usable(sigma):
    frames = even_frames(READINGS, sigma, READINGS > 0.7)
    assert frames.noise_sigma == sigma
    assert frames.cut(np.s_[1:, :2, 1:4]).noise_sigma == sigma
    assert even_frames(READINGS, sigma, np.zeros(READINGS.shape, bool)).noise_sigma == sigma


def test_the_typical_deviation_is_the_root_mean_variance_of_usable_readings():
    deviation = np.where(READINGS > 0.5, 0.3, 0.4)
    usable = np.zeros(READINGS.shape, bool)
    usable[0, 0, :2] = True
    deviation[0, 0, :2] = 0.3, 0.4
    frames = Frames(READINGS, deviation, usable)
    assert frames.noise_sigma == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    even = frames.of_one_deviation()
    assert even.noise_sigma == frames.noise_sigma
    assert np.unique(even.deviation).tolist() == [frames.noise_sigma]
    assert even.readings is frames.readings


def test_a_part_has_the_readings_deviations_and_usable_pixels_of_its_place():
    frames = Frames(READINGS, 2 * READINGS, READINGS > 0.5)
    part = frames.cut(np.s_[:1, 1:3, 2:])
    assert part.shape == (1, 2, 4)
    np.testing.assert_array_equal(part.readings, READINGS[:1, 1:3, 2:])
    np.testing.assert_array_equal(part.deviation, 2 * READINGS[:1, 1:3, 2:])
    np.testing.assert_array_equal(part.usable, READINGS[:1, 1:3, 2:] > 0.5)


def test_numpy_takes_frames_as_their_readings():
    frames = even_frames(READINGS, 0.01)
    np.testing.assert_array_equal(np.asarray(frames), READINGS)
    assert frames.mean() == np.mean(frames) == READINGS.mean()
    assert np.mean(frames, axis=(1, 2)).shape == (2,)


def test_arrays_of_unlike_shapes_are_refused():
    with pytest.raises(SensingError, match="need one shape"):
        even_frames(READINGS, 0.01, np.ones((4, 6), bool))

"""Brackets: a linear frame with the variance that it really has."""

import numpy as np
import pytest

from calibration.bracket import fuse
from calibration.errors import CalibrationError
from calibration.frames import SensorGain, average
from emmc_rig.model.noise import SensorNoise

NOISE = SensorNoise(
    electrons_per_s=200_000,
    gain_dn_per_electron=0.25,
    read_noise_electrons=8,
    black_level_dn=100,
    white_level_dn=4095,
)
GAIN = SensorGain(0.25, (0.25 * 8) ** 2 + 1 / 12)
EXPOSURES_S = (0.005, 0.02, 0.08)
DARKS = 16


def dark_frame(size, rng):
    frames = [NOISE.expose_dn(np.zeros(size), 0.01, 1.0, rng) for _ in range(DARKS)]
    return average(frames, 0.01, NOISE.white_level_dn, "dark")


def bracket_of(readings, rng, exposures_s=EXPOSURES_S):
    return [NOISE.expose_dn(readings, exposure_s, 1.0, rng) for exposure_s in exposures_s]


def true_rate(readings):
    return NOISE.gain_dn_per_electron * NOISE.electrons_per_s * readings


@pytest.fixture
def ramp():
    """Readings from deep shadow to four times what the longest exposure can hold."""
    return np.geomspace(0.0005, 4.0, 400)[None].repeat(300, axis=0)


def test_the_fused_rate_is_unbiased_and_its_deviation_is_true(ramp):
    rng = np.random.default_rng(0)
    dark = dark_frame(ramp.shape, rng)
    fused = fuse(bracket_of(ramp, rng), EXPOSURES_S, dark, GAIN, NOISE.white_level_dn)
    # Above 3 the shortest exposure comes near white itself.
    judged = fused.usable & (ramp < 3.0)
    assert judged[:, ramp[0] < 3.0].all()
    score = (fused.dn_per_s - true_rate(ramp)) / np.sqrt(fused.variance)
    by_level = np.array_split(score[:, ramp[0] < 3.0], 16, axis=1)
    for part in by_level:
        # Dark noise is shared by a pixel's exposures, not by pixels: the scores are independent.
        assert abs(part.mean()) < 5 / np.sqrt(part.size) + 0.02
        assert part.std() == pytest.approx(1, abs=0.06)


def test_the_bracket_beats_its_single_exposures(ramp):
    rng = np.random.default_rng(1)
    dark = dark_frame(ramp.shape, rng)
    frames = bracket_of(ramp, rng)
    fused = fuse(frames, EXPOSURES_S, dark, GAIN, NOISE.white_level_dn)
    shadow, light = ramp[0] < 0.01, (ramp[0] > 1.2) & (ramp[0] < 3)
    truth = true_rate(ramp)

    def error(rate, where):
        return np.sqrt(np.mean((rate[:, where] - truth[:, where]) ** 2))

    alone = [(f - dark.mean_dn) / t for f, t in zip(frames, EXPOSURES_S, strict=True)]
    assert error(fused.dn_per_s, shadow) < 0.2 * error(alone[0], shadow)
    assert error(fused.dn_per_s, light) < 0.2 * error(alone[2], light)
    assert error(fused.dn_per_s, light) < 1.02 * error(alone[0], light)


def test_a_pixel_saturated_in_every_exposure_is_not_usable():
    rng = np.random.default_rng(2)
    readings = np.full((8, 8), 0.1)
    readings[3, 4] = 50.0
    fused = fuse(
        bracket_of(readings, rng), EXPOSURES_S, dark_frame((8, 8), rng), GAIN, NOISE.white_level_dn
    )
    assert not fused.usable[3, 4]
    assert np.isinf(fused.variance[3, 4])
    assert fused.usable.sum() == 63
    # It says only that there was at least as much light as fills it in the shortest exposure.
    fills = (NOISE.white_level_dn - NOISE.black_level_dn) / EXPOSURES_S[0]
    assert fused.dn_per_s[3, 4] == pytest.approx(fills, rel=0.01)


def test_a_dead_pixel_says_nothing_however_bright_it_is():
    rng = np.random.default_rng(2)
    readings = np.full((8, 8), 50.0)
    dead = np.zeros((8, 8), bool)
    dead[3, 4] = True
    dark = dark_frame((8, 8), rng)
    frames = bracket_of(readings, rng)
    fused = fuse(frames, EXPOSURES_S, dark, GAIN, NOISE.white_level_dn, dead)
    assert fused.dn_per_s[3, 4] == 0
    assert (fused.dn_per_s[~dead] > 0).all()


def test_repeats_of_one_exposure_divide_the_variance():
    rng = np.random.default_rng(3)
    readings = np.full((40, 50), 0.2)
    dark = dark_frame(readings.shape, rng)
    frames = bracket_of(readings, rng, [0.02] * 9)
    many = fuse(frames, [0.02] * 9, dark, GAIN, NOISE.white_level_dn)
    one = fuse(frames[:1], [0.02], dark, GAIN, NOISE.white_level_dn)
    shared = GAIN.dark_variance_dn2 / DARKS / 0.02**2
    assert np.median(one.variance - shared) == pytest.approx(
        9 * np.median(many.variance - shared), rel=0.05
    )


def test_the_order_of_the_exposures_does_not_matter(ramp):
    rng = np.random.default_rng(4)
    dark = dark_frame(ramp.shape, rng)
    frames = bracket_of(ramp, rng)
    one = fuse(frames, EXPOSURES_S, dark, GAIN, NOISE.white_level_dn)
    other = fuse(frames[::-1], EXPOSURES_S[::-1], dark, GAIN, NOISE.white_level_dn)
    np.testing.assert_array_equal(one.dn_per_s, other.dn_per_s)


def test_a_bracket_without_frames_is_reported():
    dark = dark_frame((4, 4), np.random.default_rng(0))
    with pytest.raises(CalibrationError, match="needs frames"):
        fuse([], [], dark, GAIN, 4095)
    with pytest.raises(CalibrationError, match="differ in size"):
        fuse([np.zeros((4, 5), np.uint16)], [0.1], dark, GAIN, 4095)

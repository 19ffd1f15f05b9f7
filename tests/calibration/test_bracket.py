"""Brackets: a linear frame with the variance that it really has."""

import numpy as np
import pytest

from emmc_rig.calibration.bracket import fuse
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import DARK_ELECTRONS_PER_S, SensorGain, average
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


def dark_frames(size, rng, exposures_s=EXPOSURES_S, electrons_per_s=0.0):
    """Darks of each exposure; their noise is that of GAIN."""
    found = []
    for exposure_s in exposures_s:
        current = np.full(size, electrons_per_s / NOISE.electrons_per_s)
        frames = [NOISE.expose_dn(current, exposure_s, 1.0, rng) for _ in range(DARKS)]
        found.append(average(frames, exposure_s, NOISE.white_level_dn, "dark"))
    return found


def bracket_of(readings, rng, exposures_s=EXPOSURES_S):
    return [NOISE.expose_dn(readings, exposure_s, 1.0, rng) for exposure_s in exposures_s]


def fused(frames, darks, exposures_s=EXPOSURES_S):
    return fuse(frames, exposures_s, darks, GAIN, NOISE.white_level_dn)


def true_rate(readings):
    return NOISE.gain_dn_per_electron * NOISE.electrons_per_s * readings


@pytest.fixture
def ramp():
    """Readings from deep shadow to four times what the longest exposure can hold."""
    return np.geomspace(0.0005, 4.0, 400)[None].repeat(300, axis=0)


def test_the_fused_rate_is_unbiased_and_its_deviation_is_true(ramp):
    rng = np.random.default_rng(0)
    darks = dark_frames(ramp.shape, rng)
    rate, variance, usable = fused(bracket_of(ramp, rng), darks)
    # Above 3 the shortest exposure comes near white itself.
    judged = usable & (ramp < 3.0)
    assert judged[:, ramp[0] < 3.0].all()
    score = (rate - true_rate(ramp)) / np.sqrt(variance)
    by_level = np.array_split(score[:, ramp[0] < 3.0], 16, axis=1)
    for part in by_level:
        # Dark noise is shared by a pixel's exposures, not by pixels: the scores are independent.
        assert abs(part.mean()) < 5 / np.sqrt(part.size) + 0.02
        assert part.std() == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize(
    "darks_s",
    [EXPOSURES_S, (0.005, 0.08), (0.005, 0.02), (0.04,)],
    ids=["own", "ends", "beyond", "one"],
)
def test_dark_current_is_subtracted_of_every_exposure_or_counted_as_unknown(darks_s):
    """A hundredth of white of dark current, as much as a tenth of the darkest readings."""
    rng = np.random.default_rng(5)
    electrons_per_s = 2000.0 if len(darks_s) > 1 else DARK_ELECTRONS_PER_S
    readings = np.geomspace(0.01, 0.9, 200)[None].repeat(300, axis=0)
    lit = readings + electrons_per_s / NOISE.electrons_per_s
    darks = dark_frames(readings.shape, rng, darks_s, electrons_per_s)
    rate, variance, usable = fused(bracket_of(lit, rng), darks)
    score = ((rate - true_rate(readings)) / np.sqrt(variance))[usable]
    if len(darks_s) > 1:
        assert abs(score.mean()) < 0.02
        assert score.std() == pytest.approx(1, abs=0.03)
    else:
        assert abs(score.mean()) < 1


def test_a_pixel_saturated_in_every_exposure_is_not_usable():
    rng = np.random.default_rng(2)
    readings = np.full((8, 8), 0.1)
    readings[3, 4] = 50.0
    rate, variance, usable = fused(bracket_of(readings, rng), dark_frames((8, 8), rng))
    assert not usable[3, 4]
    assert np.isinf(variance[3, 4])
    assert usable.sum() == 63
    # The least light that fills the pixel in the shortest exposure.
    fills = (NOISE.white_level_dn - NOISE.black_level_dn) / EXPOSURES_S[0]
    assert rate[3, 4] == pytest.approx(fills, rel=0.01)


def test_repeats_of_one_exposure_divide_the_variance():
    rng = np.random.default_rng(3)
    readings = np.full((40, 50), 0.2)
    darks = dark_frames(readings.shape, rng)
    frames = bracket_of(readings, rng, [0.02] * 9)
    _, of_many, _ = fused(frames, darks, [0.02] * 9)
    _, of_single, _ = fused(frames[:1], darks, [0.02])
    shared = GAIN.dark_variance_dn2 / DARKS / 0.02**2
    assert np.median(of_single - shared) == pytest.approx(9 * np.median(of_many - shared), rel=0.05)


def test_a_bracket_without_frames_is_reported():
    darks = dark_frames((4, 4), np.random.default_rng(0))
    with pytest.raises(CalibrationError, match="needs frames"):
        fuse([], [], darks, GAIN, 4095)
    with pytest.raises(CalibrationError, match="differ in size"):
        fuse([np.zeros((4, 5), np.uint16)], [0.1], darks, GAIN, 4095)

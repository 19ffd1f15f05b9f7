"""EMVA 1288 from dark and flat frames of a sensor whose figures are known."""

import numpy as np
import pytest

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.sensor import Pair, characterise
from emmc_rig.model.noise import SensorNoise
from emmc_rig.simulators.flaws import SensorFlaws

SIZE = (120, 160)
WHITE_DN = 65_535
NOISE = SensorNoise(black_level_dn=256, gain_dn_per_electron=0.8, read_noise_electrons=2.5)
FLAWS = SensorFlaws(
    response_spread=0.01,
    offset_spread_dn=1.5,
    dark_electrons_per_s=12.0,
    bad_share=0.002,
    full_well_electrons=50_000.0,
)
DARKS_S = (0.01, 2.0)
FLATS_S = (0.005, 0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3)


def frames(flaws=FLAWS, lit=True, times=FLATS_S, seed=0):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    tile = np.array([[0.6, 1.0], [1.0, 0.7]])[y % 2, x % 2]
    falloff = 1 - 0.1 * ((x / SIZE[1] - 0.5) ** 2 + (y / SIZE[0] - 0.4) ** 2)
    reading = tile * falloff if lit else np.zeros(SIZE)
    return [
        Pair(t, *(flaws.expose_dn(NOISE, reading, t, 1.0, rng) for _ in range(2))) for t in times
    ]


@pytest.fixture(scope="module")
def sheet():
    return characterise(frames(lit=False, times=DARKS_S), frames(), WHITE_DN)


def within(sheet, name, truth, deviations=4.0, floor=0.0):
    assert abs(getattr(sheet, name) - truth) < deviations * sheet.deviations[name] + floor


def test_the_gain_is_the_slope_of_the_photon_transfer_curve(sheet):
    within(sheet, "gain_dn_per_electron", 0.8)
    assert sheet.deviations["gain_dn_per_electron"] < 0.02


def test_a_sensor_behind_colour_filters_needs_no_remark(sheet):
    assert sheet.remarks == ()


def test_read_noise_black_level_and_dark_current_come_out(sheet):
    within(sheet, "read_noise_electrons", 2.5)
    assert sheet.read_noise_electrons == pytest.approx(2.5, rel=0.05)
    within(sheet, "black_level_dn", 256.0, floor=0.1)
    within(sheet, "dark_current_electrons_per_s", 12.0)
    assert sheet.dark_current_electrons_per_s == pytest.approx(12, rel=0.05)


def test_the_full_well_is_where_every_pixel_is_full_whatever_the_steps_of_exposure(sheet):
    assert sheet.full_well_electrons == pytest.approx(50_000, rel=0.01)
    assert sheet.snr_max_db == pytest.approx(10 * np.log10(sheet.full_well_electrons))
    noise_floor = np.sqrt(2.5**2 + 1 / 12 / 0.8**2) + 0.5
    expected = 20 * np.log10(sheet.full_well_electrons / noise_floor)
    assert sheet.dynamic_range_db == pytest.approx(expected, abs=0.5)


def test_the_pixels_own_differences_are_separated_from_noise_and_lamp(sheet):
    for differences, scale, truth in ((sheet.prnu, 100, 1.0), (sheet.dsnu, 1, 1.5)):
        value, deviation = differences.figure(scale)
        assert abs(value - truth) < 4 * deviation
        assert value == pytest.approx(truth, rel=0.05)


def test_the_stated_deviation_of_dsnu_is_that_of_repeated_measurements():
    found = []
    for seed in range(10):
        flaws = SensorFlaws(offset_spread_dn=1.5, full_well_electrons=50_000.0, seed=seed)
        sheet = characterise(
            frames(flaws, lit=False, times=DARKS_S, seed=seed), frames(flaws, seed=50), WHITE_DN
        )
        found.append(sheet.dsnu.figure(1.0))
    values, stated = np.transpose(found)
    assert 0.5 < np.std(values, ddof=1) / np.mean(stated) < 1.8


def test_pixels_that_differ_more_behind_one_filter_in_four_count_a_quarter_in_the_variance():
    rng = np.random.default_rng(3)
    offsets = rng.normal(0, 15, SIZE)
    offsets[::2, ::2] = rng.normal(0, 40, (SIZE[0] // 2, SIZE[1] // 2))
    expected = np.sqrt((40**2 + 3 * 15**2) / 4)
    darks = [
        Pair(t, *(np.rint(1000 + offsets + rng.normal(0, 2, SIZE)).astype(np.uint16) for _ in "ab"))
        for t in DARKS_S
    ]
    found = characterise(darks, frames(), WHITE_DN).dsnu
    assert found.figure(1.0)[0] == pytest.approx(expected, rel=0.05)


def test_read_noise_below_the_steps_of_the_converter_is_an_upper_bound():
    noise = SensorNoise(
        black_level_dn=64, gain_dn_per_electron=0.05, read_noise_electrons=2.5, white_level_dn=4095
    )

    def pairs(times, lit):
        rng = np.random.default_rng(1)
        reading = np.full(SIZE, float(lit))
        return [
            Pair(t, *(FLAWS.expose_dn(noise, reading, t, 1.0, rng) for _ in range(2)))
            for t in times
        ]

    found = characterise(pairs(DARKS_S, False), pairs(FLATS_S, True), 4095)
    assert found.read_noise_electrons == pytest.approx(0.40 / 0.05, rel=0.05)
    assert any(row.title.startswith("Temporal dark noise, at most (below") for row in found.rows())


def test_hot_and_dead_pixels_are_those_that_are(sheet):
    hot, dead = FLAWS.bad(SIZE)
    assert sheet.hot_pixels == hot.sum()
    assert sheet.dead_pixels == dead.sum()
    np.testing.assert_array_equal(sheet.good, ~(hot | dead))


def test_a_straight_sensor_is_straight_and_a_bent_one_bends():
    darks = frames(lit=False, times=DARKS_S)
    straight = characterise(darks, frames(), WHITE_DN)
    bent_flaws = SensorFlaws(full_well_electrons=50_000.0, bend=0.08)
    bent = characterise(frames(bent_flaws, lit=False, times=DARKS_S), frames(bent_flaws), WHITE_DN)
    assert straight.linearity_error_percent < 0.3
    assert bent.linearity_error_percent > 1.0


def test_the_stated_deviation_of_the_gain_is_that_of_repeated_measurements():
    gains, stated = [], []
    for seed in range(8):
        sheet = characterise(
            frames(lit=False, times=DARKS_S, seed=100 + seed), frames(seed=seed), WHITE_DN
        )
        gains.append(sheet.gain_dn_per_electron)
        stated.append(sheet.deviations["gain_dn_per_electron"])
    assert 0.5 < np.std(gains, ddof=1) / np.mean(stated) < 1.8


DARKS = frames(lit=False, times=DARKS_S)


@pytest.mark.parametrize(
    ("darks", "flats", "complaint"),
    [
        (DARKS[:1], FLATS_S, "two exposures at least"),
        (DARKS, FLATS_S[:3], "3 flat exposures"),
        (DARKS, None, r"brighter|below 70 %|between 5 and 95"),
        (DARKS, [Pair(1.0, DARKS[0].first[:50], DARKS[0].second[:50])] * 4, "of one camera"),
    ],
)
def test_too_few_exposures_no_light_and_other_sizes_are_refused(darks, flats, complaint):
    if flats is None:
        flats = frames(lit=False, times=FLATS_S[:5])
    elif isinstance(flats, tuple):
        flats = frames(times=flats)
    with pytest.raises(CalibrationError, match=complaint):
        characterise(darks, flats, WHITE_DN)

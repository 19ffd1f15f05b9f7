"""The sensor sheet of an outside simulator: right within its deviations, or marked."""

from typing import Any

import numpy as np
import pytest
from outside_sensor import Chip
from sheet_table import FLATS_S, KINDS, PATTERNS, clean_kinds, misses, sheet_of

from emmc_rig.calibration.boards import BoardSet, sensor_blemishes
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import average, photon_transfer, step_of_values
from emmc_rig.calibration.sensor import Pair, characterise

OF_CLIPPED = (
    "black_level_dn dark_current_electrons_per_s dsnu dynamic_range_db read_noise_electrons "
    "saturation_dn"
)
OF_GAIN = (
    "dark_current_electrons_per_s dsnu dynamic_range_db full_well_electrons gain_dn_per_electron "
    "prnu read_noise_electrons snr_max_db"
)
OF_STEPS = "dsnu dynamic_range_db read_noise_electrons"
OF_WELL = "dynamic_range_db full_well_electrons saturation_dn snr_max_db"
MARKED = {
    "steps of 16 DN": OF_STEPS,
    "steps of 16 DN, read noise 1 e": OF_STEPS,
    "black drifts by 4 DN": "black_level_dn dark_current_electrons_per_s",
    "black creeps by 4 DN": f"{OF_GAIN} black_level_dn linearity_error_percent saturation_dn",
    "lag 0.5 %": f"{OF_GAIN} linearity_error_percent",
    "bend 2 %": OF_GAIN,
    "square-root coding": f"{OF_GAIN} black_level_dn linearity_error_percent saturation_dn",
    "charge shared, 2 % a side": f"{OF_GAIN} hot_pixels",
}


def marks(chip, sheet):
    return {name for name in chip.truth(FLATS_S) if sheet.remark(name)}


def worst(chip, sheet, flats_s=FLATS_S):
    """Return the greatest error in deviations of the quantities without a mark, and its name."""
    missed = misses(chip, sheet, flats_s)
    return max((abs(by), name) for name, by in missed.items() if not sheet.remark(name))


@pytest.mark.parametrize("kind", KINDS)
def test_every_value_is_right_within_its_deviation_or_marked(kind):
    chip = Chip(seed=4, **KINDS[kind])
    sheet = sheet_of(chip)
    assert worst(chip, sheet) < (3.5, "")
    assert marks(chip, sheet) == set(MARKED.get(kind, "").split())


@pytest.mark.parametrize(
    ("changes", "flats_s", "marked"),
    [
        ({"flicker": 0.002}, FLATS_S, ""),
        ({"flicker": 0.005}, FLATS_S, ""),
        ({"flicker": 0.02}, FLATS_S, ""),
        ({"falls_off": 0.45}, FLATS_S, ""),
        ({"falls_off": 0.45}, FLATS_S[:8], OF_WELL),
        ({"falls_off": 0.45}, (*FLATS_S[:7], 0.28, 0.32), ""),
        ({"black_dn": 0.0}, FLATS_S, OF_CLIPPED),
        ({"black_dn": 1.0}, FLATS_S, OF_CLIPPED),
        ({"gain": 0.05, "read_noise": 1.0}, FLATS_S, OF_STEPS),
    ],
)  # fmt: skip
def test_lamp_lens_and_converter_are_told_from_the_sensor(changes, flats_s, marked):
    chip = Chip(seed=3, **changes)
    sheet = sheet_of(chip, flats_s)
    assert marks(chip, sheet) == set(marked.split())
    assert worst(chip, sheet, flats_s) < (3.5, "")


@pytest.mark.parametrize("kind", clean_kinds())
def test_a_clean_sensor_of_any_gain_and_bits_is_marked_for_its_steps_alone(kind):
    chip = Chip(seed=8, **clean_kinds()[kind])
    sheet = sheet_of(chip)
    steps = chip.gain * chip.read_noise < 0.4
    assert marks(chip, sheet) == set(OF_STEPS.split() if steps else ())
    assert worst(chip, sheet) < (3.5, "")


def test_values_times_sixteen_have_the_same_sheet_in_electrons():
    chip = Chip(seed=1)
    frames = {
        lit: [(t, [chip.take(t, lit), chip.take(t, lit)]) for t in times_s]
        for lit, times_s in ((False, (0.01, 2.0)), (True, FLATS_S))
    }

    def sheet(times, plus, white_dn):
        darks, flats = (
            [Pair(t, *(frame * times + plus for frame in both)) for t, both in frames[lit]]
            for lit in (False, True)
        )
        return characterise(darks, flats, white_dn)

    plain, coarse = (
        sheet(np.uint16(1), np.uint16(0), 4095),
        sheet(np.uint16(4), np.uint16(7), 16387),
    )
    assert (plain.step_dn, coarse.step_dn) == (1.0, 4.0)
    for name, deviation in plain.deviations.items():
        if name.endswith("_electrons") or name in ("dsnu", "prnu", "snr_max_db"):
            value, same = (
                by.between_pixels(name) if name in PATTERNS else getattr(by, name)
                for by in (plain, coarse)
            )
            assert same == pytest.approx(value, rel=1e-6)
            assert coarse.deviations[name] == pytest.approx(deviation, rel=1e-6)
    np.testing.assert_array_equal(plain.good, coarse.good)


@pytest.mark.parametrize(
    ("coded", "step"),
    [
        (lambda twelve_bits: twelve_bits << 4, 16),
        (lambda twelve_bits: (twelve_bits << 4) + 7, 16),
        (lambda twelve_bits: twelve_bits << 4 | twelve_bits >> 8, 16),
        (lambda twelve_bits: twelve_bits, 1),
    ],
)
@pytest.mark.parametrize("noise_dn", [0.3, 1.0, 5.0])
def test_the_step_of_values_is_that_of_the_converter_behind_any_packing(coded, step, noise_dn):
    noise = np.random.default_rng(1).normal(300.3, noise_dn, (100, 100))
    noise[::40, ::40] = 3000
    frame = coded(np.rint(noise).astype(np.uint16)).astype(np.uint16)
    assert step_of_values([frame]) == step


def test_a_digital_gain_that_rounds_has_a_mean_step():
    read = np.rint(np.random.default_rng(1).normal(300, 10, (100, 100)))
    assert step_of_values([np.rint(1.37 * read).astype(np.uint16)]) == pytest.approx(1.37, rel=0.05)


def test_frames_that_read_one_value_show_no_step():
    assert np.isnan(step_of_values([np.full((10, 10), 64, np.uint16)]))


def test_noise_below_the_steps_in_the_light_too_is_refused():
    chip = Chip(step=256.0, white_dn=65535, gain=0.3, read_noise=1.0, prnu=0.0)
    with pytest.raises(
        CalibrationError, match=r"noise above the steps of the converter \(256 DN\)"
    ):
        sheet_of(chip)


def test_rows_that_flicker_make_dsnu_less_sure_and_not_less():
    missed = []
    for seed in range(6):
        chip = Chip(row_noise=3.0, seed=seed)
        sheet = sheet_of(chip)
        missed.append(misses(chip, sheet)["dsnu"])
        assert sheet.read_noise_electrons == pytest.approx(np.hypot(3, 3), rel=0.1)
    assert np.sqrt(np.mean(np.square(missed))) < 1.8
    assert np.abs(np.mean(missed)) < 1.2


def test_bounds_hold_and_are_named_in_the_table():
    bounds: list[tuple[dict[str, Any], str]] = [
        ({"black_dn": 0.0}, "at least (the darks are clipped at 0 DN"),
        ({"gain": 0.05, "read_noise": 1.0}, "at most (below the steps of the converter"),
    ]
    for changes, words in bounds:
        chip = Chip(**changes)
        rows = {row.quantity: row for row in sheet_of(chip).rows()}
        for name, truth in (("Temporal dark noise", chip.read_noise), ("DSNU", chip.dsnu)):
            assert words in rows[name].remark
            value = rows[name].value
            assert value < truth if "at least" in words else value > truth


def test_the_deviations_of_the_sheet_are_those_of_repeated_measurements():
    every = []
    for seed in range(12):
        chip = Chip(seed=seed)
        missed = misses(chip, sheet_of(chip))
        # A black level that may creep makes saturation less sure; this sensor is steady.
        without = "hot_pixels", "dead_pixels", "saturation_dn"
        every.append([by for name, by in missed.items() if name not in without])
    spread = np.sqrt(np.mean(np.square(every), axis=0))
    assert spread.max() < 2.0
    assert spread.min() > 0.2


@pytest.mark.parametrize("read_noise", [0.5, 3.0, 20.0])
@pytest.mark.parametrize("black_dn", [2045.0, 2050.0, 2053.0])
def test_calibration_takes_steps_of_16_dn_for_no_hot_pixels_and_knows_its_noise(
    black_dn, read_noise
):
    chip = Chip(**KINDS["steps of 16 DN"] | {"black_dn": black_dn, "read_noise": read_noise})
    darks = tuple(
        average((chip.take(t, False) for _ in range(4)), t, chip.white_dn, "dark", lit=False)
        for t in (0.2, 2.0)
    )
    white = average((chip.take(0.2) for _ in range(4)), 0.2, chip.white_dn, "white")
    boards = BoardSet(darks, {(0, "white"): white}, ())
    assert [dark.step_dn for dark in darks] == [16, 16]
    np.testing.assert_array_equal(sensor_blemishes(boards), ~(chip.is_hot | chip.is_dead))
    gain = photon_transfer(darks[0], white)
    assert gain.gain_dn_per_electron == pytest.approx(chip.gain, rel=0.03)
    # No pixel is surer than rounding lets it be.
    least, rounding = chip.gain**2 * read_noise**2, 16**2 / 12
    assert max(least, rounding) <= 1.03 * gain.dark_variance_dn2
    assert gain.dark_variance_dn2 < 1.1 * (least + 16**2 / 4)

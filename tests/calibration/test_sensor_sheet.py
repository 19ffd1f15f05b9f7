"""The sensor sheet of an outside simulator: right within its deviations, or marked."""

from typing import Any

import numpy as np
import pytest
from outside_sensor import Chip

from emmc_rig.calibration.boards import BoardSet, sensor_blemishes
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import average, photon_transfer, step_of_values
from emmc_rig.calibration.sensor import PATTERNS, Pair, characterise

FLATS_S = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
DARKS_S = (0.01, 1.0, 10.0)
COARSE = {"gain": 1.0, "white_dn": 65535, "black_dn": 2050.0, "step": 16.0}
KINDS: dict[str, dict[str, Any]] = {
    "clean": {},
    "flicker 1 %": {"flicker": 0.01},
    "steps of 16 DN": COARSE,
    "steps of 16 DN, read noise 1 e": COARSE | {"read_noise": 1.0, "black_dn": 2003.0},
    "steps of 16 DN, read noise 8 e": COARSE | {"read_noise": 8.0},
    "steps of 16 DN, read noise 20 e": COARSE | {"read_noise": 20.0},
    "black drifts by 4 DN": {"black_drift_dn": 4.0},
    "black creeps by 4 DN": {"black_creep_dn": 4.0},
    "lag 0.5 %": {"lag": 0.005},
    "bend 2 %": {"bend": 0.02},
    "square-root coding": {"root": 30.0},
    "charge shared, 2 % a side": {"to_each_side": 0.02},
    "charge shared, 0.3 % a side": {"to_each_side": 0.003},
    "odd columns 8 e": {"column_electrons": 8.0},
    "odd columns 1 %": {"column_response": 0.01},
    "dark current 500 e/s": {"dark_per_s": 500.0},
    "rows 3 e": {"row_noise": 3.0},
}

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


def sheet_of(chip, flats_s=FLATS_S, darks_s=DARKS_S):
    """Return the sheet of a sensor: darks first, flats from dim to bright."""
    darks, flats = (
        [Pair(t, chip.take(t, lit), chip.take(t, lit)) for t in times_s]
        for times_s, lit in ((darks_s, False), (flats_s, True))
    )
    return characterise(darks, flats, chip.white_dn, monochrome=True)


def misses(chip, sheet, flats_s=FLATS_S):
    """Return (value - truth) / deviation of each quantity; counts are to be exact."""
    found = {}
    for name, truth in chip.truth(flats_s).items():
        value = sheet.between_pixels(name) if name in PATTERNS else getattr(sheet, name)
        found[name] = (value - truth) / sheet.deviations.get(name, 1 / 3)
    return found


def clean_kinds():
    """Return clean sensors: gains in DN per electron, bits, read noises, steps of several."""
    found = {}
    sensors = (8, 0.05), (10, 0.1), (12, 0.05), (12, 0.25), (14, 0.8), (16, 4.0), (16, 16.0)
    for bits, gain in sensors:
        for read in (1.0, 3.0, 10.0):
            white = 2**bits - 1
            well = min(60_000.0, 0.9 * white / gain)
            found[f"{bits} bits, {gain:g} DN/e, {read:g} e"] = {
                "white_dn": white, "gain": gain, "read_noise": read, "full_well": well,
                "black_dn": float(2 ** (bits - 5)), "electrons_per_s": well / 0.31,
            }  # fmt: skip
    return found


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


def test_pixels_that_differ_more_behind_one_filter_in_four_count_a_quarter_in_the_variance():
    chip, rng = Chip(), np.random.default_rng(3)
    offsets = rng.normal(0, 15, chip.size)
    offsets[::2, ::2] = rng.normal(0, 40, (chip.size[0] // 2, chip.size[1] // 2))
    chip.offset = offsets / chip.gain
    found = sheet_of(chip).dsnu
    assert found.figure(1.0)[0] == pytest.approx(np.sqrt((40**2 + 3 * 15**2) / 4), rel=0.05)


@pytest.mark.parametrize(
    ("darks_s", "flats_s", "electrons_per_s", "complaint"),
    [
        (DARKS_S[:1], FLATS_S, 2e5, "two exposures at least"),
        (DARKS_S, FLATS_S[:3], 2e5, "3 flat exposures"),
        (DARKS_S, FLATS_S, 0.0, "brighter|below 70 %|between 5 and 95"),
    ],
)
def test_too_few_exposures_and_no_light_are_refused(darks_s, flats_s, electrons_per_s, complaint):
    with pytest.raises(CalibrationError, match=complaint):
        sheet_of(Chip(electrons_per_s=electrons_per_s), flats_s, darks_s)


def test_frames_of_another_size_are_refused():
    flats = [Pair(1.0, *np.full((2, 50, 50), 900, np.uint16))] * 4
    darks = [Pair(t, *np.full((2, 60, 50), 64, np.uint16)) for t in DARKS_S]
    with pytest.raises(CalibrationError, match="of one camera"):
        characterise(darks, flats, 4095)

"""The sensor sheet of the outside bench: right within three deviations, or marked as a bound."""

from typing import Any

import numpy as np
import pytest
from outside_bench import Bench, Course, Optics, Sensor

from emmc_rig.calibration.sensor import Pair, characterise

FLATS_S = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
DARKS_S = (0.01, 1.0, 10.0)
SIZE = (120, 160)
SENSOR = {
    "bayer": False, "gain": 0.25, "white_dn": 16383, "black_dn": 512.0, "prnu": 0.01, "dsnu": 3.0,
}  # fmt: skip
OF_DARK = "read_noise_electrons black_level_dn dark_current_electrons_per_s dsnu"
TRUE = {
    "gain_dn_per_electron": "gain",
    "read_noise_electrons": "read_noise",
    "dark_current_electrons_per_s": "dark_per_s",
    "full_well_electrons": "full_well",
}


def sheet_of(flats_s=FLATS_S, course=None, falls_off=0.0, seed=3, **sensor: Any):
    bench = Bench(
        np.ones((1, 1)), SIZE, Optics(views=(1, 1)), Sensor(**(SENSOR | sensor)),
        Course(**(course or {})), seed,
    )  # fmt: skip
    rows, columns = (np.linspace(-1, 1, count) for count in SIZE)
    bench.lens = 1 - falls_off * (rows[:, None] ** 2 + columns**2) / 2

    def pair(exposure_s, lit):
        return Pair(exposure_s, *(bench.take(exposure_s, mask=None, lit=lit) for _ in range(2)))

    sheet = characterise(
        [pair(t, False) for t in DARKS_S], [pair(t, True) for t in flats_s], bench.sensor.white_dn
    )
    return bench.sensor, sheet


def misses(true, sheet):
    """Return by how many deviations each quantity misses the truth, of those that are no bounds."""
    found = {
        name: (getattr(sheet, name) - getattr(true, of)) / sheet.deviations[name]
        for name, of in TRUE.items()
        if not sheet.bound(name)
    }
    for name, differences, scale, truth in (
        ("prnu", sheet.prnu, 1.0, true.prnu),
        ("dsnu", sheet.dsnu, 1 / sheet.gain_dn_per_electron, true.dsnu),
    ):
        if not sheet.bound(name):
            value, deviation = differences.figure(scale)
            found[name] = (value - truth) / deviation
    return found


@pytest.mark.parametrize(
    ("changes", "marked"),
    [
        ({}, ""),
        ({"course": {"flicker": 0.002}}, ""),
        ({"course": {"flicker": 0.005}}, ""),
        ({"course": {"flicker": 0.01}}, ""),
        ({"course": {"flicker": 0.02}}, ""),
        ({"falls_off": 0.45}, ""),
        ({"falls_off": 0.45, "flats_s": FLATS_S[:8]}, "full_well_electrons"),
        ({"falls_off": 0.45, "flats_s": (*FLATS_S[:7], 0.28, 0.32)}, ""),
        ({"black_dn": 0.0}, OF_DARK),
        ({"black_dn": 1.0}, OF_DARK),
        ({"gain": 0.05, "read_noise": 1.0}, "read_noise_electrons dsnu"),
    ],
)  # fmt: skip
def test_what_lamp_lens_and_converter_do_is_told_apart_from_the_sensor(changes, marked):
    true, sheet = sheet_of(**changes)
    bounds = {name for name in [*TRUE, "black_level_dn", "dsnu", "prnu"] if sheet.bound(name)}
    assert bounds == set(marked.split())
    missed = misses(true, sheet)
    assert max(map(abs, missed.values())) < 3.5, missed


def test_rows_that_flicker_make_dsnu_less_sure_and_not_less():
    missed = []
    for seed in range(6):
        true, sheet = sheet_of(row_noise=3.0, seed=seed)
        value, deviation = sheet.dsnu.figure(1 / sheet.gain_dn_per_electron)
        missed.append((value - true.dsnu) / deviation)
        assert sheet.read_noise_electrons == pytest.approx(np.hypot(3, 3), rel=0.15)
    assert np.sqrt(np.mean(np.square(missed))) < 1.8
    assert np.abs(np.mean(missed)) < 1.2


def test_bounds_hold_and_are_named_in_the_table():
    bounds: list[tuple[dict[str, Any], str]] = [
        ({"black_dn": 0.0}, "at least (the darks are clipped at 0 DN"),
        ({"gain": 0.05, "read_noise": 1.0}, "at most (below the steps of the converter"),
    ]
    for changes, words in bounds:
        true, sheet = sheet_of(**changes)
        rows = {row[0].split(",")[0]: row for row in sheet.rows()}
        for name, truth in (("Temporal dark noise", true.read_noise), ("DSNU", true.dsnu)):
            assert words in rows[name][0]
            value = rows[name][1]
            assert value < truth if "at least" in words else value > truth


def test_the_deviations_of_the_sheet_are_those_of_repeated_measurements():
    every = [list(misses(*sheet_of(seed=seed)).values()) for seed in range(12)]
    spread = np.sqrt(np.mean(np.square(every), axis=0))
    assert spread.max() < 2.0
    assert spread.min() > 0.4

"""Table of the sensor sheet's errors in stated deviations, kinds of sensors by quantities.

Run: PYTHONPATH=.:tests/helpers python tests/helpers/sheet_table.py [seeds] [--clean]
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from outside_sensor import Chip

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.sensor import PATTERNS, Pair, SensorSheet, characterise

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
SHORT = {
    "gain_dn_per_electron": "gain", "read_noise_electrons": "read",
    "dark_current_electrons_per_s": "dark", "black_level_dn": "black",
    "full_well_electrons": "well", "saturation_dn": "satur", "linearity_error_percent": "linear",
    "snr_max_db": "snr", "dynamic_range_db": "range", "hot_pixels": "hot", "dead_pixels": "dead",
    "dsnu": "dsnu", "prnu": "prnu",
}  # fmt: skip


def sheet_of(chip: Chip, flats_s: tuple[float, ...] = FLATS_S) -> SensorSheet:
    """Return the sheet of a sensor: darks first, flats from dim to bright."""
    darks, flats = (
        [Pair(t, chip.take(t, lit), chip.take(t, lit)) for t in times_s]
        for times_s, lit in ((DARKS_S, False), (flats_s, True))
    )
    return characterise(darks, flats, chip.white_dn, monochrome=True)


def misses(
    chip: Chip, sheet: SensorSheet, flats_s: tuple[float, ...] = FLATS_S
) -> dict[str, float]:
    """Return (value - truth) / deviation of each quantity; counts are to be exact."""
    found = {}
    for name, truth in chip.truth(flats_s).items():
        value = sheet.between_pixels(name) if name in PATTERNS else getattr(sheet, name)
        found[name] = (value - truth) / sheet.deviations.get(name, 1 / 3)
    return found


def clean_kinds() -> dict[str, dict[str, Any]]:
    """Return clean sensors: gains in DN per electron, bits, read noises, steps of several."""
    found = {}
    for bits, gain in (
        (8, 0.05),
        (10, 0.1),
        (12, 0.05),
        (12, 0.25),
        (14, 0.8),
        (16, 4.0),
        (16, 16.0),
    ):
        for read in (1.0, 3.0, 10.0):
            white = 2**bits - 1
            well = min(60_000.0, 0.9 * white / gain)
            found[f"{bits} bits, {gain:g} DN/e, {read:g} e"] = {
                "white_dn": white, "gain": gain, "read_noise": read, "full_well": well,
                "black_dn": float(2 ** (bits - 5)), "electrons_per_s": well / 0.31,
            }  # fmt: skip
    return found


def main(kinds: dict[str, dict[str, Any]], seeds: int) -> None:
    """Print the root mean square over seeds, and whether all (*) or some (+) mark a quantity.

    The last column counts the seeds with a value neither marked nor within three deviations.
    """
    print(f"{'':32}" + "".join(f"{short:>8}" for short in SHORT.values()) + "  failed")
    for kind, changes in kinds.items():
        rows, marked = [], []
        try:
            for seed in range(seeds):
                chip = Chip(seed=seed, **changes)
                sheet = sheet_of(chip)
                missed = misses(chip, sheet)
                rows.append([missed[name] for name in SHORT])
                marked.append([bool(sheet.remark(name)) for name in SHORT])
        except CalibrationError as fault:
            print(f"{kind:32}refused: {fault}")
            continue
        worst = np.sqrt(np.mean(np.square(rows), axis=0))
        share = np.mean(marked, axis=0)
        failed = (np.abs(rows) > 3) & ~np.array(marked)
        cells = (
            f"{value:7.3g}" + ("*" if by == 1 else "+" if by else " ")
            for value, by in zip(worst, share, strict=True)
        )
        print(f"{kind:32}" + "".join(cells) + f"{failed.any(axis=1).sum():8d}", flush=True)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 6
    main(clean_kinds() if "--clean" in sys.argv else KINDS, count)

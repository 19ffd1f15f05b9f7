"""Psi of benches that share no code with the program is as true as stated, and faults are named.

The benches are those of `tests/helpers/outside_bench.py`: own rays, electrons, DN. Each has its
whiteboards captured, calibrated by every route and compared with its true Psi:

    python benchmarks/outside_benches.py                      # all, 48x64
    python benchmarks/outside_benches.py "plate turned" --size 96x128

A row has the chosen route's true and stated error, the shares of coefficients within one and two
stated deviations, everything that calibration says, and whether its first line, and whether any
line, names what is wrong.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lab
import numpy as np
from matplotlib import pyplot as plt

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from outside_bench import Bench, Course, Optics, Sensor, changed
from outside_boards import Photographer, agreement, bench_of, camera_of

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.routes import Outcome, calibrate
from emmc_rig.store.results import parse_size

ROUTES = ("parametric", "mixed", "free", "combined")
ALL_VIEWS = tuple((v, u) for v in range(5) for u in range(5))
TURNS = 90.0, 180.0, 270.0
REPEATS, REFERENCES, BOARDS, HELD = 4, 3, 3 + len(ALL_VIEWS), 2
"""Frames of each mean; darks and references; whiteboards to fit and to judge by, as
`Photographer.sets` takes them in turn."""
FIRST_BOARD = REPEATS * REFERENCES
FIRST_TURNED = REPEATS * (REFERENCES + BOARDS + HELD) + 1
TRUE = 0.5, 1.5
"""True over stated error, of benches whose stated error counts as true."""
PLACES = 9
"""Moments of a capture with a creeping mask or a warming lens; the Psi of the closest counts."""


@dataclass(frozen=True)
class Case:
    """A bench with its flaws, its whiteboards, and the pattern of the line that names the flaw.

    named: pattern of the line that names what is wrong; empty: nothing is to be said. fault: to be
    mended rather than calibrated; it may be refused.
    """

    named: str = ""
    fault: bool = False
    optics: Mapping[str, Any] = field(default_factory=dict)
    sensor: Mapping[str, Any] = field(default_factory=dict)
    course: Mapping[str, Any] = field(default_factory=dict)
    sets: Mapping[str, Any] = field(default_factory=dict)
    two_masks: bool = False


TURNED, COLOURS = {"turns": TURNS}, {"colours": True}
CASES = {
    "clean": Case(),
    "clean, every whiteboard": Case(sets={**TURNED, **COLOURS}),
    "open whiteboards alone": Case("each view alone", sets={"pinholes": ()}),
    "mask tilted": Case("tilted", optics={"tilt": (0.004, -0.002)}),
    "glass": Case("of glass lie", optics={"glass_um": 100.0}),
    "cells of 0.03 and 0.93, hot pixels": Case(
        optics={"open": 0.93, "closed": 0.03}, sensor={"hot": 0.002}
    ),
    "lens falls off, by colour": Case(
        "same on every side", optics={"falloff": 4.0, "colour_falloff": 1.0}
    ),
    "aperture cells unequal": Case(optics={"aperture": 0.05}),
    "aberrations": Case("aberration", optics={"astray_um": 0.3}),
    "diffraction": Case(optics={"diffraction": True}),
    "glare before the filters": Case("glare", optics={"glare": 0.01}),
    "glare behind the filters": Case("glare", optics={"glare_after": 0.01}),
    "glare before, coloured lamps": Case("glare", optics={"glare": 0.01}, sets=COLOURS),
    "glare behind, coloured lamps": Case("glare", optics={"glare_after": 0.01}, sets=COLOURS),
    "crosstalk, coloured lamps": Case("filters pass", sensor={"crosstalk": 0.05}, sets=COLOURS),
    "rows err": Case(sensor={"row_noise": 6.0, "row_correlation": 0.8}),
    "pixels differ": Case(sensor={"prnu": 0.02, "dsnu": 10.0}),
    "dark current": Case(sensor={"dark_per_s": 500.0}),
    "odd columns": Case(sensor={"odd_gain": 0.03, "odd_dn": 3.0}),
    "exposures differ": Case(course={"shutter": 0.003}),
    "board uneven": Case("board is uneven", optics={"board": 0.1}, sets=TURNED),
    "lamp from a side": Case("one side", optics={"lamp_side": 0.1}, sets=TURNED),
    "board glossy": Case("glossy", optics={"gloss": 0.1}, sets=TURNED),
    "board turns with the lamp": Case(
        "uneven", optics={"lamp_side": 0.1, "turns": "both"}, sets=TURNED
    ),
    "board does not turn": Case(
        "one side", optics={"board": 0.1, "turns": "neither"}, sets=TURNED
    ),
    "mask moves 0.5 um": Case(
        "mask moved", course={"moves_um": ((FIRST_TURNED, 0.5),)}, sets=TURNED
    ),
    "lens warms": Case(course={"focus_um": 1.0}),
    "round pupil": Case("pupil", optics={"pupil_um": 9000.0, "pupil_at_um": (100.0, -60.0)}),
    "round pupil within the views": Case("pupil", optics={"pupil_um": 7500.0}),
    "rim before a round pupil": Case(
        "a rim", optics={"pupil_um": 9000.0, "rim_um": 8500.0, "rim_shift": -1.0}
    ),
    "rim alone": Case("a rim", optics={"rim_um": 8000.0, "rim_shift": -0.5}),
    "round pupil, glare, plate turned": Case(
        "plate is turned",
        True,
        optics={"pupil_um": 9000.0, "glare_after": 0.01, "plate_turn_deg": 2.0},
    ),
    "two masks": Case(two_masks=True),
    "dust moves": Case(
        "dust moved", True, course={"dust": 5, "dust_from": FIRST_BOARD}
    ),
    "mask moves 3 um": Case(
        "mask moved", True, course={"moves_um": ((FIRST_TURNED, 3.0),)}, sets=TURNED
    ),
    "stage has backlash": Case("mask is not where", True, course={"backlash_um": 3.0}),
    "mask creeps": Case("drifts", True, course={"creep_um": 0.1}),
    "lamp flickers": Case("lamp", True, course={"flicker": 0.02}),
    "rows flicker": Case("lamp flickers", True, course={"rolling": 0.02}),
    "hands 100 um": Case("off their holes", True, course={"hands_um": 100.0}),
    "hands 300 um": Case("off their holes", True, course={"hands_um": 300.0}),
    "pinhole in the hole beside": Case(
        "hole", True, course={"beside": ((1, 2), (1, 3))}
    ),
    "holes unequal": Case("holes", True, optics={"holes": 0.05}),
    "plate turned": Case("plate is turned", True, optics={"plate_turn_deg": 2.0}),
    "plate moved": Case("plate stands", True, optics={"plate_at_um": (150.0, -100.0)}),
    "pinhole exposures longer": Case("exposures through", True, course={"pinhole_longer": 0.02}),
    "gamma": Case("response|linear", True, sensor={"gamma": 0.9}),
}  # fmt: skip
"""By name; the benches of what may be calibrated first."""


def measure(bench: str, size: tuple[int, int], seed: int) -> dict[str, Any]:
    """Return a row of the CSV: see the module."""
    case = CASES[bench]
    optics = Optics(**case.optics)
    camera = camera_of(optics)
    built = bench_of(
        camera, size, optics=optics, sensor=Sensor(**case.sensor), course=Course(**case.course),
        seed=seed,
    )  # fmt: skip
    routes = ROUTES if "pinholes" not in case.sets else ROUTES[:2]
    if case.two_masks:
        camera, built, routes = *_second_mask(camera, built), ("free",)
    try:
        sets = Photographer(built).sets(**{"pinholes": ALL_VIEWS, **case.sets})
        found, seconds = lab.timed(calibrate, camera, camera.psi(size), routes, **sets)
    except CalibrationError as refused:
        said = str(refused)
        return {
            "route": "", "true": None, "stated": None, "ratio": None, "within_1": None,
            "within_2": None, "stated_true": None, "cpu_s": None,
            "named_first": bool(case.named and re.search(case.named, said)),
            "named": bool(case.named and re.search(case.named, said)),
            "said": f"REFUSED: {said}", "fault": case.fault,
        }  # fmt: skip
    lines = [*found.advice, *found.findings]
    unwatched = [line for line in found.unwatched if "each view alone" in line]
    agreed = _agreement(built, found)
    ratio = agreed["true"] / agreed["stated"]
    return {
        "route": found.chosen,
        "true": agreed["true"],
        "stated": agreed["stated"],
        "ratio": ratio,
        "within_1": agreed["within_1"],
        "within_2": agreed["within_2"],
        "stated_true": TRUE[0] <= ratio <= TRUE[1],
        "cpu_s": seconds,
        "named_first": _names(case.named, (lines or unwatched)[:1]),
        "named": _names(case.named, [*lines, *unwatched]),
        "said": " | ".join([*lines, *unwatched]),
        "fault": case.fault,
    }


def _names(pattern: str, lines: list[str]) -> bool:
    """Return whether lines say what is wrong; without a pattern, whether nothing is said."""
    return any(re.search(pattern, line) for line in lines) if pattern else not lines


def _second_mask(camera: Any, built: Bench) -> tuple[Any, Bench]:
    """Return camera and bench with another mask halfway to the sensor."""
    described = camera.model_dump(mode="json", exclude_none=True)
    mask = described["masks"]["mask"]
    described["masks"]["behind"] = {
        **mask, "distance_mm": 0.5, "pattern": {"kind": "random_binary", "seed": 2},
    }  # fmt: skip
    cells = (np.random.default_rng(2).random(built.cells.shape[:2]) < 0.5).astype(float)
    two = changed(built)
    return type(camera).model_validate(described), Bench(
        two.cells, two.size, two.optics, two.sensor, two.course, two.seed, behind=cells
    )


def _agreement(built: Bench, found: Outcome) -> dict[str, float]:
    """Return `agreement` of the chosen Psi; of a bench that changes, at its likeliest moment."""
    known, course = found.calibration, built.course
    moments = [built.taken]
    if course.creep_um or course.focus_um or course.soften_um:
        moments = np.linspace(FIRST_BOARD, built.taken, PLACES).astype(int).tolist()
    agreed = []
    for taken in moments:
        built.taken = taken
        mask = (course.creep_um * taken, 0.0)
        agreed.append(agreement(built, known.psi.weights, known.deviation, found.good, mask))
    return min(agreed, key=lambda errors: errors["true"])


def main() -> None:
    """Measure the benches named, or all, and sum up how many are as asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("bench", nargs="*", help="default: all")
    parser.add_argument("--size", default="48x64", help="rows x columns")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=lab.RESULTS)
    parser.add_argument("--smallest", action="store_true", help="to see that it runs: seconds")
    args = parser.parse_args()
    unknown = set(args.bench) - set(CASES)
    if unknown:
        parser.error(f"no bench {', '.join(sorted(unknown))}; there are: {', '.join(CASES)}")
    names = args.bench or list(CASES)
    size = lab.SMALLEST if args.smallest else parse_size(args.size)
    if args.smallest:
        names = names[:1]
    points = [{"bench": name, "size": size, "seed": args.seed} for name in names]
    rows = lab.measured(points, measure, "outside_benches", args)
    accepted = rows[rows.route.fillna("") != ""]
    within = [
        np.abs(accepted[column].astype(float) - share) < 0.05
        for column, share in (("within_1", 0.683), ("within_2", 0.954))
    ]
    _, axes = plt.subplots(figsize=(7, 0.25 * len(rows) + 1.5))
    axes.barh(accepted.bench, accepted.ratio.astype(float))
    axes.axvspan(*TRUE, alpha=0.2)
    axes.set(xlabel="true over stated error of Psi", xscale="log")
    lab.finished(rows.drop(columns="said"), axes, "outside_benches", args)
    for bench, said in zip(rows.bench, rows.said, strict=True):
        print(f"{bench}: {said}")
    print(
        f"true as stated: {(accepted.stated_true.astype(str) == 'True').sum()} of {len(accepted)}"
    )
    print(f"covered within 5 points: {(within[0] & within[1]).sum()} of {len(accepted)}")
    for column in ("named_first", "named"):
        print(f"{column}: {(rows[column].astype(str) == 'True').sum()} of {len(rows)}")


if __name__ == "__main__":
    main()

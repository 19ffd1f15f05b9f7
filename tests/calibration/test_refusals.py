"""Faulty whiteboards are refused, and the refusal names the fault."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from moved_mask import CAMERA
from whiteboard_bench import BenchTruth, Setting, WhiteboardBench

from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.routes import calibrate
from emmc_rig.captures.board_plan import STAGE_KINDS_UM
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.simulators.flaws import BoardFlaws

SIZE = (32, 48)
TRUTH = BenchTruth(rays_per_view=128)
VIEW = (0, 1)
OPEN = [Setting(stage_um=stage_um) for stage_um in STAGE_KINDS_UM]
PINHOLES = [Setting(pinhole=view, repeats=1) for view in np.ndindex(CAMERA.views)]
HELD_OUT = [Setting(), Setting(stage_um=(-207.0, 118.0))]
ROUTES = ("parametric", "mixed", "free", "combined")


@cache
def design():
    return build_imaging_matrix(CAMERA, SIZE)


class FaultyBench(WhiteboardBench):
    """A bench whose readings are changed: fault(reading, setting, masks_in)."""

    fault = None
    longer = 1.0

    def reading(self, setting, masks_in=True):
        read = super().reading
        return self.fault(read, setting, masks_in) if self.fault else read(setting, masks_in)

    def board_exposure_s(self):
        return self.longer * super().board_exposure_s()


def psi_of(fault=None, camera=CAMERA, truth=TRUTH, longer=1.0, other=None, routes=ROUTES):
    """Calibrate what a bench captures; other: one that half of the pinholes are taken from."""
    bench = FaultyBench(camera, SIZE, truth)
    bench.fault, bench.longer = fault, longer
    every = bench.capture([*OPEN, *PINHOLES, *HELD_OUT])
    frames = list(every.frames)
    first, last = len(OPEN), len(OPEN) + len(PINHOLES)
    if other is not None:
        middle = (first + last) // 2
        frames[middle:last] = other.capture([*OPEN, *PINHOLES]).frames[middle:last]
    turned = {90.0: bench.capture([Setting(repeats=4, board_turn_deg=90.0)])}
    few, pinholes, held_out = (
        every.with_frames(some) for some in (frames[:last], frames[first:last], frames[last:])
    )
    return calibrate(CAMERA, design(), routes, held_out, few, pinholes, turned=turned)


def with_mask(**changes):
    mask = CAMERA.masks["code"].model_copy(update=changes)
    return CAMERA.model_copy(update={"masks": {"code": mask}})


def with_sensor(**changes):
    return CAMERA.model_copy(update={"sensor": CAMERA.sensor.model_copy(update=changes)})


def other_pattern():
    pattern = CAMERA.masks["code"].pattern
    return with_mask(pattern=pattern.model_copy(update={"seed": 99}))


def moved(um):
    x, y = TRUTH.mounting.offset_um
    mounting = replace(TRUTH.mounting, offset_um=(x + um, y))
    return WhiteboardBench(CAMERA, SIZE, replace(TRUTH, mounting=mounting))


def when(chosen, change):
    """Return a fault of the frames chosen (see CHOSEN), others as they are."""

    def fault(read, setting, masks_in):
        if CHOSEN[chosen](setting, masks_in):
            return change(read, setting, masks_in)
        return read(setting, masks_in)

    return fault


def tilted(share):
    """The light rises by this share from left to right."""
    slope = 1 + share * np.linspace(-0.5, 0.5, SIZE[1])
    return lambda read, setting, masks_in: read(setting, masks_in) * slope


def brighter(times):
    return lambda read, setting, masks_in: times * read(setting, masks_in)


def bare(read, setting, masks_in):
    return read(setting, False)


def through(**changes):
    """Return a change of the setting itself."""
    return lambda read, setting, masks_in: read(replace(setting, **changes), masks_in)


def mirrored(read, setting, masks_in):
    v, u = setting.pinhole
    return read(replace(setting, pinhole=(v, CAMERA.views[1] - 1 - u)), masks_in)


def dim_light(read, setting, masks_in):
    return 0.02 * read(replace(setting, lamp="white"), masks_in)


CHOSEN = {
    "every": lambda setting, masks_in: setting.lamp != "off",
    "darks": lambda setting, masks_in: setting.lamp == "off",
    "references": lambda setting, masks_in: setting.lamp != "off" and not masks_in,
    "coloured": lambda setting, masks_in: setting.lamp not in ("off", "white"),
    "boards": lambda setting, masks_in: masks_in,
    "pinholes": lambda setting, masks_in: masks_in and setting.pinhole is not None,
    "one view": lambda setting, masks_in: masks_in and setting.pinhole == VIEW,
    "elsewhere": lambda setting, masks_in: masks_in and setting.stage_um == STAGE_KINDS_UM[1],
}
UNLIT, BRIGHT_PART = brighter(0.0), brighter(np.where(np.arange(SIZE[1]) < 8, 2.5, 1.0))
BAD = {
    "another mask": ({"camera": other_pattern()}, "not the mask of the design"),
    "another cell": ({"camera": with_mask(cell_um=40.0)}, "not the mask of the design"),
    "another distance": ({"camera": with_mask(distance_mm=0.3)}, "are of another camera or mask"),
    "other filters": ({"camera": with_sensor(cfa="grbg")}, "of another camera, whose colour"),
    "half of another day": ({"other": moved(12.0)}, "or it moved between them"),
    "half of a moved bench": ({"other": moved(120.0)}, "if the mask moved instead, capture all"),
    "dimmer references": ({"fault": when("references", brighter(0.8))}, "taken with less light"),
    "saturated": ({"longer": 3.0}, "reference whiteboard, white lamp: saturated below the white"),
    "one view saturated": (
        {"fault": when("one view", brighter(75))},
        r"\(0, 1\).*: saturated below",
    ),
    "a part saturated": ({"fault": when("every", BRIGHT_PART)}, "saturated below the white level"),
    "lamp off": ({"fault": when("every", UNLIT)}, "reference .* is the lamp on"),
    "lamp off once": ({"fault": when("one view", UNLIT)}, r"\(0, 1\).* is dark; is the lamp on"),
    "lamp on in darks": ({"fault": when("darks", dim_light)}, "the dark frames have 2%"),
    "lamp without colours": ({"fault": when("coloured", through(lamp="white"))}, "did not change"),
    "mask missing": ({"fault": when("every", bare)}, "is the mask in the beam"),
    "mask missing once": ({"fault": when("one view", bare)}, r"\(0, 1\).*is the mask in the beam"),
    "mask missing elsewhere": ({"fault": when("elsewhere", bare)}, "is the mask in the beam"),
    "aperture closed": ({"fault": when("boards", UNLIT)}, "and the aperture open"),
    "aperture half closed": (
        {"fault": when("references", through(pinhole=(1, 1)))},
        "not through the whole aperture",
    ),
    "views mirrored": ({"fault": when("pinholes", mirrored)}, "they are mirrored left to right"),
    "board tilted": (
        {"fault": when("boards", tilted(0.1))},
        "10% from left to right: the white board",
    ),
    "board tilted a little": (
        {"fault": when("boards", tilted(0.03))},
        "3% from left to right: the white board",
    ),
    "board tilted throughout": (
        {"truth": replace(TRUTH, board=BoardFlaws(angle_spread=0.5))},
        "uneven by .* it is tilted",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
def test_whiteboards_that_give_no_psi_are_refused_for_what_they_are(name):
    changes, words = BAD[name]
    with pytest.raises(CalibrationError, match=words):
        psi_of(**changes)


FREE = (
    "another mask",
    "another distance",
    "other filters",
    "views mirrored",
    "lamp off once",
    "dimmer references",
    "board tilted",
    "board tilted a little",
    "aperture half closed",
)


@pytest.mark.parametrize("name", FREE)
def test_they_are_refused_where_every_coefficient_is_measured_as_well(name):
    changes, words = BAD[name]
    with pytest.raises(CalibrationError, match=words):
        psi_of(**changes, routes=("free",))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        pytest.param(
            {"camera": with_mask(distance_mm=0.132)},
            r"distance differs from the design by \+1[23]",
            marks=pytest.mark.xfail(reason="+13.1 +- 2.9 %: of 5 deviations to be named, 4.5"),
        ),
        (
            {"fault": when("references", brighter(1.2))},
            "7[89]% of the light through: if they should",
        ),
    ],
)
def test_what_every_coefficient_follows_is_named_where_each_is_measured(changes, words):
    found = psi_of(**changes, routes=("free",))
    assert re.search(words, " ".join(found.findings))


def test_whiteboards_of_a_bench_as_it_may_be_are_not_refused():
    truth = replace(TRUTH, board=BoardFlaws(angle_spread=0.1, place_spread=0.1, parallax_px=1.0))
    assert psi_of(truth=truth).judged["combined"].relative_error < 0.02

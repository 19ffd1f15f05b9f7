"""Whiteboards that no Psi may be made of are named, each for what is wrong with it."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.errors import CalibrationError
from calibration.routes import calibrate
from emmc_rig.calibrate.bench import ORDINARY_BENCH, BenchTruth, Setting, WhiteboardBench
from emmc_rig.files.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix

SIZE = (32, 48)
CAMERA = find_camera("rgbw-bayer-1shot")
TRUTH = BenchTruth(rays_per_view=32)
PINHOLES = [Setting(pinhole=view, repeats=1) for view in np.ndindex(CAMERA.views)]


@pytest.fixture(scope="module")
def design():
    return build_imaging_matrix(CAMERA, SIZE)


def bench(truth=TRUTH, camera=CAMERA, **changes):
    """Return a bench; changes: methods that it has instead of its own."""
    made = WhiteboardBench(camera, SIZE, truth)
    for name, change in changes.items():
        setattr(made, name, change(getattr(made, name)))
    return made


def boards(stands):
    """Return pinholes and held-out whiteboards of a bench."""
    every = stands.capture([*PINHOLES, Setting()])
    return every.with_frames(every.frames[:-1]), every.with_frames(every.frames[-1:])


def closed(reading):
    return lambda setting, masks_in=True: reading(setting, masks_in) * (not masks_in)


def dark(reading):
    return lambda setting, masks_in=True: 0 * reading(setting, masks_in)


def without_masks(reading):
    return lambda setting, masks_in=True: reading(setting, False)


def half_open(reading):
    def read(setting, masks_in=True):
        window = (3, 0) if masks_in and setting.pinhole is None else (0, 0)
        return reading(replace(setting, window=window), masks_in)

    return read


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"reading": dark}, "is the lamp on"),
        ({"reading": closed}, "is the lamp on, and the aperture open"),
        ({"reading": without_masks}, "is the mask in the beam"),
        ({"reading": half_open}, "was the aperture wholly open"),
        ({"board_exposure_s": lambda own: lambda: 3 * own()}, "is saturated below the white level"),
    ],
)
def test_unfit_whiteboards_are_refused_for_what_they_are(design, changes, words):
    pinholes, held_out = boards(bench(**changes))
    with pytest.raises(CalibrationError, match=words):
        calibrate(CAMERA, design, ["free"], held_out, pinholes=pinholes)


def test_a_whiteboard_of_another_day_is_refused_for_the_mask_that_moved(design):
    moved = replace(TRUTH, mounting=replace(ORDINARY_BENCH.mounting, offset_um=(120.0, 80.0)))
    pinholes, _ = boards(bench())
    _, held_out = boards(bench(moved))
    with pytest.raises(CalibrationError, match="moved between them"):
        calibrate(CAMERA, design, ["free"], held_out, pinholes=pinholes)


def test_whiteboards_of_another_mask_are_refused_by_the_design_and_doubted_without(design):
    mask = CAMERA.masks["mask"]
    pattern = mask.pattern.model_copy(update={"seed": 99})
    other = CAMERA.model_copy(
        update={"masks": {"mask": mask.model_copy(update={"pattern": pattern})}}
    )
    pinholes, held_out = boards(bench(camera=other))
    with pytest.raises(CalibrationError, match="not the mask of the design"):
        calibrate(CAMERA, design, ["mixed"], held_out, few=pinholes)
    free = calibrate(CAMERA, design, ["free"], held_out, pinholes=pinholes)
    assert any("not the mask of the design" in line for line in free.advice)

"""The parametric and mixed methods on a bench that is wrong in every way they do not know."""

import itertools
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from moved_mask import CAMERA
from whiteboard_bench import (
    ORDINARY_BENCH,
    BenchTruth,
    Setting,
    WhiteboardBench,
)

from emmc_rig.calibration.boards import Board, BoardFrame, BoardSet, as_readings, sensor_blemishes
from emmc_rig.calibration.causes import HOLES, LAMP, FoundCause, through_pinhole
from emmc_rig.calibration.choice import HeldOut, choose, explain
from emmc_rig.calibration.defects import find_defects
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.findings import cause_lines, fit_advice
from emmc_rig.calibration.fit import fit_placement
from emmc_rig.calibration.locator import register
from emmc_rig.calibration.parametric import psi_deviation, shot_stages
from emmc_rig.calibration.placement import designed_placement, labels
from emmc_rig.calibration.routes import calibrate
from emmc_rig.calibration.shadow import Shadow, shadow_mask
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.simulators.bench import MountingErrors

SIZE = (44, 60)
VIEWS = (3, 3)
MOUNTING = MountingErrors((31.0, -22.0), 0.15, 1.002, 0.0008, 0.05, 1.0, 3.0)
FEW = [
    Setting(repeats=4),
    Setting(stage_um=(270.0, 162.0), repeats=4),
    *(Setting(pinhole=view, repeats=2) for view in ((1, 1), (0, 0), (2, 0), (0, 2), (2, 2))),
]
MASK = shadow_mask(CAMERA, SIZE)
PIXELS = np.argwhere(np.ones(SIZE, dtype=bool))
HELD_OUT = [Setting(repeats=4), Setting(stage_um=(-207.0, 118.0), repeats=4)]


@pytest.fixture(scope="module")
def bench():
    optics = replace(ORDINARY_BENCH.optics, dust_specks=4, seed=3)
    truth = BenchTruth(MOUNTING, optics, ORDINARY_BENCH.sensor, rays_per_view=1024)
    return WhiteboardBench(CAMERA, SIZE, truth)


@pytest.fixture(scope="module")
def design():
    return build_imaging_matrix(CAMERA, SIZE)


@pytest.fixture(scope="module")
def few(bench):
    return bench.capture(FEW)


@pytest.fixture(scope="module")
def outcome(bench, design, few):
    return calibrate(CAMERA, design, ("parametric", "mixed"), bench.capture(HELD_OUT), few)


def test_dust_is_found_and_psi_is_better_for_it(bench, design, outcome):
    exact = bench.exact_psi(design)
    errors = {
        name: known.psi.relative_difference(exact) for name, known in outcome.calibrations.items()
    }
    assert design.relative_difference(exact) > 0.3
    assert errors["mixed"] < 0.8 * errors["parametric"] < 0.03
    assert outcome.judged["mixed"].chi2 < 0.6 * outcome.judged["parametric"].chi2
    assert outcome.chosen == "mixed"


def test_bad_pixels_are_found_and_left_out(bench, outcome):
    hot, dead = ORDINARY_BENCH.sensor.bad(SIZE)
    assert not outcome.good[hot | dead].any()
    assert (~outcome.good).sum() <= (hot | dead).sum() + 3
    assert not outcome.calibration.good[hot | dead].any()


def synthetic(design, placement, noise=0.004, seed=0, settings=FEW):
    """Whiteboards drawn from the model itself, with its noise: for statistics alone."""
    rng = np.random.default_rng(seed)
    shadow = Shadow(MASK, placement)
    boards = []
    for setting in settings:
        views_open = setting.views_open(VIEWS)
        clean = shadow.readings(PIXELS, design.colour[0].ravel(), views_open, setting.stage_um)
        deviation = noise * clean.max()
        read = (clean + rng.normal(0, deviation, len(clean))).reshape(SIZE)
        variance = np.full(SIZE, deviation**2, np.float32)
        reading, channels = read.astype(np.float32), design.colour[0]
        place = setting.stage_um
        boards.append(Board("test", reading, variance, channels, views_open, place, 0))
    return boards


def test_brightness_that_repeats_show_to_differ_counts_in_the_fit(design):
    steady = synthetic(design, designed_placement(CAMERA), settings=FEW[:2])
    jumping = [replace(board, repeats=2, unsteady2=0.02**2) for board in steady]
    known, less = (fit_placement(boards, CAMERA, MASK) for boards in (steady, jumping))
    # Two whiteboards of two frames each are as bright as the mean of four.
    assert less.deviation("clear") == pytest.approx(0.02 / 2 * less.placement.clear, rel=0.2)
    assert known.deviation("clear") < 0.4 * less.deviation("clear")
    assert known.brightness_spread < 0.001 > less.brightness_spread


def test_a_mask_that_is_not_the_design_is_refused_with_the_correlation(design, bench, few):
    other = CAMERA.model_copy(
        update={
            "masks": {
                "code": CAMERA.masks["code"].model_copy(
                    update={"pattern": CAMERA.masks["code"].pattern.model_copy(update={"seed": 9})}
                )
            }
        }
    )
    boards = as_readings(few, design)
    with pytest.raises(CalibrationError, match=r"not the mask of the design.*correlation is 0\.\d"):
        fit_placement(boards, other, shadow_mask(other, SIZE))


def test_a_mirrored_mask_is_named_as_such(design):
    mirrored = replace(MASK, cells=np.ascontiguousarray(MASK.cells[:, :, ::-1]))
    boards = synthetic(design, designed_placement(CAMERA), settings=FEW[:1])
    with pytest.raises(CalibrationError, match="mirrored left to right"):
        register(boards[0], mirrored, designed_placement(CAMERA))


@pytest.mark.parametrize(("x", "y", "turn_deg"), [(130.0, -80.0, 0.0), (40.0, 210.0, 0.9)])
def test_registration_finds_a_mask_that_sits_far_off(design, x, y, turn_deg):
    truth = replace(
        designed_placement(CAMERA),
        offset_x_um=x,
        offset_y_um=y,
        rotation_rad=np.deg2rad(turn_deg),
        blur_um=3.0,
    )
    boards = synthetic(design, truth, settings=FEW[:1])
    found = register(boards[0], MASK, designed_placement(CAMERA))
    assert found.placement.offset_x_um == pytest.approx(x, abs=12)
    assert found.placement.offset_y_um == pytest.approx(y, abs=12)
    assert found.correlation > 0.6


def test_flicker_and_a_moved_stage_are_found_on_the_board_that_has_them(design):
    truth = replace(designed_placement(CAMERA), blur_um=3.0)
    boards = synthetic(design, truth)
    flickered = replace(boards[1], reading=(boards[1].reading * 1.05).astype(np.float32))
    moved = replace(
        synthetic(design, replace(truth, offset_x_um=3.0), settings=FEW[2:3])[0], name="third"
    )
    seen = [boards[0], replace(flickered, name="second"), moved, *boards[3:]]
    fit = fit_placement(seen, CAMERA, MASK)
    lines = cause_lines(fit, seen, MASK)
    assert "second" in lines.advice[0]
    assert "in brightness against the other whiteboards" in lines.advice[0]
    # 3 um of the mask's shadow; one pinhole alone may be a mask that moved as well.
    far_um = 3.0 / MASK.distance_um * MASK.lens_um
    words = re.search(r"pinholes stand up to (\d+) um", lines.findings[0])
    assert words
    assert float(words[1]) == pytest.approx(far_um, rel=0.1)
    assert "a mask that is not where the stage reports it" in lines.findings[0]
    assert fit.moved_um == pytest.approx(3.0, rel=0.2)


@pytest.mark.parametrize(("doubled", "named"), [(0.0, True), (0.05, False)])
def test_what_the_model_misses_is_no_hole_of_another_area(doubled, named, design):
    level = np.random.default_rng(3).normal(1, 0.01, len(FEW))
    boards = [
        replace(board, reading=(share * seen).astype(np.float32))
        for board, share in zip(synthetic(design, designed_placement(CAMERA)), level, strict=True)
        for seen in [(1 - doubled) * board.reading + doubled * np.roll(board.reading, 4, axis=1)]
    ]
    found = fit_placement(boards, CAMERA, MASK).causes
    assert bool({cause.name for cause in found} & {LAMP, HOLES}) == named


@pytest.mark.parametrize("name", [LAMP, HOLES])
def test_a_cause_is_named_only_for_whiteboards_where_it_is_far_outside_its_deviation(name, design):
    boards = synthetic(design, replace(designed_placement(CAMERA), blur_um=3.0))
    count = sum(map(through_pinhole, boards)) if name == HOLES else len(boards)
    size = (0.3, 0.1, *[0.0] * (count - 2))
    few = boards if name == LAMP else [board for board in boards if through_pinhole(board)]
    for second, chi2, named in ((0.01, 1.0, [few[1].name]), (0.03, 1.0, []), (0.01, 9.0, [])):
        cause = FoundCause(name, 0.05, 9.0, (), size, (0.1, second, *[0.01] * (count - 2)))
        fit: Any = SimpleNamespace(causes=(cause,), chi2=chi2)
        said = [*itertools.chain(*cause_lines(fit, boards, MASK))]
        assert len(said) == len(named)
        assert all(words in line for words, line in zip(named, said, strict=True))


@pytest.mark.slow
def test_the_noise_of_the_reference_is_that_of_all_whiteboards(design):
    truth, rng = replace(designed_placement(CAMERA), blur_um=3.0), np.random.default_rng(5)
    chosen = [labels(VIEWS).index(name) for name in ("clear", "vignetting")]
    white2 = np.full(SIZE, 0.02**2, np.float32)
    fits, alone = [], []
    for seed in range(24):
        darker = 1 - rng.normal(0, 0.02, SIZE)
        boards = [
            replace(
                board,
                reading=(board.reading * darker).astype(np.float32),
                variance=board.variance + np.square(board.reading) * white2,
            )
            for board in synthetic(design, truth, seed=seed)
        ]
        for shared, found in ((white2, fits), (None, alone)):
            each = [replace(board, white2=shared) for board in boards]
            found.append(fit_placement(each, CAMERA, MASK, start=truth))
    spread = np.std([fit.placement.vector()[chosen] for fit in fits], axis=0, ddof=1)
    stated, of_own = (
        np.mean([np.sqrt(np.diag(fit.covariance))[chosen] for fit in found], axis=0)
        for found in (fits, alone)
    )
    # The deviation of 24 is known to 15 %.
    assert np.all(np.abs(spread / stated - 1) < 0.35)
    # The level is less sure than if every whiteboard had its own reference, a slope surer.
    assert stated[0] > 1.2 * of_own[0]
    assert stated[1] < 0.8 * of_own[1]


def test_one_open_whiteboard_alone_leaves_the_aperture_to_the_design(design):
    boards = synthetic(design, designed_placement(CAMERA), 0.05, settings=FEW[:1])
    fit = fit_placement(boards, CAMERA, MASK)
    assert any(name.startswith("aperture") for name in fit.undecided)
    assert fit.more_boards > 0
    few = fit_advice(fit, boards)[-1]
    assert "too few whiteboards" in few
    assert few.endswith("through a pinhole")
    pinholes = [
        replace(boards[0], views_open=only) for only in np.eye(9, dtype=bool).reshape(-1, *VIEWS)
    ]
    assert "pinhole" not in fit_advice(fit, [*boards, *pinholes])[-1]
    enough = fit_placement(synthetic(design, designed_placement(CAMERA), 0.005), CAMERA, MASK)
    assert enough.undecided == ()
    assert enough.more_boards == 0


def test_deviations_of_psi_do_not_depend_on_the_bands_they_are_computed_in(design, monkeypatch):
    shadow = Shadow(MASK, designed_placement(CAMERA))
    covariance = np.diag(np.full(len(shadow.placement.vector()), 1e-4))
    found = []
    for pixels in (2**16, 130):
        monkeypatch.setattr("emmc_rig.calibration.parametric.BAND_PIXELS", pixels)
        found.append(psi_deviation(shadow, design, shot_stages(CAMERA), covariance))
    assert found[0].min() > 0
    np.testing.assert_array_equal(*found)


def test_no_defects_are_found_on_a_clean_mask(design):
    truth = replace(designed_placement(CAMERA), blur_um=3.0)
    boards = synthetic(design, truth)
    assert find_defects(boards, MASK, truth).count == 0


def test_frames_of_another_camera_are_refused(few, design):
    cut = [
        BoardFrame.held(
            replace(board.frame, mean_dn=board.frame.mean_dn[:-2]), board.stage_um, board.shot
        )
        for board in few.frames
    ]
    with pytest.raises(CalibrationError, match="42 x 60 pixels, the camera has 44 x 60"):
        as_readings(few.with_frames(cut), design)


def test_a_dark_whiteboard_and_missing_references_are_refused(few, design):
    dark = few.dark_at(few.frames[0].frame.exposure_s)
    off = BoardFrame.held(replace(few.frames[0].frame, mean_dn=dark.mean_dn), (0.0, 0.0))
    with pytest.raises(CalibrationError, match="is the lamp on, and the aperture open"):
        as_readings(few.with_frames([off]), design)
    red = BoardFrame.held(few.frames[0].frame, (0.0, 0.0), lamp="amber")
    with pytest.raises(CalibrationError, match="no reference whiteboard under that lamp"):
        as_readings(few.with_frames([red]), design)
    with pytest.raises(CalibrationError, match="no dark frame"):
        BoardSet((), few.references, few.frames)
    with pytest.raises(CalibrationError, match="no whiteboard with the mask in"):
        fit_placement([], CAMERA, MASK)


def test_the_surest_method_that_predicts_to_the_noise_is_chosen():
    def judged(route, chi2):
        return HeldOut(route, chi2, 0.0, np.ones((64, 64), np.float32))

    def pick(**routes):
        held = [judged(route, chi2) for route, (chi2, _) in routes.items()]
        return choose(held, {route: stated for route, (_, stated) in routes.items()}).route

    # 5 sqrt(2 / 4096) = 0.11 is chance.
    assert pick(free=(1.0, 0.005), parametric=(1.1, 0.001)) == "parametric"
    assert pick(free=(1.0, 0.005), combined=(1.02, 0.004)) == "combined"
    assert pick(free=(1.0, 0.005), parametric=(1.3, 0.001)) == "free"
    assert pick(mixed=(1.4, 0.002), parametric=(1.3, 0.003)) == "mixed"
    assert pick(mixed=(9.0, 0.002), free=(2.5, 0.003)) == "free"


@pytest.mark.parametrize(
    ("chi2", "error", "said"),
    [(1.24, 0.002, "good"), (1.24, 0.06, "imprecise"), (8.0, 0.002, "doubtful")],
)
def test_a_calibration_is_called_good_by_its_residual_and_its_stated_error(chi2, error, said):
    words = explain(HeldOut("mixed", chi2, 0.0, np.ones((4, 4), np.float32)), error)
    assert words.startswith(f"calibration {said}: residual {chi2:.2f} x noise variance (limit 1.5)")
    assert f"error stated {100 * error:.2f}%" in words


def test_dark_current_is_drawn_as_a_line_between_two_dark_exposures(few):
    first, last = few.darks[0], few.darks[-1]
    two = replace(few, darks=(first, last))
    middle = two.dark_at((first.exposure_s + last.exposure_s) / 2)
    np.testing.assert_allclose(middle.mean_dn, (first.mean_dn + last.mean_dn) / 2, rtol=1e-5)
    assert sensor_blemishes(few).mean() > 0.99

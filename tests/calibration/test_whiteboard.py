"""Psi from whiteboards: ratios of signals, their uncertainty, and refusals."""

import numpy as np
import pytest

from emmc_rig.calibration.boards import BoardFrame, BoardSet
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import MeanFrame, average, photon_transfer
from emmc_rig.calibration.scale import amplified
from emmc_rig.calibration.whiteboard import ideal_boards, lamps_needed, measure_psi
from emmc_rig.model.camera import Camera, build_imaging_matrix

SIZE = (12, 16)
WHITE_DN = 65_535


def design_of(cfa="rggb", binning=1, shots=({},)):
    camera = Camera.model_validate(
        {
            "title": "test",
            "views": [2, 3],
            "sensor": {"cfa": cfa, "binning": binning},
            "masks": {
                "code": {
                    "distance_mm": 0.2,
                    "cell_um": 40,
                    "pattern": {"kind": "uniform_colour", "seed": 4},
                }
            },
            "shots": list(shots),
        }
    )
    return camera, build_imaging_matrix(camera, SIZE)


def pinhole_readings(design):
    """What a noise-free sensor reads through the pinhole, from Psi's own coefficients."""
    k = design.binning
    rows, columns = design.frames_shape[1:]
    readings = {}
    for shot, v, u in np.ndindex(design.weights.shape[:3]):
        for stored, lamp in enumerate(lamps_needed(design)):
            weights = design.weights[shot, v, u, :, stored]
            pixels = weights.reshape(rows, k, columns, k).sum(axis=(1, 3))
            readings[shot, v, u, lamp] = pixels.astype(np.float64)
    return readings


@pytest.mark.parametrize(("cfa", "binning"), [("rggb", 1), ("mono", 1), ("rggb", 2), ("mono", 2)])
def test_noise_free_whiteboards_give_psi_back(cfa, binning):
    _, design = design_of(cfa, binning, [{}, {"offset_um": {"code": [50, 20]}}])
    boards = ideal_boards(pinhole_readings(design), lamps_needed(design), design)
    assert measure_psi(boards, design).psi.relative_difference(design) < 1e-5


def test_the_lamp_level_and_the_pixel_sensitivity_cancel():
    _, design = design_of()
    readings = pinhole_readings(design)
    boards = ideal_boards(readings, ("white",), design)
    falloff = np.linspace(0.5, 1.5, SIZE[1])[None, :]

    def dimmed(frame):
        return MeanFrame((frame.mean_dn * falloff).astype(np.float32), 0.0, frame.count, 1.0)

    seen = BoardSet(
        boards.darks,
        {key: dimmed(frame) for key, frame in boards.references.items()},
        tuple(
            BoardFrame.held(dimmed(board.frame), board.stage_um, board.shot, board.pinhole)
            for board in boards.frames
        ),
    )
    assert measure_psi(seen, design).psi.relative_difference(design) < 1e-5


def seen(mean_dn, variance_dn2=1.0, count=2):
    return MeanFrame(np.full(SIZE, mean_dn, np.float32), variance_dn2, count, 1.0)


def flat(level=10_000, size=(20, 20)):
    return np.full(size, level, np.uint16)


def averaged(*frames):
    return lambda boards, design: average(frames, 0.1, WHITE_DN, "reference")


def with_references(references):
    return lambda boards, design: measure_psi(
        BoardSet(boards.darks, references, boards.frames), design
    )


def without_a_view(boards, design):
    some = [board for board in boards.frames if board.pinhole != (1, 2)]
    measure_psi(boards.with_frames(some), design)


REFUSED = {
    "saturated": (averaged(flat(WHITE_DN)), r"100.0% of the pixels are saturated; shorten"),
    "flickering": (averaged(flat(), flat(10_500)), r"differ by 4\.8% in .*; the lamp flickers"),
    "two sizes": (averaged(flat(), flat(size=(20, 21))), "capture all alike"),
    "no frames": (averaged(), "no frame was taken"),
    "a view missing": (without_a_view, r"missing: shot 0, view \(1, 2\), white lamp"),
    "no reference": (with_references({}), "no reference whiteboard"),
    "a dark reference": (with_references({(0, "white"): seen(20)}), "brighten the lamp or exp"),
    "no repeats": (lambda *_: photon_transfer(seen(0, np.nan, 1), seen(0)), "at least two"),
    "no light": (lambda *_: photon_transfer(seen(0), seen(0)), "is the lamp on"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_whiteboards_that_measure_nothing_are_refused(fault):
    act, complaint = REFUSED[fault]
    _, design = design_of()
    with pytest.raises(CalibrationError, match=complaint):
        act(ideal_boards(pinhole_readings(design), ("white",), design), design)


def test_a_lamp_that_hardly_flickers_is_taken():
    assert average([flat(), flat(10_050)], 0.1, WHITE_DN, "reference").count == 2


@pytest.mark.parametrize("jitter", [0.0, 0.003])
def test_repeats_show_by_how_much_their_exposures_differ(jitter):
    rng = np.random.default_rng(2)
    seen = []
    for _ in range(60):
        levels = 2000 * (1 + jitter * rng.standard_normal(4))
        frames = [rng.normal(64 + level, 20, (16, 16)).astype(np.uint16) for level in levels]
        seen.append(average(frames, 1.0, WHITE_DN, "x").unsteady2(64.0))
    of_noise2 = (20 / 2000) ** 2 / 16**2
    expected = 4 * np.sqrt(2 / 180) * (jitter**2 + of_noise2)
    assert np.mean(seen) == pytest.approx(jitter**2, abs=expected)


def test_repeated_darks_show_how_rows_err_alike():
    rng = np.random.default_rng(4)
    seen = []
    for _ in range(50):
        rows = 3 * rng.standard_normal((4, 40))
        frames = 500 + rows[:, :, None] + rng.normal(0, 8, (4, 40, 16))
        dark = average(np.rint(frames).astype(np.uint16), 1.0, WHITE_DN, "x", lit=False)
        seen.append(dark.rows_dn2 - dark.variance_dn2 / 16)
    # The rows' share of the pixels' variance is 9 of 73.
    assert np.mean(seen) == pytest.approx(9 - 9 / 16, rel=0.08)


def test_darks_at_another_gain_are_the_mean_and_the_noise_of_amplified_frames():
    rng = np.random.default_rng(3)
    rows = rng.normal(0, 1, (16, 24, 1))  # each row of each frame moves as a whole
    dark = np.rint(200 + rows + rng.normal(0, 5, (16, 24, 32)))
    at_one, at_three = (
        average((100 + gain * (dark - 100)).astype(np.uint16), 0.1, WHITE_DN, "dark", lit=False)
        for gain in (1, 3)
    )
    found = amplified(at_one, 3.0, np.full((2, 2), 100.0))
    np.testing.assert_allclose(found.mean_dn, at_three.mean_dn, rtol=1e-6)
    for name in ("variance_dn2", "level_variance_dn2", "rows_dn2"):
        np.testing.assert_allclose(getattr(found, name), getattr(at_three, name), rtol=1e-6)

"""Lamp and response from boards seen again: recovered, taken out, and not seen where not there."""

import numpy as np
import pytest

from emmc_rig.calibration.board_angle import board_over_angle
from emmc_rig.calibration.boards import Board, BoardSet
from emmc_rig.calibration.colours import crosstalk
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import MeanFrame, SensorGain
from emmc_rig.calibration.levels import Check, fit_levels
from emmc_rig.calibration.misfit import combined
from emmc_rig.calibration.whiteboard import Calibration
from emmc_rig.model.sensing import Psi

WARM_UP_S = 120.0


def lamp(seconds, drift):
    return 1 + drift * (1 - np.exp(-seconds / WARM_UP_S))


def checks(drift=0.0, bend=0.0, noise=0.0, seed=0):
    """Two boards, red and blue pixels; bend: loss of response at 50,000 DN."""
    rng = np.random.default_rng(seed)
    looks = [("out", t, 0.1 * share) for t, share in ((0, 0.25), (5, 0.5), (10, 0.75), (15, 1))]
    looks += [("in", t, 0.1) for t in range(20, 300, 40)] + [("out", 305.0, 0.1)]
    found = []
    for board, t, exposure_s in looks:
        full = 500_000 * exposure_s * (1.0 if board == "out" else 0.4)
        dn = np.array([full * lamp(t, drift), np.nan, full * lamp(t, -drift), np.nan])
        dn = dn * (1 - bend * dn / 50_000) * (1 + noise * rng.standard_normal(4))
        found.append(Check(board, t, exposure_s, tuple(dn), noise))
    return found


def test_drift_and_bend_are_separated_and_taken_out():
    levels = fit_levels(checks(drift=0.02, bend=0.01, noise=5e-5))
    assert levels is not None
    assert levels.drifting
    assert levels.bent
    assert levels.bend_per_dn * 50_000 == pytest.approx(0.01, rel=0.1)
    assert levels.drift == pytest.approx(0.02 * (1 - np.exp(-305 / WARM_UP_S)), rel=0.1)
    channels = np.zeros((2, 2), np.uint8)
    for t in (0.0, 60.0, 200.0, 300.0):
        dn = 20_000 * lamp(t, 0.02)
        frame = MeanFrame(
            np.full((2, 2), dn * (1 - 0.01 * dn / 50_000), np.float32), 1.0, 1, 0.1, t
        )
        found = levels.corrected(frame, np.zeros((2, 2)), channels).mean_dn
        np.testing.assert_allclose(found, 20_000, rtol=6e-4)


def test_a_steady_lamp_and_a_straight_response_are_left_alone():
    levels = fit_levels(checks(noise=1e-4))
    assert levels is not None
    assert not levels.drifting
    assert not levels.bent
    frame = MeanFrame(np.full((2, 2), 30_000, np.float32), 1.0, 1, 0.1, 100.0)
    found = levels.corrected(frame, np.zeros((2, 2)), np.zeros((2, 2), np.uint8))
    np.testing.assert_array_equal(found.mean_dn, frame.mean_dn)


def test_boards_seen_once_tell_nothing():
    assert fit_levels(checks()[3:5]) is None


def test_one_exposure_leaves_the_response_unknown():
    levels = fit_levels([check for check in checks(bend=0.05) if check.exposure_s == 0.1])
    assert levels is not None
    assert not levels.bend_known
    assert not levels.bent


def test_a_dark_frame_far_from_those_taken_is_known_worse():
    darks = tuple(MeanFrame(np.zeros((2, 2), np.float32), 4.0, 4, t) for t in (0.01, 0.18))
    boards = BoardSet(darks, {}, ())
    variances = [
        boards.dark_at(t).variance_dn2 / 4 + boards.dark_at(t).extra_variance_dn2
        for t in (0.18, 0.1, 4.5)
    ]
    assert variances[0] == 1.0
    share = (4.5 - 0.01) / 0.17
    assert variances[2] == pytest.approx(share**2 + (1 - share) ** 2, rel=1e-6)
    assert variances[1] <= 1.0


def random_psi(seed=0, views=(5, 5), size=(40, 48)):
    rng = np.random.default_rng(seed)
    weights = rng.random((1, *views, size[0], 1, size[1])).astype(np.float32) / 25
    return Psi(weights, np.zeros((1, *size), np.uint8))


def open_board(psi, radiance, noise, rng):
    white = np.ones(psi.light_field_shape, np.float32) * radiance[:, :, None, None, None]
    reading = psi.forward(white.astype(np.float32))[0]
    reading = reading + noise * rng.standard_normal(reading.shape)
    shape = reading.shape
    return Board(
        "turned", reading.astype(np.float32), np.full(shape, noise**2, np.float32),
        np.zeros(shape, np.uint8), np.ones((5, 5), bool), (0.0, 0.0), 0,
    )  # fmt: skip


def test_a_turned_board_separates_its_unevenness_from_the_cameras():
    psi, rng = random_psi(), np.random.default_rng(1)
    v = np.linspace(-1, 1, 5)
    true = 1 + 0.03 * v + 0.02 * v[:, None] + 0.01 * (v**2 - v[:, None] ** 2)
    measured = Psi(psi.weights * true[None, :, :, None, None, None].astype(np.float32), psi.colour)
    turned = {90.0 * n: open_board(psi, np.rot90(true, -n), 1e-3, rng) for n in (1, 2)}
    found = board_over_angle(measured, turned)
    assert found.uneven
    assert found.sense == 1
    np.testing.assert_allclose(found.radiance, true / true.mean(), atol=2e-3)
    assert (np.abs(found.radiance - true) < 5 * found.deviation + 1e-3).all()
    # Turned once, it may have been turned either way.
    once = board_over_angle(measured, {90.0: turned[90.0]})
    assert once.sense == 0
    assert (np.abs(once.radiance - true) < 2 * once.deviation + 1e-3).all()


def test_an_error_of_psi_is_no_unevenness_of_the_board():
    psi, rng = random_psi(), np.random.default_rng(1)
    wrong = 1 + 0.05 * np.linspace(-1, 1, 5)[:, None] ** 2 + 0.03 * np.linspace(-1, 1, 5)
    measured = Psi(psi.weights * wrong[None, :, :, None, None, None], psi.colour)
    turned = {90.0 * n: open_board(psi, np.ones((5, 5)), 1e-3, rng) for n in range(4)}
    assert not board_over_angle(measured, turned).uneven
    without = {turn: board for turn, board in turned.items() if turn}
    assert board_over_angle(measured, without).uneven
    assert board_over_angle(measured, without).disagreement[1] > 5


def test_an_even_board_is_found_even():
    psi = random_psi()
    board = open_board(psi, np.ones((5, 5)), 1e-3, np.random.default_rng(2))
    assert not board_over_angle(psi, {90.0: board}).uneven


def calibrations(misfit, seed=0, noise=1e-3):
    """A true Psi, what pinholes measure, and a model that misses by so much in view (0, 0)."""
    psi, rng = random_psi(seed), np.random.default_rng(seed + 1)
    gain = SensorGain(1.0, 1.0)
    frame = np.zeros((40, 48), np.float32)

    def known(weights, deviation):
        spread = np.full(weights.shape, deviation, np.float32)
        return Calibration(Psi(weights, psi.colour), spread, frame, frame, gain)

    measured = psi.weights + noise * rng.standard_normal(psi.weights.shape).astype(np.float32)
    model = psi.weights.copy()
    model[:, 0, 0] += misfit * rng.standard_normal(model[:, 0, 0].shape)
    return psi, known(measured, noise), known(model, noise / 20)


def test_where_the_model_holds_psi_is_surer_and_where_not_it_is_the_pinholes():
    psi, free, model = calibrations(misfit=1e-2)
    both = combined(free, model, np.ones((40, 48), bool))
    off = np.abs(both.psi.weights - psi.weights)
    assert off[:, 2, 2].mean() < 0.3 * np.abs(free.psi.weights - psi.weights)[:, 2, 2].mean()
    assert off[:, 0, 0].mean() < 0.15 * np.abs(model.psi.weights - psi.weights)[:, 0, 0].mean()
    assert off[:, 0, 0].mean() < 1.05 * np.abs(free.psi.weights - psi.weights)[:, 0, 0].mean()


@pytest.mark.parametrize("misfit", [5e-4, 1e-3, 4e-3])
def test_the_deviation_of_both_together_covers_what_it_says(misfit):
    psi, free, model = calibrations(misfit)
    both = combined(free, model, np.ones((40, 48), bool))
    off = np.abs(both.psi.weights - psi.weights)[:, 0, 0]
    stated = both.deviation[:, 0, 0]
    assert np.mean(off < stated) == pytest.approx(0.683, abs=0.04)
    assert np.mean(off < 2 * stated) == pytest.approx(0.954, abs=0.02)


def test_crosstalk_is_what_a_filter_sees_of_other_lamps():
    channels = np.array([[0, 1], [1, 2]], np.uint8).repeat(4, 0).repeat(4, 1)
    through = np.array([[0.95, 0.05, 0.0], [0.02, 0.95, 0.03], [0.0, 0.04, 0.96]])
    dark = MeanFrame(np.full((8, 8), 256, np.float32), 4.0, 4, 0.1)

    def under(colour, matrix):
        level = 256 + 40_000 * matrix[:, colour][channels]
        return MeanFrame(level.astype(np.float32), 1.0, 2, 0.1)

    def set_of(matrix):
        lamps = enumerate(("red", "green", "blue"))
        return BoardSet((dark,), {(0, name): under(c, matrix) for c, name in lamps}, ())

    good = np.ones((8, 8), bool)
    found = crosstalk(set_of(through), channels, good)
    assert found is not None
    np.testing.assert_allclose(found.seen, through, atol=1e-5)
    assert found.largest == pytest.approx(0.05)
    assert crosstalk(set_of(np.eye(3)), channels, good) is None
    # The green filter sees less than half of its own colour.
    swapped = np.array([[0.9, 0.1, 0.0], [0.6, 0.4, 0.0], [0.0, 0.02, 0.98]])
    with pytest.raises(CalibrationError, match="behind the green filter see 40% green"):
        crosstalk(set_of(swapped), channels, good)
    leaking = np.array([[0.999, 0.001, 0.0], [0.0, 1.0, 0.0], [0.0, 0.04, 0.96]])
    found = crosstalk(set_of(leaking), channels, good)
    assert found is not None
    assert found.largest == pytest.approx(0.04)

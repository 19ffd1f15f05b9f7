"""Lamp and response from boards seen again: recovered, taken out, and not seen where not there."""

import numpy as np
import pytest

from emmc_rig.calibration.frames import MeanFrame
from emmc_rig.calibration.levels import Check, fit_levels

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

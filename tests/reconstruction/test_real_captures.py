"""Frames of real coded cameras: held-out readings are predicted, and a wrong Psi is refused."""

from functools import cache

import numpy as np
import pytest
from coded_captures import PRISM_PX, SOFTER, available, coded_capture


@pytest.fixture
def captures(peer_files):
    """The folder of captures; `available` names them."""
    folder = peer_files / "captures"
    if not available(folder):
        pytest.skip("EMMC_PEER_FILES holds no captures of coded cameras")
    return folder


@cache
def judged(folder, name, mask="right"):
    """Return (root mean square of readings kept from the fit, their deviation, result)."""
    taken = coded_capture(folder, name, mask=mask)
    result = taken.reconstruct("adaptive-fast")
    readings = taken.frames.readings
    off = (taken.psi.forward(result.light_field) - readings)[taken.kept]
    return float(np.sqrt(np.mean(np.square(off)))), float(readings.std()), result


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smem/fern_root", "smem/resolution_target"])
def test_readings_of_a_camera_that_others_built_are_foretold(captures, name):
    rms, spread, result = judged(captures, name)
    assert rms < 0.25 * spread
    assert result.verdict.level == "trust"
    assert np.median(result.maps["shift"]) == pytest.approx(PRISM_PX, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["1 rows off", "mirrored"])
def test_the_psi_of_another_mask_is_refused(captures, mask):
    assert judged(captures, "smem/fern_root", mask)[2].verdict.level == "do not use"


@pytest.mark.slow
def test_a_mask_that_is_sharper_than_its_shadow_is_not_trusted(captures):
    assert judged(captures, "tsa/scene1")[2].verdict.level in ("doubt", "do not use")


@pytest.mark.slow
def test_foretold_readings_alone_do_not_show_whether_bands_lie_as_the_prism_puts_them(captures):
    right, _, trusted = judged(captures, "smem/fern_root")
    softer, _, doubted = judged(captures, "smem/fern_root", SOFTER)
    assert softer < right
    assert np.median(doubted.maps["shift"]) < PRISM_PX / 2 < np.median(trusted.maps["shift"])
    assert doubted.verdict.level == "doubt"

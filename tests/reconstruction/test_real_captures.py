"""Frames of real coded cameras that others built: what is foretold, and which Psi is refused."""

import numpy as np
import pytest
from coded_captures import available, coded_capture

from reconstruction.verdict.run import reconstruct_judged

SIZE = (96, 160)


@pytest.fixture
def captures(peer_files):
    """The folder of captures; `available` names them."""
    folder = peer_files / "captures"
    if not available(folder):
        pytest.skip("EMMC_PEER_FILES holds no captures of coded cameras")
    return folder


def judged(folder, name, mask="right"):
    """Return (root mean square of readings kept from the fit, their deviation, verdict)."""
    taken = coded_capture(folder, name, SIZE, mask)
    result, verdict = reconstruct_judged(
        "adaptive-fast", taken.psi, taken.readings, taken.noise, usable=~taken.kept
    )
    off = (taken.psi.forward(result.light_field) - taken.readings)[taken.kept]
    return float(np.sqrt(np.mean(np.square(off)))), float(taken.readings.std()), verdict


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smem/fern_root", "smem/resolution_target"])
def test_readings_of_a_camera_that_others_built_are_foretold(captures, name):
    rms, spread, verdict = judged(captures, name)
    assert rms < 0.25 * spread
    assert verdict.level == "trust"


@pytest.mark.slow
@pytest.mark.parametrize("mask", ["4 rows off", "mirrored"])
def test_the_psi_of_another_mask_is_refused(captures, mask):
    assert judged(captures, "smem/fern_root", mask)[2].level == "do not use"


@pytest.mark.slow
def test_a_mask_that_is_sharper_than_its_shadow_is_not_trusted(captures):
    assert judged(captures, "tsa/scene1")[2].level in ("doubt", "do not use")

"""The calibration's page: its first figures, their limits, its maps."""

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.choice import HeldOut
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.report.calibration_page import (
    PARAMETERS,
    REGIONS,
    error_of_psi,
    write_calibration_report,
)

SIZE = (24, 32)
FITTED = {
    **{
        name: {"value": parameter.design or 0.0, "deviation": 0.01}
        for name, parameter in PARAMETERS.items()
    },
    "distance_share": {"value": -0.042, "deviation": 0.003},
}


def whiteboard() -> Board:
    """Return a whiteboard through the centre view alone."""
    views_open = np.zeros((5, 5), bool)
    views_open[2, 2] = True
    reading = np.random.default_rng(1).uniform(0, 0.04, SIZE).astype(np.float32)
    variance, channels = np.full(SIZE, 1e-6, np.float32), np.full(SIZE, 3, np.uint8)
    return Board("shot 0, view (2, 2)", reading, variance, channels, views_open, (0.0, 0.0), 0)


def written(tmp_path, chi2=0.85, advice=(), undecided=()) -> str:
    """Return the page of a calibration whose validation residual is chi2."""
    psi = build_imaging_matrix(find_camera("rgbw-bayer-1shot"), SIZE)
    residual = np.random.default_rng(0).normal(0, chi2**0.5, SIZE).astype(np.float32)
    judged = {"combined": HeldOut("combined", chi2, 0.004, residual, groups={"open": chi2})}
    deviation = np.full(psi.weights.shape, 1e-3 * np.sqrt(np.mean(np.square(psi.weights))))
    outcome: Any = SimpleNamespace(
        chosen="combined", why="the reason", judged=judged, frames={"combined": 40},
        advice=advice, findings=(), unwatched=(), parametric=True,
        calibration=SimpleNamespace(psi=psi, deviation=deviation), whiteboard=whiteboard(),
    )  # fmt: skip
    board = {"name": "open", "brightness": 1, "moved_um": (0, 0), "chi2": 1, "outliers": 0}
    metrics = {
        "camera": "a camera", "session": "session", "bad_pixels": 0.001, "size": SIZE,
        "command": "", "calibration_seconds": 1.0, "versions": {}, "parameters": FITTED,
        "fit": {
            "status": "converged", "steps": 9, "correlation": 0.99, "chi2": 1.0, "outliers": 0.0,
            "undecided": undecided, "boards": [board],
        },
    }  # fmt: skip
    path = tmp_path / "report.html"
    write_calibration_report(path, outcome, metrics)
    return path.read_text()


def test_the_first_figures_have_what_is_good_and_none_is_unknown(tmp_path):
    page = written(tmp_path)
    tiles = re.findall(r'class="card *(\w*)">\s*<h3>(.*?)</h3><p class="value">(.*?)<', page)
    assert tiles == [
        ("good", "Validation residual", "0.85 x noise"),
        ("", "Deviation of Psi", "0.10%"),
        ("good", "Excluded pixels", "0.10%"),
    ]
    assert page.count("; good: below") == 2
    assert "not known" not in page
    assert '<aside class="verdict good"' in page


@pytest.mark.parametrize(("chi2", "advice"), [(1.6, ()), (0.8, ("measure more",))])
def test_a_calibration_to_be_made_better_is_not_shown_as_good(tmp_path, chi2, advice):
    page = written(tmp_path, chi2, advice)
    assert '<aside class="verdict watch"' in page
    assert ("You can use this calibration" in page) == (chi2 < 1.5)


@pytest.mark.parametrize(
    ("undecided", "says"),
    [
        ((), "the mount, not an error: Psi has it"),
        (("distance_share",), "not known from these whiteboards: taken as designed"),
    ],
)
def test_a_parameter_has_its_deviation_and_what_that_says(tmp_path, undecided, says):
    page = written(tmp_path, undecided=undecided)
    row = page[page.index("Mask&#39;s distance") :][:200]
    assert "-4.20 ± 0.30 % from the design&#39;s" in row
    assert says in row
    vignetting = page[page.index(">Vignetting<") :][:200]
    assert "as designed, within its deviation" in vignetting


def test_maps_are_drawn_with_axes_and_all_but_psi_is_folded(tmp_path):
    page = written(tmp_path)
    assert re.findall(r'<section id="(.*?)"', page) == ["psi"]
    drawn = re.findall(
        r'<img class="shown" src="data:image/svg\+xml;base64,[^"]+" alt="(.*?)"', page
    )
    assert drawn == ["Shadow of the mask", "Error of Psi, by regions", "Residual map"]
    assert "behind the mask, shot 0, view (2, 2): 1 is" in page
    folded = re.findall(r'<details class="folded"><summary><h2>(.*?)</h2>', page)
    assert folded == [
        "Residuals", "Calibration methods", "Mask as fitted",
        "Each whiteboard against the fit", "Provenance",
    ]  # fmt: skip


def test_the_error_of_psi_is_by_region_and_in_percent():
    psi = build_imaging_matrix(find_camera("rgbw-bayer-1shot"), (48, 96))
    rows, columns = REGIONS // 2, REGIONS
    share = np.linspace(0.01, 0.04, rows)[:, None] * np.linspace(1, 2, columns)
    of_pixels = share.repeat(48 // rows, axis=0).repeat(96 // columns, axis=1)
    deviation = psi.weights * of_pixels[:, None, :]  # (shot, v, u, y, stored colour, x)
    errors, whole = error_of_psi(psi, deviation)
    assert errors.shape == (rows, columns)
    np.testing.assert_allclose(errors, 100 * share, rtol=1e-5)
    expected = 100 * np.sqrt(np.square(deviation).sum() / np.square(psi.weights).sum())
    assert whole == pytest.approx(expected, rel=1e-6)

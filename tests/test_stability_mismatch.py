"""The mismatch protocol on a tiny capture: what a moved mask costs, what correction recovers."""

import math
from dataclasses import replace

import numpy as np
import pytest

from calibration.drift import DriftSettings
from emmc_rig.files.cameras import find_camera
from emmc_rig.study.stability import mismatch
from emmc_rig.study.stability.fault_sweep import stability_settings
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.stability.mismatch import (
    Mismatch,
    corrected,
    measure_mismatch,
    mismatch_sections,
    recovered_share,
)
from emmc_rig.study.sweep import NotApplicableError
from emmc_rig.study.trial import Capture
from reconstruction.methods import METHODS

SIZE = (48, 56)
DRIFT = DriftSettings(blocks=40, coarse_blocks=16, disparity_px=1.0, disparity_steps=5, block_px=6)


class Counted:
    def __init__(self):
        self.steps, self.total = 0, None

    def begin(self, stage, steps):
        self.total = steps

    def step(self, detail):
        self.steps += 1


@pytest.fixture
def camera(tmp_path):
    chosen = find_camera("rgbw-bayer-1shot").model_copy(update={"views": (3, 3)})
    path = tmp_path / "small.yaml"
    path.write_text(chosen.model_dump_json())
    return str(path)


def test_a_moved_mask_is_detected_and_psi_corrected_from_the_readings_alone():
    camera = find_camera("rgbw-bayer-1shot").model_copy(update={"views": (3, 3)})
    moved = Point(Capture("deep-occlusions", camera, SIZE, 0, 3), "mask-shift", 0.5).trial()
    psi, detected = corrected(moved, DRIFT)
    assert detected
    before = moved.psi.relative_difference(moved.true_psi)
    assert psi.relative_difference(moved.true_psi) < 0.2 * before


def test_a_camera_without_a_mask_before_its_sensor_is_refused_in_words():
    camera = find_camera("conventional").model_copy(update={"views": (3, 3)})
    moved = Point(Capture("deep-occlusions", camera, SIZE, 0, 3), "exposure", 500.0).trial()
    with pytest.raises(NotApplicableError, match="one mask between lens and sensor"):
        corrected(moved, DRIFT)


def test_the_protocol_loses_by_mismatch_and_recovers_most_of_it(tmp_path, camera, monkeypatch):
    monkeypatch.setattr(mismatch, "QUICK_ERRORS", (("mask-shift", 1.0),))
    monkeypatch.setattr(mismatch, "QUICK_DRIFT", DRIFT)
    settings = stability_settings(True, ["deep-occlusions"], SIZE, camera=camera, methods=("tv",))
    watcher = Counted()
    (row,) = measure_mismatch(settings, tmp_path, watcher)
    assert watcher.steps == watcher.total == 2
    assert row.mismatched < row.ideal - 0.3
    assert abs(row.oracle - row.ideal) < 1.0
    assert row.recovered is not None
    assert row.recovered > 0.6
    # A second run measures nothing again, and one with a method that is not installed no more.
    again = Counted()
    monkeypatch.setattr(Point, "trial", None)
    assert measure_mismatch(settings, tmp_path, again) == [row]
    monkeypatch.setitem(METHODS, "tv-dict", replace(METHODS["tv-dict"], package="no_such_module"))
    more = settings.model_copy(update={"methods": ("tv", "tv-dict")})
    assert measure_mismatch(more, tmp_path, again) == [row]
    sections = mismatch_sections([row], tmp_path)
    assert f"{row.blind:.2f}" in sections[0].body
    assert f"{row.recovered:.0%}" in sections[0].body
    assert (tmp_path / "mismatch-deep-occlusions.svg").is_file()


def test_shares_are_of_what_was_lost():
    row = Mismatch("s", "e", "tv", 30.0, 20.0, 28.0, 26.0, True, 0.5, 0.1)
    assert row.recovered == pytest.approx(0.6)
    assert row.of_oracle == pytest.approx(0.75)
    nothing = replace(row, mismatched=29.95)
    assert nothing.recovered is None
    assert replace(row, blind=math.nan).recovered is None
    more = replace(row, mismatched=25.0, blind=30.0)
    assert recovered_share([row, more, nothing]) == pytest.approx((6 + 5) / (10 + 5))
    assert recovered_share([nothing]) is None
    assert recovered_share([row], of_oracle=True) == pytest.approx(0.75)
    assert np.isfinite(row.psi_error)

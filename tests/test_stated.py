"""`emmc-rig chart --stated`: what is stated of a reconstruction, beside the truth."""

import json

import numpy as np
import pytest

from emmc_rig.files.cameras import find_camera
from emmc_rig.files.results import METRICS
from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.study import guard
from emmc_rig.study import prospects as prospects_module
from emmc_rig.study.prospects import CANDIDATES, UNSURE_DB, Prospect, prospects
from emmc_rig.study.stated import Stated, summary
from emmc_rig.study.trial import Capture
from simulators.scenes import render

SIZE = (48, 64)
CASE = Capture("near-planar", guard.CAMERA, (48, 64), noise=0.004)


def row(expected_db, half_db, true_db, within=(None, None)):
    prospect = Prospect("tv", 1.0, expected_db, expected_db - half_db, expected_db + half_db)
    return Stated(CASE, prospect, true_db, *within)


def test_the_summary_counts_what_held():
    rows = [
        row(30, 3, 32.5, (0.6, 0.9)),
        row(30, 3, 26.0, (0.7, 0.96)),
        row(25, 0.5, 25.8),
        row(25, 0.5, 23.0),
    ]
    assert [one.inside for one in rows] == [True, False, False, False]
    assert rows[3].off_db == pytest.approx(-2)
    lines = summary(rows)
    assert lines[0] == "1 of 4 true PSNRs lie in their interval"
    assert lines[1].startswith("2 were said within 1 dB, and 1 of them are")
    assert lines[2] == "within one deviation: 65% of the errors on average, 60% to 70% (68 % meant)"
    assert lines[3].startswith("within two deviations: 93%")


def test_every_method_of_the_trial_is_compared_with_the_truth(run, monkeypatch, tmp_path):
    monkeypatch.setattr(guard, "NOISES", (0.004,))
    code, out, _ = run(
        "chart", "--stated", "--scene", "near-planar", "--size", "48x64", "--out", "out"
    )
    assert code == 0
    assert "lie in their interval" in out
    metrics = json.loads((tmp_path / "out" / METRICS).read_text())
    assert [one["method"] for one in metrics["rows"]] == list(CANDIDATES)
    for one in metrics["rows"]:
        assert one["low_db"] <= one["psnr_db"] <= one["high_db"]
        assert 10 < one["true_db"] < 40
        assert (one["within_one"] is None) == (one["method"] == "tv")
    assert 0.3 < metrics["rows"][-1]["within_one"] < metrics["rows"][-1]["within_two"]


@pytest.fixture(scope="module")
def capture():
    """Psi, noisy frames of a built-in scene, and its light field."""
    psi = find_camera("scenario-ii-cfa").psi(SIZE)
    truth = render("deep-occlusions", size=SIZE).light_field.astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 0.004, psi.frames_shape)
    frames = (psi.forward(truth) + noise).astype(np.float32)
    return psi, Frames(frames, np.full(frames.shape, 0.004), np.ones(frames.shape, bool)), truth


def test_the_trial_foresees_methods_that_differ_and_brackets_the_best(capture, monkeypatch):
    psi, frames, truth = capture
    solved = {}

    def remembered(name, *args, **kwargs):
        solved[name] = original(name, *args, **kwargs)
        return solved[name]

    original = prospects_module.reconstruct
    monkeypatch.setattr(prospects_module, "reconstruct", remembered)
    expected = prospects(psi, frames)
    assert [one.method for one in expected] == list(CANDIDATES)
    best = expected[-1]
    assert best.high_db - best.low_db == pytest.approx(2 * UNSURE_DB)
    for one in expected:
        true_db = psnr_db(solved[one.method].light_field, truth)
        assert one.low_db < true_db < one.high_db
        assert one.psnr_db <= best.psnr_db
        assert one.seconds > 0


def test_a_trial_runs_on_windows_that_keep_the_pixels_whole(random_psi):
    psi = random_psi(1, (3, 3), (200, 118), 1, 2)
    rows = np.arange(psi.frames_shape[1])[None, :, None] * np.ones(psi.frames_shape)
    windows = list(prospects_module._windows(psi, Frames(rows, rows, rows >= 0)))
    assert [part.size for part, _ in windows] == [(96, 96), (96, 96)]
    for part, seen in windows:
        assert seen.shape == part.frames_shape
    assert windows[0][1].readings[0, 0, 0] == 9
    small = random_psi(1, (3, 3), (20, 24))
    ones = np.ones(small.frames_shape)
    few = Frames(ones, ones, ones > 0)
    assert [part.size for part, _ in prospects_module._windows(small, few)] == [(20, 24)]

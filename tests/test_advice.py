"""`--budget` and `--want` of `emmc-rig reconstruct`: by a trial of the methods on the frames."""

import json
from functools import partial

import numpy as np
import pytest

from emmc_rig.advice import trial
from emmc_rig.advice.recommend import advised, parse_wanted
from emmc_rig.advice.trial import CANDIDATES, UNSURE_DB, Prospect, prospects
from emmc_rig.errors import AppError
from emmc_rig.files.results import METRICS, parse_seconds
from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import psnr_db
from simulators.scenes import render

SIZE = (48, 64)
EXPECTED = [
    Prospect("tv", 1.0, 24.0, 23.7, 24.2),
    Prospect("adaptive-fast", 10.0, 28.0, 26.5, 29.0),
    Prospect("adaptive", 40.0, 30.0, 27.0, 33.0),
]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("30s", 30), ("2min", 120), ("1.5 h", 5400), ("0.5", 0.5), ("3M", 180), ("20ms", 0.02),
     ("500 us", 5e-4), ("1e9", 1e9)],
)  # fmt: skip
def test_times_are_read(text, seconds):
    assert parse_seconds(text, "--budget") == pytest.approx(seconds)


def test_nonsense_is_one_line():
    budget = partial(parse_seconds, option="--budget")
    for call, text in ((budget, "soon"), (budget, "0s"), (budget, "-3s"), (parse_wanted, "good"),
                       (parse_wanted, "28 lux")):  # fmt: skip
        with pytest.raises(AppError, match="write a"):
            call(text)
    assert parse_wanted("28 dB") == 28


def test_a_budget_takes_the_most_accurate_within_it():
    assert advised(EXPECTED, 60).method == "adaptive"
    assert advised(EXPECTED, 12).method == "adaptive-fast"
    late = advised(EXPECTED, 0.5)
    assert late.method == "tv"
    assert "nothing keeps to 0.5 s" in late.why


def test_a_wanted_psnr_takes_the_quickest_that_surely_reaches_it():
    assert advised(EXPECTED, wanted_db=23).method == "tv"
    assert advised(EXPECTED, wanted_db=26).method == "adaptive-fast"
    assert advised(EXPECTED, 5, 26).method == "tv"
    assert "nothing in time reaches 26 dB" in advised(EXPECTED, 5, 26).why


def test_what_the_frames_cannot_tell_is_said():
    between = advised(EXPECTED, wanted_db=31)
    assert between.method == "adaptive"
    assert "cannot tell whether it reaches 31 dB" in between.why
    assert "27 to 33 dB" in between.why
    assert "nothing reaches 34 dB" in advised(EXPECTED, wanted_db=34).why
    assert "about 24.0 dB" in advised(EXPECTED, 2).why


@pytest.fixture(scope="module")
def capture():
    """Psi, noisy frames of a built-in scene, and its light field."""
    from emmc_rig.files.cameras import find_camera
    from emmc_rig.model.camera import build_imaging_matrix

    psi = build_imaging_matrix(find_camera("scenario-ii-cfa"), SIZE)
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

    original = trial.reconstruct
    monkeypatch.setattr(trial, "reconstruct", remembered)
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
    windows = list(trial._windows(psi, Frames(rows, rows, rows >= 0)))
    assert [part.size for part, _ in windows] == [(96, 96), (96, 96)]
    for part, seen in windows:
        assert seen.shape == part.frames_shape
    assert windows[0][1].readings[0, 0, 0] == 9
    small = random_psi(1, (3, 3), (20, 24))
    ones = np.ones(small.frames_shape)
    few = Frames(ones, ones, ones > 0)
    assert [part.size for part, _ in trial._windows(small, few)] == [(20, 24)]


def test_without_enough_readings_nothing_is_promised(capture):
    psi, frames, _ = capture
    part = psi.window(slice(0, 16), slice(0, 16))
    few = Frames(*(a[:, :16, :16] for a in (frames.readings, frames.deviation, frames.usable)))
    expected = prospects(part, few)
    assert (expected[-1].low_db, expected[-1].high_db) == (0, np.inf)
    assert "too few to say" in advised(expected, 1e6).why


def test_reconstruct_chooses_by_a_trial_on_its_frames(run, tmp_path):
    scene = ("--scene", "dark", "--camera", "rgbw-bayer-1shot", "--size", "32x40")
    assert run("simulate", *scene)[0] == 0
    code, _, err = run("reconstruct", "emmc-frames", "--budget", "1h")
    assert code == 0
    assert "the most accurate within 3600 s" in err
    metrics = json.loads((tmp_path / "emmc-reconstruction" / METRICS).read_text())
    assert metrics["chosen"].startswith(metrics["method"])
    for option, wrong, why in (("--budget", "soon", "a time"), ("--want", "good", "a PSNR")):
        code, _, err = run("reconstruct", "emmc-frames", option, wrong)
        assert code == 2
        assert f"write {why}" in err
    assert run("reconstruct", "emmc-frames", "--budget", "9s", "--method", "tv")[0] == 2

"""`--budget` of `emmc-rig reconstruct`: the method that a cost formula says to keep to a time."""

import json
import time
from typing import Any

import numpy as np
import pytest

from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.frames import Frames, even_frames
from emmc_rig.process import cost
from emmc_rig.process.cost import FACTORS, method_within, timed
from emmc_rig.reconstruction.methods import reconstruct
from emmc_rig.simulators.scenes import render
from emmc_rig.store.results import METRICS, parse_seconds

NOT_READ: Any = None
"""Psi and frames, where a trial on them is replaced."""


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("30s", 30), ("2min", 120), ("1.5 h", 5400), ("0.5", 0.5), ("3M", 180), ("20ms", 0.02),
     ("500 us", 5e-4), ("1e9", 1e9)],
)  # fmt: skip
def test_times_are_read(text, seconds):
    assert parse_seconds(text, "--budget") == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["soon", "0s", "-3s"])
def test_nonsense_is_one_line(text):
    with pytest.raises(AppError, match="write a time"):
        parse_seconds(text, "--budget")


def test_a_budget_takes_the_most_accurate_within_it(monkeypatch):
    monkeypatch.setattr(cost, "timed", lambda psi, frames: 10.0)
    for text, method in (("60", "adaptive"), ("35", "adaptive"), ("34", "adaptive-fast"),
                         ("9", "tv"), ("0.5", "tv")):  # fmt: skip
        taken, why = method_within(NOT_READ, NOT_READ, text)
        assert taken == method
        assert f"about {10 * FACTORS[method]:.2g} s" in why
        assert ("none is done within" in why) == (text == "0.5")


@pytest.fixture(scope="module")
def capture():
    """Psi and noisy frames of a built-in scene, larger than the window that is timed."""
    size = (64, 96)
    psi = find_camera("scenario-ii-cfa").psi(size)
    truth = render("deep-occlusions", size=size).light_field.astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 0.004, psi.frames_shape)
    frames = (psi.forward(truth) + noise).astype(np.float32)
    return psi, Frames(frames, np.full(frames.shape, 0.004), np.ones(frames.shape, bool))


@pytest.mark.slow
@pytest.mark.timing("compares two times")
def test_the_time_of_a_window_predicts_that_of_the_whole(capture, monkeypatch):
    monkeypatch.setattr(cost, "WINDOW", 48)
    psi, frames = capture
    timed(psi, frames)  # compiles
    expected = timed(psi, frames)
    started = time.perf_counter()
    reconstruct("adaptive-fast", psi, even_frames(frames.readings, 0.004))
    assert 1 / 3 < expected / (time.perf_counter() - started) < 3


@pytest.mark.slow
def test_reconstruct_chooses_by_the_time(run, tmp_path):
    scene = ("--scene", "dark", "--camera", "rgbw-bayer-1shot", "--size", "32x40")
    assert run("simulate", *scene)[0] == 0
    code, _, err = run("reconstruct", "emmc-frames", "--budget", "1h")
    assert code == 0
    assert "the most accurate within 3600 s" in err
    metrics = json.loads((tmp_path / "emmc-reconstruction" / METRICS).read_text())
    assert metrics["method"] == "adaptive"
    assert metrics["chosen"].startswith("adaptive: ")
    code, _, err = run("reconstruct", "emmc-frames", "--budget", "soon")
    assert code == 2
    assert "write a time" in err
    assert run("reconstruct", "emmc-frames", "--budget", "9s", "--method", "tv")[0] == 2

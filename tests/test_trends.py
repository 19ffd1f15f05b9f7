"""`emmc-rig chart --trends`: PSNR against noise, shots and other methods, on a tiny scene."""

import json

import pytest

from emmc_rig.files.results import METRICS
from emmc_rig.study import trends


def test_a_fall_is_the_largest_from_a_capture_to_any_better_one():
    assert trends.fall_db([20, 24, 23.5, 25, 23.2]) == pytest.approx(1.8)
    assert trends.fall_db([20, 21, 22]) < 0
    assert trends.fall_db([20]) == 0


def test_noise_shots_and_other_methods_are_measured_and_kept(run, monkeypatch, tmp_path):
    monkeypatch.setattr(trends, "NOISES", (0.008, 0.001))
    monkeypatch.setattr(trends, "SHOTS", (1, 2))
    command = ("chart", "--trends", "--scene", "near-planar", "--size", "32x40", "--out", "out")
    code, out, _ = run(*command)
    assert code == 0
    assert "below the best other" in out
    metrics = json.loads((tmp_path / "out" / METRICS).read_text())
    db = {(row["shots"], row["noise"], row["method"]): row["psnr_db"] for row in metrics["rows"]}
    default = trends.DEFAULT_METHOD
    assert set(db) == {(1, 0.008, default), (1, 0.001, default)} | {
        (shots, trends.NOISE, method) for shots in (1, 2) for method in (default, *trends.RIVALS)
    }
    assert all(10 < value < 40 for value in db.values())
    best = max(db[2, trends.NOISE, method] for method in trends.RIVALS)
    loss = best - db[2, trends.NOISE, default]
    assert metrics["losses_db"]["near-planar, 2"] == pytest.approx(loss)
    fall = max(0.0, db[1, 0.008, default] - db[1, 0.001, default])
    assert metrics["falls_db"]["near-planar, less noise"] == pytest.approx(fall)
    monkeypatch.setattr(trends, "trial_of", None)
    assert run(*command)[0] == 0  # every figure is in the folder


def test_shots_that_a_camera_cannot_take_are_left_out(run, monkeypatch):
    monkeypatch.setattr(trends, "NOISES", (0.004,))
    monkeypatch.setattr(trends, "SHOTS", (1, 2))
    monkeypatch.setattr(trends, "RIVALS", ("tv",))
    scene = ("--scene", "near-planar", "--size", "32x40")
    code, out, err = run("chart", "--trends", *scene, "--camera", "rgbw-mono", "--out", "out")
    assert code == 0
    assert "no 'more_shots_step_um' to make 2" in " ".join((out + err).split())

"""Bounds of accuracy and speed: no change makes `adaptive` or `adaptive-fast` worse unseen."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from emmc_rig.study.trial import Capture, trial_of

SIZE, CAMERA = (64, 80), "scenario-ii-cfa"
METHODS = ("adaptive", "adaptive-fast")
PROCEDURAL_DB = {
    "near-planar": (25.97, 24.94),
    "deep-occlusions": (21.37, 21.50),
    "wide-disparity": (19.27, 19.10),
    "toy-table": (22.71, 22.66),
}
REAL_DB = {
    "dice": (29.56, 28.97),
    "dragons": (32.03, 31.03),
    "antinous": (40.26, 38.41),
    "begonia": (32.52, 31.53),
}
"""PSNR in dB of METHODS, as this test measures it; one shot, seed 1, commit eaa06f4b."""
ONE_SCENE_DB, MEAN_DB = 0.3, 0.05
"""Allowed losses: another place of the patches moves a single scene so much, but not the mean."""
OVER_TV = (2.6, 1.6)
"""Allowed processor time of METHODS as multiples of `tv`: measured 1.86 and 1.02."""


def assert_no_loss(psnr_db):
    for scene, (before, now) in psnr_db.items():
        assert np.all(np.subtract(before, now) < ONE_SCENE_DB), (scene, now)
    losses = [np.subtract(before, now) for before, now in psnr_db.values()]
    assert np.all(np.mean(losses, axis=0) < MEAN_DB), losses


def measured(scenes, folder=None):
    found = {}
    for scene, before in scenes.items():
        trial = trial_of(Capture(str(folder / scene) if folder else scene, CAMERA, SIZE, seed=1))
        now = [trial.psnr_db(trial.solved(method).light_field) for method in METHODS]
        found[scene] = before, now
    return found


@pytest.mark.slow
def test_the_accuracy_on_procedural_scenes_does_not_fall():
    assert_no_loss(measured(PROCEDURAL_DB))


@pytest.mark.slow
@pytest.mark.real_data
def test_the_accuracy_on_real_light_fields_does_not_fall():
    assert_no_loss(measured(REAL_DB, Path(os.environ["EMMC_LIGHTFIELDS"])))


@pytest.mark.slow
@pytest.mark.timing("processor time grows where two processes share a core's caches")
def test_the_processor_time_over_that_of_tv_does_not_grow():
    trials = [trial_of(Capture(scene, CAMERA, SIZE, seed=1)) for scene in PROCEDURAL_DB]

    def seconds(method):
        trials[0].solved(method)  # compiles
        return sum(min(run(trial, method) for _ in range(3)) for trial in trials)

    def run(trial, method):
        began = time.process_time()
        trial.solved(method)
        return time.process_time() - began

    tv = seconds("tv")
    ratios = [seconds(method) / tv for method in METHODS]
    assert np.all(np.less(ratios, OVER_TV)), ratios

"""The second search: only where disparities are wide, and of use there."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.adaptive import fits, method
from emmc_rig.reconstruction.adaptive import survey as surveys
from emmc_rig.reconstruction.adaptive.method import reconstruct_adaptive
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings, fast
from emmc_rig.reconstruction.adaptive.survey import checked, searched_again, surfaces_fail, surveyed
from emmc_rig.study.trial import Capture, trial_of

SIZE = (48, 56)
QUICK = fast(AdaptiveSettings()).model_copy(update={"second": True})


@pytest.fixture(scope="module")
def survey():
    """What is decided of frames without texture; its beliefs are set by the tests."""
    psi = build_imaging_matrix(find_camera("rgbw-bayer-1shot"), SIZE)
    frames = psi.forward(np.full(psi.light_field_shape, 0.5, np.float32))
    return surveyed(checked(psi, even_frames(frames, 0.003)), fast(AdaptiveSettings()), None, print)


def believing(survey, disparity, share=1.0):
    """A survey: a share of the patches has a certain disparity, the other patches none."""
    rows, columns = survey.volume.decisive.shape
    wide = np.arange(rows * columns).reshape(rows, columns) < share * rows * columns
    probability = np.stack([~wide, wide], axis=-1).astype(np.float32)
    labels = np.array([0.0, disparity])
    return replace(
        survey, volume=replace(survey.volume, disparities=labels, probability=probability)
    )


# Rays of five views spread over four disparities, here over pixels of one sample.
@pytest.mark.parametrize(("disparity", "again"), [(2.4, False), (2.6, True), (-2.6, True)])
def test_wide_disparities_are_searched_again(survey, disparity, again):
    found = searched_again(believing(survey, disparity), AdaptiveSettings())
    assert (found is not None) == again


@pytest.mark.parametrize(("share", "again"), [(0.05, False), (0.2, True)])
def test_a_few_wide_patches_are_not_worth_a_second_search(survey, share, again):
    found = searched_again(believing(survey, 4.0, share), QUICK)
    assert (found is not None) == again


@pytest.mark.parametrize(
    ("shots", "disparity", "again"), [(1, 4, False), (1, 5, True), (3, 4, True)]
)
def test_one_shot_of_a_large_picture_is_searched_again_for_wider_disparities(
    survey, monkeypatch, shots, disparity, again
):
    monkeypatch.setattr(surveys, "WIDE_BESIDE", 18 / min(SIZE))
    psi = build_imaging_matrix(find_camera(f"rgbw-bayer-{shots}shot{'s' * (shots > 1)}"), SIZE)
    seen = replace(survey, given=replace(survey.given, psi=psi))
    assert (searched_again(believing(seen, disparity), QUICK) is not None) == again


def test_adaptive_fast_searches_once(survey):
    assert searched_again(believing(survey, 4.0), fast(AdaptiveSettings())) is None


@pytest.mark.parametrize(
    ("disparity", "missed", "takes"),
    [(4.0, 0.4, True), (-4.0, 0.4, True), (4.0, 0.3, False), (1.7, 0.6, False)],
)
def test_one_shot_surfaces_fail_where_surfaces_miss_and_disparities_are_large(
    survey, disparity, missed, takes
):
    given = survey.given
    rng = np.random.default_rng(0)
    wild = (given.frames + rng.normal(0, 0.1, given.frames.shape)).astype(np.float32)
    plain = wild - given.psi.forward(np.full(given.psi.light_field_shape, 0.5, np.float32))
    unlike = replace(
        believing(survey, disparity), given=replace(given, frames=wild), plain_residual=plain
    )
    # Of two fits of surfaces the better counts.
    assert surfaces_fail(unlike, [missed * plain, plain]) == takes
    assert 4 * 1.7 < surveys.BESIDE * min(SIZE) < 4 * 4.0


def test_the_second_search_is_less_sure(survey):
    again = searched_again(believing(survey, 4.0), QUICK)
    assert again is not None
    assert again.probability.max(axis=-1).mean() <= survey.volume.probability.max(axis=-1).mean()


def wide_trial(shots):
    """Nested surfaces whose disparities reach 4.6 px."""
    return trial_of(
        Capture("deep-occlusions", "scenario-ii-cfa", (48, 64), 0, 6, shots, noise=0.002)
    )


@pytest.mark.real_data
@pytest.mark.slow
def test_a_second_search_gains_where_disparities_are_wide(monkeypatch):
    """Of dice, with less noise, the first search is surer of disparities, and wrong."""
    dice = str(Path(os.environ["EMMC_LIGHTFIELDS"]) / "dice")
    trial = trial_of(Capture(dice, "scenario-ii-cfa", (64, 80), 0, 1, 3, noise=0.0005))

    def psnr_db():
        found = reconstruct_adaptive(trial.psi, even_frames(trial.readings, trial.noise_sigma))
        return trial.psnr_db(found.light_field)

    again = psnr_db()
    monkeypatch.setattr(method, "searched_again", lambda *_: None)
    assert again > psnr_db() + 1


@pytest.mark.parametrize("known", [False, True])
def test_a_known_disparity_is_not_searched_again(monkeypatch, known):
    trial, asked = wide_trial(1), []
    monkeypatch.setattr(method, "searched_again", lambda *_: asked.append(1))
    disparity = np.full(trial.psi.size, 3.0, np.float32) if known else None
    reconstruct_adaptive(
        trial.psi, even_frames(trial.readings, trial.noise_sigma), QUICK, disparity=disparity
    )
    assert bool(asked) != known


@pytest.mark.parametrize("fail", [False, True])
def test_one_shot_asks_for_patches_where_surfaces_fail(monkeypatch, fail):
    trial, asked = wide_trial(1), []

    def patches(usable, _):
        asked.append(usable)
        return np.full(trial.truth.shape, 0.5, np.float32)

    monkeypatch.setattr(fits, "surfaces_fail", lambda *_: fail)
    reconstruct_adaptive(
        trial.psi,
        even_frames(trial.readings, trial.noise_sigma),
        fast(AdaptiveSettings()).model_copy(update={"patches": 2}),
        patches=patches,
    )
    assert bool(asked) == fail

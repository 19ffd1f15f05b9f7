"""`emmc-rig chart --ablation` and `--next-shot`: on tiny scenes, with one row of each kind."""

import dataclasses

import numpy as np
import pytest

from emmc_rig import ablation, next_shot
from emmc_rig.camera_sheet import find_camera
from emmc_rig.errors import AppError
from emmc_rig.model.camera import build_imaging_matrix
from reconstruction.result import Reconstruction

CAMERA, SIZE = "scenario-ii-cfa", (36, 44)


def test_an_ablation_compares_the_whole_with_what_is_left_and_with_rivals(tmp_path, monkeypatch):
    some = {"sharpening": ablation.LEFT_OUT["sharpening of the disparity"]}
    monkeypatch.setattr(ablation, "LEFT_OUT", some)
    monkeypatch.setattr(ablation, "RIVALS", ("tv",))
    camera = find_camera(CAMERA)
    rows = list(ablation.ablations("deep-occlusions", CAMERA, camera, SIZE, 0, tmp_path))
    assert [row.name for row in rows] == [
        "adaptive",
        "without sharpening",
        "tv",
        "copied true centre view",
    ]
    for row in rows:
        assert row.buys_db == pytest.approx(rows[0].psnr_db - row.psnr_db)


def test_a_camera_goes_to_the_mask_positions_asked_for():
    camera = find_camera(CAMERA)
    moved = next_shot.camera_at(camera, [0, 2])
    in_order = camera.with_shots(3)
    psi, whole = (build_imaging_matrix(c, (8, 8)) for c in (moved, in_order))
    np.testing.assert_array_equal(psi.weights, whole.weights[[0, 2]])
    fixed = camera.model_copy(update={"more_shots_step_um": None})
    with pytest.raises(AppError, match="more_shots_step_um"):
        next_shot.camera_at(fixed, [0, 1])


def test_the_stated_psnr_is_that_of_the_deviation():
    result = Reconstruction(
        "adaptive", np.empty((0,), np.float32), "converged", "", 1, (), 0.0, {},
        {"sigma": np.full((2, 2), 0.1)},
    )  # fmt: skip
    assert next_shot.stated_psnr_db(result) == pytest.approx(20)
    with pytest.raises(AppError, match="states no deviation"):
        next_shot.stated_psnr_db(dataclasses.replace(result, maps={}))


def test_shots_are_planned_until_the_target_or_the_most(monkeypatch):
    monkeypatch.setattr(next_shot, "POSITIONS", 2)
    camera = find_camera(CAMERA)
    rows = list(next_shot.shot_plan("deep-occlusions", camera, SIZE, 60.0, 2, 0))
    assert [row.shots for row in rows] == [1, 2]
    assert rows[0].positions == (0,)
    assert rows[1].positions[1] in range(1, next_shot.POSITIONS + 1)
    assert len(list(next_shot.shot_plan("deep-occlusions", camera, SIZE, 1.0, 2, 0))) == 1

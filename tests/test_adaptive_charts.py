"""`emmc-rig chart --ablation` and `--next-shot`: on tiny scenes, with one row of each kind."""

import numpy as np
import pytest

from emmc_rig.acquisition.plan import planned_camera
from emmc_rig.acquisition.until import refuse_without_choice
from emmc_rig.files.cameras import find_camera
from emmc_rig.progress import Silent
from emmc_rig.session.session import Session
from emmc_rig.study import ablation, constants, next_shot
from emmc_rig.study.oracle import STEP_PX, matched_disparity
from emmc_rig.study.sweep import open_folder
from emmc_rig.study.trial import Capture
from reconstruction.adaptive import search
from reconstruction.adaptive.joint import TextureSettings
from reconstruction.adaptive.search import DECISIVE
from reconstruction.methods import MethodSettings, reconstruct
from reconstruction.tv import TVSettings
from simulators.scenes import render

CAMERA, SIZE = "scenario-ii-cfa", (36, 44)
QUICK = MethodSettings(tv=TVSettings(max_steps=3))


def test_an_ablation_compares_the_whole_with_what_is_left_and_with_rivals(monkeypatch, tmp_path):
    some = {"sharpening": ablation.LEFT_OUT["sharpening of the disparity"]}
    monkeypatch.setattr(ablation, "LEFT_OUT", some)
    monkeypatch.setattr(ablation, "RIVALS", ("tv",))
    given = Capture("deep-occlusions", find_camera(CAMERA), SIZE)
    rows = ablation.ablations(given, tmp_path, Silent())
    assert [row.name for row in rows] == [
        "adaptive",
        "without sharpening",
        "tv",
        ablation.ORACLE,
        "copied true centre view",
    ]
    for row in rows:
        assert row.buys_db == pytest.approx(rows[0].psnr_db - row.psnr_db)
    monkeypatch.setattr(ablation, "_reconstructed", None)
    assert ablation.ablations(given, tmp_path, Silent()) == rows


def test_the_constants_of_the_method_are_those_that_its_modules_and_settings_have():
    found = {one.label: one.value for one in constants.constants()}
    assert found["search.DECISIVE"] == DECISIVE
    assert found["settings.texture.steps"] == TextureSettings().steps
    assert "search.NEAR_PX" in found, "assigned with another"
    assert "settings.nearer" not in found, "no number"
    assert "assembly.TAPS" not in found, "compiled into kernels"


def test_twice_and_half_of_a_constant_are_measured_and_put_back(monkeypatch, tmp_path):
    some = [one for one in constants.constants() if one.name in ("DECISIVE", "momentum")]
    monkeypatch.setattr(constants, "constants", lambda: some)
    seen = []

    def reconstructed(psi, frames, noise_sigma, settings, usable):
        seen.append((search.DECISIVE, settings.texture.momentum))
        return reconstruct("tv", psi, frames, noise_sigma, settings=QUICK, usable=usable)

    monkeypatch.setattr(constants, "reconstruct_adaptive", reconstructed)
    given = [Capture("deep-occlusions", find_camera(CAMERA), SIZE)]
    costs, left_out = constants.constant_costs(given, tmp_path, Silent())
    own = DECISIVE, 0.5
    assert sorted(seen) == sorted([own, (2 * DECISIVE, 0.5), (DECISIVE / 2, 0.5), (DECISIVE, 0.25)])
    assert left_out == ["settings.texture.momentum may not be 1.0"]
    assert {(cost.constant, cost.factor) for cost in costs} == {
        ("search.DECISIVE", 2.0),
        ("search.DECISIVE", 0.5),
        ("settings.texture.momentum", 0.5),
    }
    assert all(cost.mean_db == cost.error_db == cost.worst_db == 0 for cost in costs)
    assert search.DECISIVE == DECISIVE
    monkeypatch.setattr(constants, "reconstruct_adaptive", None)
    assert constants.constant_costs(given, tmp_path, Silent())[0] == costs


def test_the_oracle_matches_the_disparity_that_a_scene_was_rendered_with():
    scene = render("deep-occlusions", (5, 5), (64, 80), 0)
    found = matched_disparity(scene.light_field, 6.0)
    away = np.abs(found - scene.disparity_px)[8:-8, 8:-8]
    assert np.median(away) < STEP_PX
    assert np.mean(away < 0.25) > 0.75


def row(shots, stated_db, psnr_db):
    return next_shot.ShotRow(tuple(range(shots)), stated_db, psnr_db)


ROWS = next_shot.SceneRows(
    "s", (row(1, 24, 25), row(2, 29, 28), row(3, 31, 30)), (row(1, 24, 25), row(2, 26, 27)), 20.0
)


def test_what_choosing_saves_is_read_off_the_rows():
    easy, middle, hard = next_shot.savings(ROWS, (20, 27, 40))
    assert (easy.stopped.count, easy.reached, easy.fixed) == (1, True, 1)
    assert (middle.stopped.count, middle.reached, middle.fixed) == (2, True, 2)
    assert (hard.stopped.count, hard.reached, hard.fixed) == (3, False, None)
    reported = list(next_shot.total_savings([easy, middle, hard]))
    assert reported[0] == (
        "20 dB: 1 shots for 1 scene(s), 1 of which meet it in truth; 1 with the fixed number that "
        "serves them all, 1"
    )
    assert reported[2] == "40 dB: no scene reaches it with the shots there are"


def test_a_plan_to_choose_from_moves_the_mask_and_can_be_calibrated():
    camera = find_camera("rgbw-bayer-1shot")
    plan = next_shot.candidate_plan("rgbw-bayer-1shot", camera, (32, 48))
    refuse_without_choice(plan, planned_camera(plan))
    (dx, dy) = (camera.more_shots_step_um or {})["mask"]
    places = [shot.offset_um.get("mask", (0, 0)) for shot in planned_camera(plan).shots]
    assert places == [(n * dx, n * dy) for n in range(next_shot.PLANNED)]


def test_sessions_are_captured_judged_and_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(next_shot, "PLANNED", 3)
    whole = find_camera("rgbw-bayer-1shot")
    few = tmp_path / "few-views.yaml"
    few.write_text(whole.model_copy(update={"views": (3, 3)}).model_dump_json())
    camera = find_camera(str(few))
    folder = open_folder(tmp_path / "out", next_shot.ROWS, "chart --next-shot")
    reported = []
    watcher = Silent()
    monkeypatch.setattr(watcher, "step", reported.append)

    def measured():
        return next_shot.next_shots(
            ["near-planar"], str(few), camera, (32, 40), 0, folder, watcher, 64, 2
        )

    (scene,) = measured()
    assert [one.count for one in scene.chosen] == [1, 2]
    assert [one.shots for one in scene.in_order] == [(0,), (0, 1)]
    assert scene.chosen[0] == scene.in_order[0]
    (session,) = (folder / next_shot.SESSIONS).iterdir()
    assert Session(session).is_complete
    before = len(reported)
    assert measured() == [scene]
    assert len(reported) == before

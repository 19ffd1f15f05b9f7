"""Views outside of the lens's pupil: filled in by every method, named, and not counted."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

import emmc_rig as emmc
from emmc_rig.model.camera import measured_views
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.pupil import Pupil
from emmc_rig.model.sensing import Psi

SIZE = (36, 48)
CORNERS = [[0, 0], [0, 4], [4, 0], [4, 4]]
NOTE = (
    "Not measured, as no light of theirs reaches the sensor: views (0, 0), (0, 4), (4, 0), (4, 4); "
    "filled in from their neighbours, and not counted in the accuracy"
)


@pytest.fixture(scope="module")
def camera():
    """A stop of 18 mm before 25 mm of views: the corners are shut, their neighbours 6 % open."""
    described = emmc.camera("rgbw-bayer-2shots")
    lens = described.lens.model_copy(update={"pupil": Pupil(diameter_mm=18)})
    return described.model_copy(update={"lens": lens})


@pytest.fixture(scope="module")
def psi(camera):
    return camera.psi(SIZE)


@pytest.fixture(scope="module")
def scene():
    return np.asarray(emmc.scene("near-planar", size=SIZE))


def test_a_psi_says_which_views_it_measures(psi):
    measured = measured_views(psi)
    assert np.argwhere(~measured).tolist() == CORNERS
    nameless = Psi(psi.weights, psi.colour)
    np.testing.assert_array_equal(measured_views(nameless), measured)


@pytest.mark.parametrize("method", ["adaptive-fast", "tv", "tv-dict", "dict-admm"])
def test_every_method_fills_in_the_views_that_no_light_comes_from(psi, scene, method):
    result = emmc.reconstruct(psi, psi @ scene, method, noise_sigma=0.01)
    assert np.isfinite(result.light_field).all()
    corners = [result.light_field[v, u] for v, u in CORNERS]
    true = [scene[v, u] for v, u in CORNERS]
    # The neighbouring views determine the corners.
    assert psnr_db(np.array(corners), np.array(true)) > 14
    assert result.metrics()["views_not_measured"] == CORNERS
    inside = measured_views(psi)
    expected = psnr_db(result.light_field[inside], scene[inside])
    assert result.compare(scene)["psnr_db"] == pytest.approx(expected)
    if result.sigma is not None:
        assert np.isfinite(result.sigma).all()
        apart = result.solved.stated["stated_db"] + 10 * np.log10(
            np.mean(np.square(result.sigma[inside]))
        )
        assert apart == pytest.approx(
            -result.solved.parameters.get("stated_tails_db", 0.0), abs=1e-4
        )


def test_a_camera_whose_views_are_all_open_has_no_such_note(scene):
    psi = emmc.camera("rgbw-bayer-2shots").psi(SIZE)
    result = emmc.reconstruct(psi, psi @ scene, "tv", noise_sigma=0.01)
    assert result.solved.measured is None
    assert "views_not_measured" not in result.metrics()


def test_a_saved_result_names_the_views_on_its_page_and_when_it_is_opened(psi, scene, tmp_path):
    result = emmc.reconstruct(psi, psi @ scene, "tv", noise_sigma=0.01)
    result.save(tmp_path / "result")
    assert f"{NOTE}." in (tmp_path / "result/report.html").read_text(encoding="utf-8")
    again = emmc.open_result(tmp_path / "result")
    np.testing.assert_array_equal(again.solved.measured, result.solved.measured)
    assert again.compare(scene) == result.compare(scene)


@pytest.mark.parametrize("blocks", [False, True])
def test_the_command_line_says_which_views_are_not_measured(run, tmp_path, camera, blocks):
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(camera.model_dump(mode="json")))
    simulated = run(
        "simulate", "--scene", "near-planar", "--camera", "mine.yaml", "--size", "36x48",
        "--out", "frames",
    )  # fmt: skip
    assert simulated[0] == 0, simulated[2]
    (tmp_path / "settings.yaml").write_text("blocks: {whole: 1, side: 24}\n")
    code, said, wrong = run(
        "reconstruct", "frames", "--method", "adaptive-fast", "--truth", "near-planar",
        *(["--settings", "settings.yaml"] if blocks else []), "--out", "result",
    )  # fmt: skip
    assert code == 0, wrong
    assert NOTE in " ".join((said + wrong).split())
    metrics = json.loads((tmp_path / "result/metrics.json").read_text())
    assert metrics["views_not_measured"] == CORNERS
    assert ("blocks" in metrics) == blocks
    result = emmc.open_result(tmp_path / "result")
    truth = np.asarray(emmc.scene("near-planar", size=SIZE))
    assert result.compare(truth)["psnr_db"] == pytest.approx(metrics["psnr_db"])
    assert result.stated_db == pytest.approx(metrics["stated_db"])

"""The whole loop, end to end: no step inverts the operator of the data."""

import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from watching import Recorder

from emmc_rig.demo import DemoSettings, run_demo
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.exports import open_export
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import Camera
from emmc_rig.model.lightfield import load_hdf5, psnr_db, replicate_centre
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.reconstruction.tv import TVSettings

SIZE = (96, 128)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    watcher = Recorder()
    name = "rgbw-bayer-3shots"
    settings = DemoSettings(
        "deep-occlusions", name, find_camera(name), SIZE, 3, method="tv", exact_psi=True
    )
    metrics = run_demo(settings, folder, watcher)
    return folder, metrics, watcher


def test_the_reconstruction_recovers_parallax(demo):
    _, metrics, _ = demo
    assert metrics["psnr_db"] > metrics["replicate_psnr_db"] + 1
    assert metrics["status"] == "converged"


def test_psi_is_measured_well_below_the_error_of_the_design(demo):
    _, metrics, _ = demo
    assert metrics["psi_relative_error"] < 0.01
    assert metrics["design_relative_error"] > 10 * metrics["psi_relative_error"]
    assert abs(metrics["calibration_cost_db"]) < 0.2


def test_the_metrics_are_those_of_the_light_field_written(demo):
    folder, metrics, _ = demo
    written = json.loads((folder / "metrics.json").read_text())
    truth = open_scene("deep-occlusions", size=SIZE, seed=3).light_field
    estimate = load_hdf5(folder / "light_field.h5")
    assert written["psnr_db"] == metrics["psnr_db"]
    assert estimate.shape == truth.shape
    assert psnr_db(estimate, truth) > psnr_db(replicate_centre(truth), truth)
    assert {"scene", "camera", "shots", "ssim", "seconds", "versions", "seed"} <= set(written)


@pytest.mark.slow
def test_another_command_compares_with_the_scene_as_the_demo_did(demo):
    folder, metrics, _ = demo
    opened = open_export(str(folder), metrics["scene"])
    assert opened.truth is not None
    assert psnr_db(opened.light_field, opened.truth) == pytest.approx(metrics["psnr_db"], abs=1e-4)


def test_the_measured_psi_is_saved_with_its_camera(demo):
    folder, _, _ = demo
    psi = Psi.load(folder / "psi.h5")
    described = Camera.model_validate_json(psi.camera_json)
    assert described == find_camera("rgbw-bayer-3shots")
    with h5py.File(folder / "frames.h5") as file:
        frames_dn = np.asarray(file["frames_dn"])
    assert frames_dn.shape == psi.frames_shape
    assert frames_dn.dtype == np.uint16


def test_the_watcher_sees_every_stage_and_exposure(demo):
    _, metrics, watcher = demo
    assert watcher.stages[:3] == ["scene", "design", "capture"]
    assert list(metrics["seconds"]) == watcher.stages
    assert len(watcher.details) > metrics["whiteboard_frames"] + metrics["shots"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_result_and_another_another(tmp_path):
    def run(seed, folder):
        folder.mkdir()
        camera = find_camera("rgbw-bayer-1shot")
        solver = MethodSettings(tv=TVSettings(max_steps=3))
        settings = DemoSettings(
            "near-planar", "c", camera, (32, 32), seed, method="tv", solver=solver
        )
        run_demo(settings, folder)
        return load_hdf5(folder / "light_field.h5")

    first, again, other = run(1, tmp_path / "a"), run(1, tmp_path / "b"), run(2, tmp_path / "c")
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["rgbw-mono", "scenario-i-rgb", "coded-aperture-sequential-random", "learned-aperture"]
)
def test_every_kind_of_sensor_and_mask_runs_the_loop(tmp_path, name):
    settings = DemoSettings(
        "near-planar",
        name,
        find_camera(name),
        (24, 32),
        method="tv",
        solver=MethodSettings(tv=TVSettings(max_steps=5)),
    )
    metrics = run_demo(settings, tmp_path)
    assert metrics["psi_relative_error"] < 0.02
    assert (tmp_path / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_binned_pixels_run_the_loop(tmp_path):
    camera = find_camera("rgbw-bayer-3shots")
    binned = camera.model_copy(update={"sensor": camera.sensor.model_copy(update={"binning": 2})})
    settings = DemoSettings(
        "near-planar",
        "binned",
        binned,
        (48, 64),
        method="tv",
        solver=MethodSettings(tv=TVSettings(max_steps=5)),
    )
    metrics = run_demo(settings, tmp_path)
    assert metrics["psnr_db"] > 10


@pytest.mark.slow
@pytest.mark.real_data
def test_three_shots_of_a_real_light_field_beat_the_copied_centre_view(tmp_path):
    folder = Path(os.environ["EMMC_LIGHTFIELDS"]) / "buttercup"
    camera = find_camera("rgbw-bayer-3shots")
    metrics = run_demo(DemoSettings(str(folder), "rgbw-bayer-3shots", camera, (56, 72)), tmp_path)
    assert metrics["psnr_db"] > metrics["replicate_psnr_db"] + 1


@pytest.mark.slow
def test_the_loop_reconstructs_with_a_dictionary(tmp_path):
    name = "rgbw-bayer-2shots"
    settings = DemoSettings("near-planar", name, find_camera(name), (24, 32), method="dict-admm")
    metrics = run_demo(settings, tmp_path)
    assert metrics["method"] == "dict-admm"
    assert metrics["parameters"]["patches"] > 10


def test_a_method_that_is_not_known_is_reported_before_anything_is_captured(tmp_path):
    settings = DemoSettings("near-planar", "rgbw-mono", find_camera("rgbw-mono"), method="dict-adm")
    with pytest.raises(ReconstructionError, match="did you mean 'dict-admm'"):
        run_demo(settings, tmp_path)
    assert not any(tmp_path.iterdir())

"""`emmc-rig calibrate`: written files, plans, refusals, drift."""

import json
import re

import h5py
import numpy as np
import pytest
import yaml
from programs import done
from simulated_calibration import (
    CalibrateSettings,
    calibrate_simulated,
    in_three_colours,
    true_error,
)
from whiteboard_bench import BenchTruth, WhiteboardBench, moved_truth

from emmc_rig.calibration.drift import DriftSettings
from emmc_rig.calibration.placement import SCALARS
from emmc_rig.calibration.planning import DARK_FRAMES, REFERENCE_FRAMES
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.process.session_drift import run_drift
from emmc_rig.simulators.effects import ORDINARY, TOGETHER, Flaws, flawed
from emmc_rig.store.results import save_frames, write_metrics

SIZE = ["--size", "32x40"]
QUICK = DriftSettings(blocks=40, coarse_blocks=16, disparity_px=1.0, disparity_steps=5, block_px=6)


@pytest.fixture(scope="module")
def camera_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("camera") / "small.yaml"
    path.write_text(
        yaml.safe_dump(
            {
                "title": "small",
                "views": [3, 3],
                "lens": {"aperture_cell_mm": 8.0},
                "sensor": {"cfa": "rggb"},
                "masks": {
                    "code": {
                        "distance_mm": 0.12,
                        "cell_um": 36,
                        "pattern": {"kind": "random_rgbw"},
                    }
                },
                "more_shots_step_um": {"code": [270, 162]},
            }
        )
    )
    return path


def calibrate_into(folder, camera, size=(48, 64), **settings):
    """Write the calibration of a simulated session into an existing folder."""
    found = calibrate_simulated(CalibrateSettings("small", camera, size, **settings)).found
    found.write(folder)
    write_metrics(folder, found.metrics)


@pytest.mark.slow
def test_calibrate_writes_psi_its_uncertainty_and_a_page(camera_file, tmp_path):
    out = tmp_path
    calibrate_into(out, find_camera(str(camera_file)), (32, 40), rays=64)
    psi = Psi.load(out / "psi.h5")
    metrics = json.loads((out / "metrics.json").read_text())
    assert psi.size == (32, 40)
    assert set(metrics["psi_relative_error"]) == {"parametric", "mixed", "free", "combined"}
    assert max(metrics["psi_relative_error"].values()) < 0.1 < metrics["design_relative_error"]
    with h5py.File(out / "calibration.h5") as file:
        assert np.asarray(file["deviation"]).shape == psi.weights.shape
        assert np.asarray(file["good"]).shape == (32, 40)
        assert set(SCALARS) <= set(file.attrs) or metrics["chosen"] == "free"
    page = (out / "report.html").read_text()
    for words in (
        "What to do next",
        "Residual map",
        "Photon transfer",
        "Blur of the mask&#39;s edges",
    ):
        assert words in page
    assert "http" not in page.split("</style>")[1].replace("http://www.w3.org", "")


def test_the_plan_opens_every_view_and_takes_more_frames_where_psi_must_be_surer(
    run, camera_file, tmp_path
):
    frames = []
    for target in ("0.05", "0.0019"):
        out = tmp_path / target
        said = done(
            run(
                "calibrate",
                "--camera",
                camera_file,
                *SIZE,
                "--plan",
                "--target",
                target,
                "--out",
                out,
            )
        )
        assert re.search(r"\d+ frames, and \d of the scene; expected calibration error 0\.", said)
        plan = json.loads((out / "metrics.json").read_text())
        assert plan["expected_relative_error"] <= float(target)
        opened = {tuple(board["pinhole"]) for board in plan["whiteboards"] if board["pinhole"]}
        assert opened == set(np.ndindex(3, 3))
        written = yaml.safe_load((out / "plan.yaml").read_text())
        # As many as the estimate assumes: darks of each exposure before and after, references.
        assert 2 * written["darks"]["of_boards"] == DARK_FRAMES
        assert written["whiteboards"].get("references", 4) == REFERENCE_FRAMES
        frames.append(plan["frames"])
    assert frames[1] > frames[0]


@pytest.mark.slow
@pytest.mark.parametrize("flaws", [ORDINARY, TOGETHER])
def test_psi_is_within_a_percent_and_its_deviation_true_whatever_is_wrong_with_the_bench(
    camera_file, flaws
):
    camera = find_camera(str(camera_file))
    bench = flawed(Flaws(), (flaws,))
    settings = CalibrateSettings("small", camera, (48, 64), flaws=bench, rays=512)
    metrics = calibrate_simulated(settings).found.metrics
    chosen = metrics["chosen"]
    stated, covered = metrics["psi_stated_error"][chosen], metrics["psi_coverage"][chosen]
    assert metrics["psi_relative_error"][chosen] < min(1.25 * stated, 0.01)
    if flaws != TOGETHER:
        assert covered == pytest.approx((0.683, 0.954), abs=0.03)
    else:
        # Of a session with everything wrong at once deviations are stated a little too large.
        assert min(np.subtract(covered, (0.683, 0.954))) > -0.03
        assert stated < 0.01
        found = " ".join(metrics["findings"])
        # Glass displaces single views, as 256 grainy rays do: it is fitted, but not told apart.
        for named in ("tilted", "bowed", "lamp drifted", "response loses", "uneven",
                      "colour filters"):  # fmt: skip
            assert named in found


def test_the_error_of_psi_leaves_bad_pixels_out_and_counts_colours_not_stored(coded_psi):
    psi = coded_psi(binning=2, size=(8, 8))
    true = in_three_colours(psi.weights, psi)
    spoilt = psi.weights.copy()
    spoilt[:, :, :, :2, :, :2] *= 3
    good = np.ones((4, 4), dtype=bool)
    other = Psi(spoilt, psi.colour, 2)
    assert true_error(other, true, good) > 0.1
    good[0, 0] = False
    assert true_error(other, true, good) == 0
    leaking = true + 0.1 * true.sum(axis=4, keepdims=True)
    assert true_error(psi, leaking, good) > 0.1


@pytest.fixture(scope="module")
def calibrated(camera_file, tmp_path_factory):
    """A calibration on disk, and the camera."""
    camera = find_camera(str(camera_file))
    folder = tmp_path_factory.mktemp("known")
    truth = BenchTruth(rays_per_view=256)
    calibrate_into(folder, camera, route="mixed", rays=256)
    return folder, camera, truth


def frames_of(folder, camera, truth):
    fine = fine_scene("deep-occlusions", 2, 2, size=(48, 64), views=camera.views, seed=3)
    bench = WhiteboardBench(camera, (48, 64), truth, 7, fine.samples)
    frames, exposures_s = bench.capture_scene()
    noise, times = camera.sensor.noise, exposures_s[:, None, None]
    readings = noise.normalise(frames, times, 1.0)
    deviation = np.sqrt(noise.variance(readings, times, 1.0))
    hot, dead = truth.sensor.bad((48, 64))
    usable = ~noise.saturated(frames) & ~(hot | dead)
    folder.mkdir()
    save_frames(folder / "frames.h5", Frames(readings, deviation, usable))
    return folder


@pytest.mark.slow
def test_that_the_mask_has_moved_is_reported_and_psi_mended(calibrated, tmp_path):
    known, camera, truth = calibrated
    moved = moved_truth(truth, 9.0, -8.0)
    frames = frames_of(tmp_path / "frames", camera, moved)
    out = tmp_path / "mended"
    out.mkdir()
    reported = run_drift(known, frames, out, QUICK)
    assert reported["drifted"]
    assert "Psi no longer fits" in reported["words"]
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["values"]["shift_x_um"] == pytest.approx(9.0, abs=1.0)
    assert metrics["values"]["shift_y_um"] == pytest.approx(-8.0, abs=1.0)
    before, after = (Psi.load(folder / "psi.h5") for folder in (known, out))
    true = WhiteboardBench(camera, (48, 64), moved).true_psi()
    good = np.ones((48, 64), dtype=bool)
    assert true_error(after, true, good) < 0.3 * true_error(before, true, good)


@pytest.mark.slow
def test_a_free_psi_is_taken_too_and_a_mask_far_off_is_refused_with_nothing_written(
    calibrated, tmp_path
):
    _, camera, truth = calibrated
    known = tmp_path / "free"
    known.mkdir()
    calibrate_into(known, camera, route="free", rays=256)
    moved = moved_truth(truth, 40.0, -8.0)
    out = tmp_path / "mended"
    out.mkdir()
    reported = run_drift(known, frames_of(tmp_path / "frames", camera, moved), out, QUICK)
    assert reported["drifted"]
    assert reported["values"]["shift_x_um"] == pytest.approx(40.0, abs=1.0)
    before, after = (Psi.load(folder / "psi.h5") for folder in (known, out))
    true = WhiteboardBench(camera, (48, 64), moved).true_psi()
    good = np.ones((48, 64), dtype=bool)
    assert true_error(after, true, good) < 0.2 * true_error(before, true, good)
    frames = frames_of(tmp_path / "far", camera, moved_truth(truth, 300.0, 0.0))
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    with pytest.raises(AppError, match="searched: shifts up to 8 pixels"):
        run_drift(known, frames, nothing, QUICK)
    assert not list(nothing.iterdir())


def test_drift_refuses_frames_of_another_size(run, calibrated, tmp_path):
    known, camera, truth = calibrated
    frames = frames_of(tmp_path / "frames {x}", camera, truth)
    with h5py.File(frames / "frames.h5", "a") as file:
        for name in ("readings", "deviation", "usable"):
            cut = np.asarray(file[name])[:, :-2]
            del file[name]
            file[name] = cut
    code, _, error = run("calibrate", "--drift", frames, "--known", known)
    assert code == 1
    assert "this calibration is for 1 frames of 48 x 64 pixels" in " ".join(error.split())
    code, _, error = run("calibrate", "--drift", frames, "--known", tmp_path)
    assert code == 1
    assert "name the folder of a calibration" in " ".join(error.split())

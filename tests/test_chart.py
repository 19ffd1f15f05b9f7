"""The parts of a chart: fronts, scores, growth, and the timing lock."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.files.memory import peak_memory_mib
from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import replicate_centre
from emmc_rig.study.chart.captures import kept_capture, read_frames, read_truth
from emmc_rig.study.chart.chart_sweep import timing_lock
from emmc_rig.study.chart.front import POOLED, Mark, charts, growths, pareto_front
from emmc_rig.study.chart.peers import PEERS
from emmc_rig.study.chart.points import (
    ChartSettings,
    Configuration,
    Point,
    charted_points,
    scalings,
)
from emmc_rig.study.scores import angular_snr_db, scored, swept_disparity
from emmc_rig.study.trial import Capture
from reconstruction.dictionary import dct_dictionary
from reconstruction.methods import MethodSettings, installed_methods, reconstruct
from simulators.scenes import render

SETTINGS = ChartSettings(scenes=("dark",), cameras=("rgbw-bayer-1shot",), size=(24, 32))


def mark(method, seconds, psnr):
    return Mark(Configuration(method), seconds, psnr, ())


def plane(disparity, views=(5, 5), size=(40, 48)):
    """A texture of few waves, exact at any disparity: (v, u, y, x, 3)."""
    v, u, y, x = np.meshgrid(*(np.arange(n) for n in (*views, *size)), indexing="ij")
    y, x = y - disparity * (v - views[0] // 2), x - disparity * (u - views[1] // 2)
    waves = [
        0.5 + 0.2 * np.sin(0.7 * x + k) + 0.2 * np.cos(0.6 * y + 0.3 * x + 2 * k) for k in range(3)
    ]
    return np.stack(waves, axis=-1).astype(np.float32)


def test_the_front_is_what_nothing_beats():
    a, b, c = mark("a", 1, 20), mark("b", 2, 25), mark("c", 4, 26)
    beaten = [mark("d", 2, 24), mark("e", 3, 25), mark("f", 9, 26)]
    assert pareto_front([c, *beaten, b, a]) == [a, b, c]


def test_pooled_are_the_configurations_of_every_scene():
    tv, omp = Configuration("tv"), Configuration("dict-omp")
    results = {
        Point(Capture("dark", "cam"), tv): figures(1.0, 20.0),
        Point(Capture("far", "cam"), tv): figures(4.0, 30.0),
        Point(Capture("dark", "cam"), omp): figures(1.0, 22.0),
        Point(Capture("far", "cam"), omp): {"failed": "not done"},
    }
    pooled, *singles = charts(results)
    assert pooled.scene == POOLED
    assert [(m.configuration, m.seconds, m.psnr_db) for m in pooled.marks] == [
        (tv, pytest.approx(2.0), 25.0)
    ]
    assert [len(chart.marks) for chart in singles] == [2, 1]


def figures(seconds, psnr, **more):
    return {
        "seconds": seconds, "psnr_db": psnr, "replicate_psnr_db": 18.0, "peak_mib": 300.0,
        "base_mib": 200.0, "steps": 30, "shots": 1, "binning": 1, "views": [5, 5],
        "size": [64, 80], "colours_stored": 1, "cpu_seconds": seconds, "reference_s": 0.1,
        "reference_cpu_s": 0.1, "dictionary_s": 0.0, **more,
    }  # fmt: skip


def test_a_picture_copied_to_every_view_has_an_angular_snr_of_0_db():
    truth = plane(0.8)
    assert angular_snr_db(replicate_centre(truth), truth) == pytest.approx(0, abs=1e-9)
    assert angular_snr_db(truth, truth) == np.inf
    # Differences a tenth wrong: 20 dB, whatever the views' mean.
    wrong = truth + 0.1 * (truth - truth.mean(axis=(0, 1))) + 0.05
    assert angular_snr_db(wrong, truth) == pytest.approx(20, abs=1e-3)
    assert np.isnan(angular_snr_db(truth, replicate_centre(truth)))


@pytest.mark.parametrize("disparity", [-0.6, 0.0, 1.2])
def test_the_sweep_finds_the_disparity_of_a_plane(disparity):
    found = swept_disparity(plane(disparity), disparity - 0.4, disparity + 0.4)
    np.testing.assert_allclose(found[8:-8, 8:-8], disparity, atol=0.051)


def test_scores_of_the_truth_are_perfect_up_to_the_sweep():
    scene = render("near-planar", size=(32, 40))
    truth, disparity = scene.light_field, scene.disparity_px
    scores = scored(truth, truth, disparity, disparity)
    assert scores.psnr_db == np.inf
    assert scores.ssim == pytest.approx(1)
    assert scores.disparity_mae_px == scores.floor_mae_px
    assert scores.own_disparity_mae_px == 0
    assert scored(truth, truth).disparity_mae_px is None


def test_every_method_is_planned_and_every_rival():
    planned = {point.configuration.method for point in charted_points(SETTINGS)}
    assert planned == {*installed_methods(), *PEERS}
    labels = [point.label for point in charted_points(SETTINGS)]
    assert len(set(labels)) == len(labels)


def size_of(point):
    assert point.capture.size is not None
    return list(point.capture.size)


def test_growth_is_fitted_and_compared_with_what_the_method_counts():
    swept = [s for s in scalings(SETTINGS, 2) if s.configuration.method == "tv"]
    assert {s.axis for s in swept} == {"pixels", "views", "shots", "disparity range", "cores"}
    pixels, shots = swept[0], next(s for s in swept if s.axis == "shots")
    results = {
        p: figures(2e-6 * at**1.3, 20.0, size=size_of(p), peak_mib=200 + 1e-3 * at)
        for at, p in zip(pixels.at, pixels.points, strict=True)
    }
    results |= {
        p: figures(1.0, 20.0, shots=p.capture.shots, size=size_of(p))
        for p in shots.points
        if p not in results
    }
    growth, of_shots = growths([pixels, shots], results)
    assert growth.exponent == pytest.approx(1.3)
    assert growth.expected == pytest.approx(1)
    # 1 byte in a thousand, so that the smallest picture adds too little to differ from noise.
    assert growth.at[0] * 1e-3 < 8 < growth.at[1] * 1e-3
    assert growth.memory_exponent == pytest.approx(1)
    assert growth.expected_memory == pytest.approx(1)
    # 40 + 4/3 s bytes a value and step, two and three shots.
    expected = np.log((40 + 4) / (40 + 4 / 3)) / np.log(3)
    assert of_shots.expected == pytest.approx(expected)


def test_the_lock_lets_one_in_and_names_who_holds_it(tmp_path):
    path, reported = tmp_path / "lock", []

    def give_up(_):
        raise TimeoutError

    with timing_lock("the first", path):  # noqa: SIM117
        with pytest.raises(TimeoutError), timing_lock("the second", path, reported.append, give_up):
            pytest.fail("two at once")
    assert len(reported) == 1
    assert reported[0].endswith("the first")
    with timing_lock("the third", path, reported.append, give_up):
        pass
    assert len(reported) == 1


def test_a_child_keeps_the_lock_when_its_parent_is_gone(tmp_path):
    path = tmp_path / "lock"

    def give_up(_):
        raise TimeoutError

    with timing_lock("a parent", path) as lock:
        waits = "import sys; sys.stdin.read()"
        child = subprocess.Popen([sys.executable, "-c", waits], stdin=-1, pass_fds=(lock,))
    with pytest.raises(TimeoutError), timing_lock("another", path, None, give_up):
        pytest.fail("two at once")
    child.communicate()
    with timing_lock("another", path, None, give_up):
        pass


def test_the_peak_of_memory_is_not_the_parents():
    held = np.ones(200 * 2**17)
    code = "from emmc_rig.files.memory import peak_memory_mib; print(peak_memory_mib())"
    reported = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert 0 < float(reported.stdout) < 150 < peak_memory_mib()
    assert held.nbytes == 200 * 2**20


def test_a_capture_is_made_once_and_its_truth_kept_apart(tmp_path):
    capture = Capture("wide-disparity", "rgbw-bayer-1shot", (20, 24), zoom=2)
    path, digest = kept_capture(capture, tmp_path)
    before = path.stat().st_mtime_ns
    assert kept_capture(capture, tmp_path) == (path, digest)
    assert path.stat().st_mtime_ns == before
    assert kept_capture(replace(capture, seed=1), tmp_path)[1] != digest
    (psi, frames), (truth, disparity) = read_frames(path), read_truth(path)
    assert truth.shape == psi.light_field_shape == (5, 5, 20, 24, 3)
    rendered = render("wide-disparity", size=(40, 48))
    np.testing.assert_array_equal(disparity, rendered.disparity_px[10:30, 12:36])
    kept = frames.readings[frames.usable] - psi.forward(truth)[frames.usable]
    assert kept.std() == pytest.approx(frames.noise_sigma, rel=0.2)


def given(size=(20, 24)):
    truth = render("deep-occlusions", size=size).light_field
    capture = Capture("deep-occlusions", "rgbw-bayer-1shot", size)
    from emmc_rig.model.camera import build_imaging_matrix

    psi = build_imaging_matrix(capture.described, size)
    usable = np.random.default_rng(0).random(psi.frames_shape) < 0.9
    frames = np.where(usable, psi.forward(truth), 9).astype(np.float32)
    return psi, Frames(frames, np.full(frames.shape, 1e-3), usable)


def test_scikit_learn_codes_as_we_do():
    pytest.importorskip("sklearn")
    (psi, frames), dictionary = given(), dct_dictionary((5, 5), (8, 8), (2, 2, 3, 3), (1, 1, 1, 1))
    theirs = PEERS["sklearn-omp"].solve(psi, frames, dictionary)
    solver = {"method": "omp", "atoms": 20, "tolerance_factor": 0}
    settings = {"sparse": {"flat_favour": 1, "solver": solver}}
    ours = reconstruct(
        "dict-omp", psi, frames.readings, 1e-3, dictionary,
        MethodSettings.model_validate(settings), frames.usable,
    )  # fmt: skip
    assert np.abs(ours.light_field - theirs.light_field).mean() < 2e-3


def test_pyproximal_leaves_out_what_is_not_usable():
    pytest.importorskip("pyproximal")
    psi, frames = given()
    theirs = PEERS["pyproximal-tv"].solve(psi, frames, None)
    settings = {"tv": {"chroma_weight": 1, "relaxation": 1, "max_steps": 100, "rtol": 1e-12}}
    ours = reconstruct(
        "tv", psi, frames.readings, 1e-3, None,
        MethodSettings.model_validate(settings), frames.usable,
    )  # fmt: skip
    assert np.abs(ours.light_field - theirs.light_field).mean() < 2e-3

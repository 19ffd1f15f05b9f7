"""The parts of a chart: fronts and scores."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.model.lightfield import replicate_centre
from emmc_rig.process.cost import peak_memory_mib
from emmc_rig.reconstruction.methods import installed_methods
from emmc_rig.simulators.scenes import render
from emmc_rig.study.chart.chart_points import ChartSettings, Configuration, Point, charted_points
from emmc_rig.study.chart.charting import POOLED, Chart, Mark, answer, charts, pareto_front
from emmc_rig.study.scores import angular_snr_db, scored, swept_disparity
from emmc_rig.study.trial import Capture

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


def test_a_chart_is_answered_in_words():
    chart = Chart("dark", "cam", (mark("tv", 1, 20), mark("adaptive", 4, 26)), 18.0)
    assert answer(chart) == (
        "adaptive is the most accurate: 26.00 dB in 4 s, +8.00 dB against the baseline (centre "
        "view in all places). The quickest, tv, takes 1 s and loses 6.00 dB."
    )
    alone = replace(chart, marks=chart.marks[:1])
    assert answer(alone).endswith("Nothing is quicker.")


def test_pooled_are_the_configurations_of_every_scene():
    tv, omp = Configuration("tv"), Configuration("dict-admm")
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


def figures(seconds, psnr):
    return {"seconds": seconds, "psnr_db": psnr, "replicate_psnr_db": 18.0}


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


def test_every_method_is_planned():
    planned = {point.configuration.method for point in charted_points(SETTINGS)}
    assert planned == set(installed_methods())
    labels = [point.label for point in charted_points(SETTINGS)]
    assert len(set(labels)) == len(labels)


def test_the_peak_of_memory_is_not_the_parents():
    held = np.ones(400 * 2**17)
    code = "from emmc_rig.process.cost import peak_memory_mib; print(peak_memory_mib())"
    reported = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert 0 < float(reported.stdout) < 300 < peak_memory_mib()
    assert held.nbytes == 400 * 2**20

"""Theory beside the sweeps: scene statistics, the oracle against the bound, verdicts and tables."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from emmc_rig.files.cameras import find_camera
from emmc_rig.model.errors import CameraError
from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.study import trial
from emmc_rig.study.stability import sweeping, theory
from emmc_rig.study.stability.fault_sweep import stability_settings
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.stability.theory import (
    Place,
    Seen,
    measure_theory,
    misplaced,
    patch_texture,
    predicted,
)
from emmc_rig.study.stability.theory_section import (
    Compared,
    agreement,
    compared,
    rank_correlation,
    theory_sections,
)
from emmc_rig.study.trial import Capture, Trial
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.theory.patch import SIDE, PatchModel, Texture

CAMERA = find_camera("rgbw-bayer-1shot").model_copy(update={"views": (3, 3)})
CAPTURE = Capture("near-planar", CAMERA, (32, 40), 0, 4)


class Counted:
    def __init__(self):
        self.steps, self.total = 0, 0

    def begin(self, stage, steps):
        self.total += steps

    def step(self, detail):
        self.steps += 1


@pytest.fixture(scope="module")
def capture():
    return Point(CAPTURE, "exposure", 15_500).trial()


def test_the_variogram_gives_back_the_texture_that_was_drawn():
    texture = Texture(0.02, 0.15)
    y, x = (axis.ravel() for axis in np.indices((24, 24)))
    square = np.square(np.subtract.outer(y, y)) + np.square(np.subtract.outer(x, x))
    root = np.linalg.cholesky(texture.prior.covariance(square.astype(float)) + 1e-9 * np.eye(576))
    rng = np.random.default_rng(0)
    drawn = [root @ rng.standard_normal((576, 3)) * np.sqrt(texture.variances) for _ in range(20)]
    found = [
        patch_texture((one @ OPPONENT + 0.5).reshape(24, 24, 3), TexturePrior()) for one in drawn
    ]
    assert np.mean([one.amplitude for one in found]) == pytest.approx(0.02, rel=0.05)
    assert np.mean([one.chroma for one in found]) == pytest.approx(0.15, rel=0.15)


def test_a_texture_misplaced_far_is_wrong_by_twice_its_variance():
    texture = Texture(0.03, 0.1)
    mean = texture.variances.sum() / 3
    assert misplaced(texture, 0.0, (3, 3)) == 0
    # The centre view is never misplaced.
    assert misplaced(texture, 1e3, (3, 3)) == pytest.approx(2 * mean * 8 / 9, rel=1e-3)


def test_on_gaussian_scenes_the_oracle_meets_the_bound(capture):
    psi = capture.psi
    free, rng, errors = Texture(0.01, 0.1), np.random.default_rng(0), []
    texture = replace(free, mean_known=True)
    patch = PatchModel.of(psi, (8, 8))
    root = np.linalg.cholesky(patch.alike(0.4, free) + 1e-10 * np.eye(len(patch.rays)))
    variance = np.full(psi.frames_shape, 1e-5)
    bounds = set()
    for _ in range(40):
        opponent = root @ rng.standard_normal((len(patch.rays), 3)) * np.sqrt(texture.variances)
        truth = np.zeros(psi.light_field_shape, np.float32)
        rays = (0.5 + opponent @ OPPONENT).reshape(3, 3, SIDE, SIDE, 3)
        truth[:, :, 8:16, 8:16] = rays
        readings = psi.forward(truth) + np.sqrt(variance) * rng.standard_normal(variance.shape)
        made = replace(capture, readings=readings.astype(np.float32), truth=truth)
        seen = Seen(made, variance, np.full(psi.size, 0.4))
        place = Place((8, 8), 0.4, texture, rays.mean(axis=(0, 1, 2, 3)))
        found = predicted(seen, [place])
        bounds.add(round(found["bound_db"], 9))
        errors.append(10 ** (-found["oracle_db"] / 10))
    assert len(bounds) == 1
    bound = 10 ** (-bounds.pop() / 10)
    assert abs(np.mean(errors) - bound) < 4 * np.std(errors) / np.sqrt(40)


def test_less_light_and_unusable_pixels_lower_the_bound(capture):
    def bound(made: Trial) -> float:
        seen = Seen.of(made)
        return predicted(seen, seen.places(4))["bound_db"]

    usual = bound(capture)
    dim = Point(CAPTURE, "exposure", 50).trial()
    assert bound(dim) < usual - 3
    holes = np.random.default_rng(0).random(capture.usable.shape) < 0.6
    assert bound(replace(capture, usable=~holes)) < usual - 1


def curve(levels, bound, whole=False):
    fault = FAULTS["shots" if whole else "exposure"]
    strengths = (10_000.0, 1_000.0, 100.0, 10.0)
    filled = {"tv_db": levels, "bound_db": bound, "oracle_db": bound, "found_db": bound}
    return Compared("s", fault, strengths, filled, ("tv",))


def test_a_break_is_predicted_missed_early_or_late():
    falls = (30.0, 29.0, 24.0, 20.0)
    assert agreement(curve(falls, falls), "tv").startswith("predicted (factor 1.0)")
    assert agreement(curve((30, 26, 25, 24), falls), "tv").startswith("method sooner (factor ")
    assert agreement(curve((30, 30, 30, 20), falls), "tv").startswith("method later")
    assert agreement(curve(falls, (30, 30, 29, 28)), "tv") == "method only"
    assert agreement(curve((30, 30, 29, 28), falls), "tv") == "theory only"
    assert agreement(curve((30, 30, 29, 28), (31, 30, 29, 29)), "tv") == "neither breaks"
    assert agreement(curve((None,) * 4, falls), "tv") == "not measured"
    assert agreement(curve(falls, falls, whole=True), "tv") == "predicted"


def test_rank_correlation_takes_infinity_as_largest():
    assert rank_correlation((1, 2, np.inf), (3.0, 2.0, 1.0)) == pytest.approx(-1)
    assert rank_correlation((1, None, 2), (3.0, 2.0, 1.0)) is None
    assert rank_correlation((np.inf,) * 3, (3.0, 2.0, 1.0)) is None


def test_points_are_kept_and_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(theory, "QUICK_SWEPT", ("exposure",))
    monkeypatch.setattr(trial, "find_camera", lambda name: CAMERA)
    monkeypatch.setattr(theory, "QUICK_PATCHES", (4, 1))
    settings = stability_settings(True, ["near-planar"], (32, 40), camera="small")
    watcher = Counted()
    points = measure_theory(settings, tmp_path, watcher, ("tv",))
    assert watcher.steps == watcher.total == len(FAULTS["exposure"].quick)
    bounds = [one["bound_db"] or np.nan for one in points.values()]
    assert all(bounds[i] > bounds[i + 1] for i in range(len(bounds) - 1))
    monkeypatch.setattr(Point, "trial", None)
    assert measure_theory(settings, tmp_path, Counted(), ("tv",)) == points
    (section,) = theory_sections(points, ("tv",), tmp_path)
    assert "Exposure" in section.body
    assert (tmp_path / "theory-near-planar.png").is_file()
    one = compared(points, ("tv",))[0]
    assert one.levels["tv_db"] == tuple(found["tv_db"] for found in points.values())


def test_parts_are_measured_into_the_folder_of_the_sweeps(tmp_path, monkeypatch):
    figures = {"bound_db": 30.0, "oracle_db": 29.5, "tv_db": 28.0, "adaptive-fast_db": 27.0}
    points = {
        Point(CAPTURE, "exposure", s): {k: v - 5 * i for k, v in figures.items()}
        for i, s in enumerate((15_500.0, 500.0, 5.0))
    }
    monkeypatch.setattr(sweeping, "measure_theory", lambda *_: points)
    settings = stability_settings(True, ["near-planar"], None)
    found = sweeping.measure_beside(settings, ["theory"], tmp_path / "out", Counted())
    assert [section.key for section in found.sections] == ["theory-near-planar"]
    assert "in 2 of 2 curves" in found.lines[0]
    metrics = found.metrics["theory"]
    assert isinstance(metrics, dict)
    assert metrics["oracle_less_bound_db"]["mean"] == pytest.approx(-0.5)
    rows = (tmp_path / "out" / "theory.csv").read_text("utf-8").splitlines()
    assert rows[0].startswith("scene,fault,strength,bound_db")
    assert len(rows) == 4


def test_nothing_is_written_for_a_wrong_camera_or_no_part(tmp_path):
    settings = stability_settings(True, ["near-planar"], None)
    assert sweeping.measure_beside(settings, [], tmp_path / "out", Counted()).sections == []
    wrong = settings.model_copy(update={"camera": "rgbw-mno"})
    with pytest.raises(CameraError, match="rgbw-mno"):
        sweeping.measure_beside(wrong, ["theory"], tmp_path / "out", Counted())
    assert not (tmp_path / "out").exists()


def test_a_part_that_does_not_apply_is_left_out_in_words(tmp_path):
    settings = stability_settings(True, ["near-planar"], (32, 40), camera="coded-aperture-random")
    found = sweeping.measure_beside(settings, ["mismatch"], tmp_path / "out", Counted())
    assert found.sections == []
    assert "one mask between lens and sensor" in found.lines[0]


def test_the_command_has_a_switch_for_each_part():
    from emmc_rig.cli import app

    reported = CliRunner().invoke(
        app, ["stability", "--help"], env={"COLUMNS": "200", "TERM": "dumb"}
    )
    for part in sweeping.PARTS:
        assert f"--{part}" in reported.output

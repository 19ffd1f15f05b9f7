"""The worst perturbation against methods whose worst is known; details kept, lost and invented."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.files.cameras import find_camera
from emmc_rig.study.stability.details import SHAPES, Detail, shown
from emmc_rig.study.stability.sensor_faults import exposure
from emmc_rig.study.stability.worst import TILE_PX, confined, worst_perturbation
from emmc_rig.study.trial import Capture
from reconstruction.methods import METHODS

SHAPE = (1, 2 * TILE_PX, 2 * TILE_PX)
GREY = np.full((3, 3, 32, 40, 3), 0.4, dtype=np.float32)


def amplifying(weak, factor):
    """A linear method that passes everything, and one direction of each tile times `factor`."""

    def solve(readings):
        tiles = np.tile(weak, (1, 2, 2))
        along = (readings * tiles).reshape(2, TILE_PX, 2, TILE_PX).sum((1, 3))
        grown = readings + (factor - 1) * tiles * along.repeat(TILE_PX, 0).repeat(TILE_PX, 1)
        return np.repeat(grown[0][None, None, ..., None], 3, axis=-1)

    return solve


def weak_direction():
    weak = np.random.default_rng(5).standard_normal((1, TILE_PX, TILE_PX))
    return weak / np.linalg.norm(weak)


def test_the_perturbation_turns_towards_the_direction_that_a_method_amplifies():
    weak, readings, deviation = weak_direction(), np.full(SHAPE, 0.5), np.full(SHAPE, 0.01)
    solve, rng = amplifying(weak, 30.0), np.random.default_rng(0)
    truth = solve(readings)
    found = {
        rounds: worst_perturbation(solve, readings, deviation, truth, rng, rounds)
        for rounds in (1, 6)
    }
    tile = (found[6].perturbation / deviation)[:, :TILE_PX, :TILE_PX]
    assert abs(np.vdot(tile, weak)) / np.linalg.norm(tile) > 0.6
    assert found[6].gain > found[1].gain > 1.3


def test_no_perturbation_is_worse_than_noise_for_a_method_that_treats_all_alike():
    readings, deviation = np.full(SHAPE, 0.5), np.full(SHAPE, 0.01)
    solve = amplifying(weak_direction(), 1.0)
    found = worst_perturbation(
        solve, readings, deviation, solve(readings), np.random.default_rng(0)
    )
    assert found.gain == pytest.approx(1, abs=1e-6)


def test_the_perturbation_is_as_large_as_noise_in_every_tile():
    deviation = np.random.default_rng(1).uniform(0.01, 0.02, SHAPE)
    solve = amplifying(weak_direction(), 9.0)
    found = worst_perturbation(
        solve, np.full(SHAPE, 0.5), deviation, GREY[:1, :1, :16, :16], np.random.default_rng(0)
    )
    for one in (found.perturbation, found.random):
        tiles = (one / deviation).reshape(2, TILE_PX, 2, TILE_PX)
        assert np.square(tiles).sum((1, 3)) == pytest.approx(np.full((2, 2), TILE_PX**2))


def test_a_confined_perturbation_is_nothing_outside():
    kept, square = confined(np.ones((2, 20, 30)), 16)
    assert kept.sum() == 2 * 16 * 16
    assert (square[0].start, square[1].stop) == (2, 23)


@pytest.mark.parametrize("kind", SHAPES)
def test_a_detail_is_kept_by_truth_and_lost_by_a_picture_without_it(kind):
    detail = Detail(kind, 2, 0.2)
    truth = detail.put_into(GREY, 1.0)
    found = shown(truth, GREY, truth, GREY)
    assert (found.kept, found.invented, found.fate) == (pytest.approx(1), pytest.approx(0), "kept")
    assert shown(GREY, GREY, truth, GREY).fate == "lost"
    assert shown(truth, truth, truth, GREY).fate == "invented"


def test_a_detail_moves_from_view_to_view_by_its_disparity():
    seen = Detail("glint", 2, 0.3).put_into(GREY, 2.0) - GREY
    rows, columns = (np.flatnonzero(seen[0, 2].sum(-1).sum(axis)) for axis in (1, 0))
    assert rows.tolist() == [13, 14]
    assert columns.tolist() == [21, 22]


def test_a_detail_that_cannot_be_brighter_is_darker():
    white = np.ones_like(GREY)
    assert Detail("letter", 1, 0.3).put_into(white, 0.0).min() == pytest.approx(0.7)


@pytest.mark.parametrize("camera", ["rgbw-bayer-1shot", "rgbw-mono", "scenario-i-rgb"])
def test_a_million_electrons_are_not_clipped_and_less_noisy(camera):
    setup = Capture("near-planar", find_camera(camera), (24, 32))
    many, few = exposure(setup, 1e6), exposure(setup, 15_500)
    assert many.usable.all()
    assert many.noise_sigma < 0.3 * few.noise_sigma
    clean = many.psi.forward(many.truth)
    assert np.abs(many.readings - clean).max() < 8 * many.noise_sigma


def test_the_command_says_what_harms_a_method_and_goes_on_where_it_stopped(run, tmp_path):
    arguments = ("stability", "--worst", "--fast", "--method", "tv", "--size", "24x32")
    code, out, err = run(*arguments)
    assert code == 0, err
    assert "Worst" in out
    metrics = json.loads((tmp_path / "emmc-worst/metrics.json").read_text())
    worst = metrics["points"][0]
    assert worst["worst_db"] < worst["noise_db"] < worst["free_db"]
    assert len(metrics["points"]) == 1 + 3 * 2
    kept = (tmp_path / "emmc-worst/worst.jsonl").read_bytes()
    assert run(*arguments)[0] == 0
    assert (tmp_path / "emmc-worst/worst.jsonl").read_bytes() == kept


@pytest.fixture
def one_not_installed(monkeypatch):
    """Two methods, one of which is not installed."""
    missing = replace(METHODS["tv-dict"], package="no_such_module")
    for name in set(METHODS) - {"tv", "tv-dict"}:
        monkeypatch.delitem(METHODS, name)
    monkeypatch.setitem(METHODS, "tv-dict", missing)


def test_every_method_is_measured_but_one_not_installed_which_is_named_once(
    run, one_not_installed, tmp_path
):
    command = ("stability", "--worst", "--fast", "--method", "all", "--size", "24x32")
    code, out, err = run(*command, "--out", "out")
    assert code == 0, err
    reported = " ".join((out + err).split())
    assert reported.count("tv-dict needs no_such_module, which is not installed") == 1
    with open(tmp_path / "out" / "worst.csv", newline="") as rows:
        assert {row["method"] for row in csv.DictReader(rows)} == {"tv"}


def test_nothing_but_a_method_that_is_not_installed_is_one_line(run, one_not_installed):
    code, _, err = run("stability", "--worst", "--fast", "--method", "tv-dict", "--size", "24x32")
    assert code == 1
    assert "tv-dict needs no_such_module" in err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [(("--size", "16x16"), "needs 24x24"), (("--method", "tvv"), "tv"), (("--camera", "x"), "x")],
)
def test_wrong_input_is_one_line(run, tmp_path, arguments, says):
    code, _, err = run("stability", "--worst", "--fast", *arguments)
    assert code == 1
    assert says in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "emmc-worst").exists()

"""Sweeps until failure: breaking points, curves, and `emmc-rig stability` end to end."""

import csv
import json
from dataclasses import replace

import pytest
from pages import Page
from pools import Posting
from programs import done
from view_files import save_views

from emmc_rig.errors import StoppedError
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, reconstruct
from emmc_rig.simulators.scenes import render
from emmc_rig.store.results import METRICS
from emmc_rig.study import trial
from emmc_rig.study.stability.curves import (
    POOLED,
    below_best,
    below_view,
    breaking_rows,
    crossing,
    curves,
    place_words,
    strength_at,
)
from emmc_rig.study.stability.faults import FAULTS, Point
from emmc_rig.study.stability.stability_study import (
    BREAKS_CSV,
    POINTS_CSV,
    StabilityStudy,
    _head,
    answers,
    planned,
    stability_settings,
)
from emmc_rig.study.trial import Capture

SIZE = (24, 32)


def quick(**more):
    chosen = {"methods": ("tv",), "faults": ("flicker",), **more}
    return stability_settings(True, chosen.pop("scenes", ["dark"]), SIZE, **chosen)


def swept(out, **more):
    study = StabilityStudy(quick(**more), out)
    study.carry_out(Watcher())
    return study


@pytest.fixture
def few_steps(monkeypatch):
    """Total variation of a few steps: the same path, sooner done."""

    def solved(name, psi, frames, dictionary, settings):
        chosen = MethodSettings.model_validate({"tv": {"max_steps": 3}})
        return reconstruct(name, psi, frames, dictionary, chosen)

    monkeypatch.setattr(trial, "reconstruct", solved)


@pytest.fixture
def undrawn(monkeypatch):
    """No charts: they take longer than a few steps do."""
    monkeypatch.setattr(StabilityStudy, "write", lambda *_: None)


def test_a_curve_breaks_where_its_line_crosses_three_decibels_below_the_best():
    # From 29 to 26 the line crosses 27 after two thirds of the way.
    assert below_best([30, 29, 26, 10]) == pytest.approx(1 + 2 / 3)
    assert below_best([30, 29, 28]) is None
    assert below_best([10, 30, 10]) == pytest.approx(1.15)
    assert below_best([None, None]) == 0
    # A method that fails is broken from there on; nothing lies between one shot and two.
    assert below_best([30, 29, None]) == 2
    assert below_best([30, 20, 10], whole=True) == 1
    assert crossing([1, 1, -1], whole=True) == 2


def test_a_curve_breaks_where_it_crosses_the_copied_view():
    assert below_view([24, 20, 16], [18, 18, 18]) == pytest.approx(1.5)
    assert below_view([24, 20, 16], [26, 22, 18]) == 0
    assert below_view([20, 24, 20], [22, 20, 22]) == pytest.approx(5 / 3)
    # A flat scene is its centre view, which nothing exceeds.
    assert below_view([30, 30, 30], [None, 25, 20]) is None


@pytest.mark.parametrize(
    ("strengths", "place", "expected"),
    [((0, 2, 8), 0.5, 1), ((0, 2, 8), 1.5, 4), ((100, 1), 0.5, 10), ((0, 2, 8), 2.0, 8)],
)
def test_strengths_are_interpolated_in_ratios_but_from_zero(strengths, place, expected):
    assert strength_at(strengths, place) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("place", "words"),
    [(0, "already at the mildest"), (None, "never"), (2.5, "100"), (0.5, "0.32"), (1.0, "1")],
)
def test_breaking_points_in_words(place, words):
    assert place_words(place, (0.1, 1, 10, 1000)) == words


def found(levels):
    """Results at strengths 0, 1 and 4 by scene, fault and method, above a baseline of 5 dB."""
    return {
        Point(Capture(scene, "cam"), fault, strength, method): {"psnr_db": level, "view_db": 5}
        for (scene, fault, method), row in levels.items()
        for strength, level in zip((0, 1, 4), row, strict=True)
    }


def test_curves_of_several_scenes_are_pooled_where_all_have_the_fault():
    results: dict[Point, dict] = found(
        {("a", "mask-shift", "tv"): (30, 20, 10), ("b", "mask-shift", "tv"): (20, 18, 14)}
    )
    results[Point(Capture("a", "cam"), "occlusion", 0, "tv")] = {"psnr_db": 30, "view_db": 5}
    results[Point(Capture("a", "cam"), "occlusion", 10, "tv")] = {"failed": "no light"}
    every = curves(results)
    pooled = [curve for curve in every if curve.scene == POOLED]
    assert [curve.levels for curve in pooled] == [(25, 19, 12), (30, None)]
    rows, methods = breaking_rows(every, POOLED)
    assert methods == ("tv",)
    assert [fault.title for fault, _ in rows] == ["Mask shift", "Occlusion density"]
    assert rows[1][1] == ["10 / 10"]


def test_the_head_counts_what_breaks_and_compares_methods_on_the_same_faults():
    results = found(
        {
            ("a", "mask-shift", "tv"): (30, 29, 10),
            ("a", "flicker", "tv"): (30, 29, 29),
            ("a", "mask-shift", "dict-admm"): (30, 20, 10),
            ("a", "flicker", "dict-admm"): (30, 20, 10),
        }
    )
    head = _head(curves(results))
    assert head.level == "tv withstands faults best"
    assert "under 1 of 2 faults" in head.why
    assert any("for comparison, dict-admm: under 2 of 2" in line for line in head.next)
    # tv falls from 29 dB to 10 dB between 1 and 4 px, and never by flicker; dict-admm at 0.3.
    shift, flicker = answers(curves(results))
    assert shift == (
        "Mask shift: dict-admm has lost 3 dB at 0.3 px; tv has lost 3 dB at 1.2 px, the last."
    )
    assert flicker == (
        "Lamp flicker between shots: dict-admm has lost 3 dB at 0.3 %; tv nowhere in this sweep."
    )


def test_a_full_sweep_is_of_all_faults():
    points = planned(stability_settings(False, [], None))
    assert {point.fault for point in points} == set(FAULTS)
    assert {point.method for point in points} <= set(METHODS)


@pytest.mark.slow
def test_a_sweep_holds_every_point(few_steps, tmp_path):
    shed = tmp_path / "shed"
    save_views(shed, render("near-planar", size=(30, 36)).light_field)
    folder = tmp_path / "out"
    outcome = swept(folder, scenes=["dark", str(shed)], faults=("flicker", "disparity-range"))
    assert outcome.curves[0].scene == POOLED
    assert any("Disparity range" in line and "shed" in line for line in outcome.excluded())
    with open(folder / POINTS_CSV, newline="") as file:
        rows = list(csv.DictReader(file))
    with open(folder / BREAKS_CSV, newline="") as file:
        breaks = list(csv.DictReader(file))
    # Flicker in two scenes and both together; disparity in one.
    quick_counts = [len(FAULTS[name].quick) for name in ("flicker", "disparity-range")]
    assert len(rows) == 2 * quick_counts[0] + quick_counts[1]
    assert len(breaks) == len(outcome.curves) == 3 + 2
    text = (folder / "stability.html").read_text()
    page = Page(text)
    assert not page.foreign
    assert len(page.ids) == len(set(page.ids))
    # Both kinds of faults of all scenes and of the dark one, flicker in the shed.
    assert text.count("data:image/svg+xml") == 5
    metrics = json.loads((folder / METRICS).read_text())
    assert len(metrics["curves"]) == len(outcome.curves)
    for name in ("dark-scene", "all-scenes-between-shots"):
        assert (folder / "charts" / f"{name}.svg").stat().st_size > 5000


def test_the_clean_trial_is_measured_once_for_all_faults(few_steps, undrawn, tmp_path):
    swept(tmp_path / "out", faults=("flicker", "missing-shot"))
    lines = (tmp_path / "out" / StabilityStudy.journal).read_text().splitlines()
    assert len(lines) == len(FAULTS["flicker"].quick) + len(FAULTS["missing-shot"].quick) - 1


def test_a_method_that_is_not_installed_is_one_line(few_steps, undrawn, monkeypatch, tmp_path):
    missing = replace(METHODS["dict-admm"], package="no_such_module")
    monkeypatch.setitem(METHODS, "dict-admm", missing)
    outcome = swept(tmp_path / "out", methods=("tv", "dict-admm"))
    assert outcome.excluded() == ["dict-admm needs no_such_module, which is not installed"]
    assert {curve.method for curve in outcome.curves} == {"tv"}
    assert {point.method for point in planned(quick(methods=("all",)))} == set(METHODS)


def test_workers_measure_what_one_process_does_each_trial_once(few_steps, undrawn, tmp_path):
    chosen, ran = quick(faults=("flicker", "missing-shot")), []
    for name, pool in (("alone", None), ("shared", Posting(backwards=True))):
        (tmp_path / name).mkdir()
        sweep = StabilityStudy(chosen, tmp_path / name)
        ran.append(sweep.run(planned(chosen), Watcher(), pool))
        lines = (tmp_path / name / StabilityStudy.journal).read_text().splitlines()
        assert len(lines) == len(FAULTS["flicker"].quick) + len(FAULTS["missing-shot"].quick) - 1
    assert list(ran[0]) == list(ran[1])
    for point, figures in ran[0].items():
        assert ran[1][point]["psnr_db"] == pytest.approx(figures["psnr_db"], abs=1e-3)


def test_an_interrupted_sweep_goes_on(few_steps, undrawn, monkeypatch, tmp_path):
    calls, once = [], trial.reconstruct

    def stopping(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return once(*arguments)

    monkeypatch.setattr(trial, "reconstruct", stopping)
    with pytest.raises(StoppedError, match="1 of 4 points are kept"):
        swept(tmp_path / "out")
    swept(tmp_path / "out")
    assert len(calls) == 1 + 4
    kept = (tmp_path / "out" / StabilityStudy.journal).read_text()
    swept(tmp_path / "out")
    assert len(calls) == 1 + 4
    assert (tmp_path / "out" / StabilityStudy.journal).read_text() == kept


def test_a_method_that_fails_is_a_finding(undrawn, monkeypatch, tmp_path):
    def failing(name, psi, frames, *others):
        if frames.readings[2].mean() < 0.01:
            raise ReconstructionError("no light in shot 3")
        return reconstruct(name, psi, frames, *others)

    monkeypatch.setattr(trial, "reconstruct", failing)
    outcome = swept(tmp_path / "out", faults=("missing-shot",))
    (curve,) = outcome.curves
    assert curve.levels[1:] == (None, None)
    assert place_words(curve.below_best(), curve.strengths) == "1"
    assert any("no light in shot 3" in line for line in outcome.excluded())


def test_the_command_prints_the_table(few_steps, run):
    typed = ("--scene", "dark", "--fault", "flicker", "--method", "tv", "--size", "24x32")
    out = done(run("stability", "--fast", *typed))
    assert "Lamp flicker" in out
    assert "stability.html" in out


def test_the_command_lists_its_faults(run):
    out = done(run("stability", "--list"))
    for name in FAULTS:
        assert name in out

"""How verdicts are measured: what counts as broken, and runs that go on where they stopped."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from emmc_rig.cli import app
from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.study.stability import detector, verdict_constants
from emmc_rig.study.stability.detector import (
    ALL,
    case_results,
    case_words,
    cases,
    detector_settings,
    run_detector,
    tables,
    wrong,
)
from emmc_rig.study.stability.faults import Point
from emmc_rig.study.trial import Capture
from reconstruction.result import Reconstruction, Status
from reconstruction.verdict import pixels, rules
from reconstruction.verdict.evidence import Read, gathered

SMALL = (32, 40)
CAPTURE = Capture("dark", "rgbw-bayer-1shot")


class Silent:
    def begin(self, stage, steps):
        pass

    def step(self, detail):
        pass


@pytest.fixture(scope="module")
def evidence():
    """Evidence of an even scene that nothing is wrong with, as plain data."""
    psi = build_imaging_matrix(find_camera("rgbw-bayer-1shot"), SMALL)
    white = np.full(psi.light_field_shape, 0.5, np.float32)
    usable = np.ones(psi.frames_shape, dtype=bool)
    read = Read(psi.forward(white), usable, ~usable, np.zeros(psi.frames_shape))
    result = Reconstruction("tv", white, Status.CONVERGED, "", 1, (), 0.0, {})
    return gathered(psi, read, 1e-4, result).as_dict()


def row(psnr_db, evidence, **changed):
    return {"psnr_db": psnr_db, "even_db": 15.0, "evidence": {**evidence, **changed}}


def case(strength, method="tv", fault="mask-shift"):
    return Point(CAPTURE, fault if strength else None, strength, method)


def test_results_are_broken_between_good_or_poor_by_what_they_lost(evidence):
    rows = {
        case(0): row(30, evidence),
        case(0.05): row(29.5, evidence),
        case(0.1): row(28, evidence),
        case(0.5): row(26, evidence, displaced_px=0.5),
        case(1): row(20, evidence),
        # Three decibels below the other method without any fault: it had little to lose.
        case(0, "adaptive-fast"): row(27, evidence),
        case(0.5, "adaptive-fast"): row(26.5, evidence, displaced_px=0.5),
    }
    results = case_results(rows)
    kinds = [one.kind for one in results]
    assert kinds == ["good", "good", "between", "broken", "broken", "poor", "poor"]
    missed = wrong(results)
    assert [one.case for one in missed] == [case(1)]
    assert "lost 10.0 dB, trust (nothing against it)" in case_words(missed[0])
    tally = tables(results)["mask-shift", "tv"]
    assert (tally.broken, tally.broken_flagged, tally.good, tally.between) == (2, 1, 1, 1)
    assert tally.shares == (0.5, 0)
    everything = tables(results)[ALL, ALL]
    assert (everything.poor, everything.poor_flagged) == (2, 1)


def test_a_result_near_one_even_colour_is_poor_from_the_start(evidence):
    rows = {case(0): row(19, evidence), case(0.5): row(18.5, evidence)}
    assert {one.kind for one in case_results(rows)} == {"poor"}


def test_every_case_has_its_harmless_end_and_none_is_done_twice():
    settings = detector_settings(True, ["dark"], None, [], ["tv"], SMALL, 1)
    wanted = cases(settings)
    assert len(set(wanted)) == len(wanted)
    assert all(detector.harmless(one) in wanted for one in wanted)
    faults = {one.fault for one in wanted}
    assert {"exposure", "mask-shift", "flicker"} <= faults
    # A hard scene, or another design, is no fault of a capture.
    assert not faults & {"disparity-range", "mask-cell", "views"}
    one_shot = {one.fault for one in wanted if one.capture.camera == "rgbw-bayer-1shot"}
    assert "flicker" not in one_shot


def test_misspelt_faults_are_reported():
    with pytest.raises(AppError, match="did you mean 'mask-shift'"):
        detector_settings(True, [], None, ["mask-shft"], [], None, 0)


def test_the_command_judges_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    arguments = [
        *["stability", "--verdicts", "--fast", "--scene", "dark", "--method", "tv", "--seed", "1"],
        *["--camera", "rgbw-bayer-1shot", "--fault", "mask-shift", "--size", "32x40"],
        *["--out", str(tmp_path / "out")],
    ]
    reported = CliRunner().invoke(app, arguments)
    assert reported.exit_code == 0, reported.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["results"] == 4
    assert metrics["tallies"]["all, all"]["broken_flagged"] >= 1
    lines = (tmp_path / "out" / "verdicts.csv").read_text().splitlines()
    assert len(lines) == 5
    monkeypatch.setattr(detector, "judged_row", lambda *_: pytest.fail("measured again"))
    settings = detector_settings(
        True, ["dark"], "rgbw-bayer-1shot", ["mask-shift"], ["tv"], SMALL, 1
    )
    assert len(run_detector(settings, tmp_path / "out", Silent())) == 4


def test_constants_of_rules_judge_kept_evidence_and_others_measure_it_anew(
    tmp_path, monkeypatch, evidence
):
    some = [
        one
        for one in verdict_constants.constants()
        if one.label in ("rules.DISPLACED_PX", "pixels.DIMMEST", "kept.SEED")
    ]
    monkeypatch.setattr(verdict_constants, "constants", lambda: tuple(some))
    dimmest, limit = pixels.DIMMEST, rules.DISPLACED_PX
    assert limit.doubt > 0.2 > limit.doubt / 2

    def judged_row(method, given):
        moved = 0.2 if given.fault else 0.0
        return row(25.0 if moved else 30.0, evidence, displaced_px=moved * pixels.DIMMEST / dimmest)

    def described_only(point):
        return point

    monkeypatch.setattr(detector, "judged_row", judged_row)
    monkeypatch.setattr(verdict_constants, "judged_row", judged_row)
    monkeypatch.setattr(Point, "trial", described_only)
    monkeypatch.setattr(verdict_constants, "_trial", described_only)
    settings = detector_settings(
        True, ["dark"], "rgbw-bayer-1shot", ["mask-shift"], ["tv"], SMALL, 1
    )
    costs, left_out = verdict_constants.run_verdict_constants(settings, tmp_path / "out", Silent())
    broken = len(cases(settings)) - 1
    found = {(one.constant, one.factor): (one.broken_flagged, one.changed) for one in costs}
    assert found["rules.DISPLACED_PX", 2.0] == (0, 0)
    assert found["rules.DISPLACED_PX", 0.5] == (broken, broken)
    assert found["pixels.DIMMEST", 2.0] == (broken, broken)
    assert found["pixels.DIMMEST", 0.5] == (0, 0)
    assert left_out == ["kept.SEED stays 1"]
    assert (dimmest, limit) == (pixels.DIMMEST, rules.DISPLACED_PX)
    lines = (tmp_path / "out" / verdict_constants.CSV).read_text().splitlines()
    assert lines[1].startswith("rules.DISPLACED_PX") or lines[1].startswith("pixels.DIMMEST")
    monkeypatch.setattr(verdict_constants, "judged_row", None)
    again, _ = verdict_constants.run_verdict_constants(settings, tmp_path / "out", Silent())
    assert again == costs

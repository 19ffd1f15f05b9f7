"""`emmc-rig chart --stated`: what is stated of a reconstruction, beside the truth."""

import json

import pytest

from emmc_rig.advice.trial import CANDIDATES, Prospect
from emmc_rig.files.results import METRICS
from emmc_rig.study import guard
from emmc_rig.study.stated import Stated, summary
from emmc_rig.study.trial import Capture

CASE = Capture("near-planar", guard.CAMERA, (48, 64), noise=0.004)


def row(expected_db, half_db, true_db, within=(None, None)):
    prospect = Prospect("tv", 1.0, expected_db, expected_db - half_db, expected_db + half_db)
    return Stated(CASE, prospect, true_db, *within)


def test_the_summary_counts_what_held():
    rows = [
        row(30, 3, 32.5, (0.6, 0.9)),
        row(30, 3, 26.0, (0.7, 0.96)),
        row(25, 0.5, 25.8),
        row(25, 0.5, 23.0),
    ]
    assert [one.inside for one in rows] == [True, False, False, False]
    assert rows[3].off_db == pytest.approx(-2)
    lines = summary(rows)
    assert lines[0] == "1 of 4 true PSNRs lie in their interval"
    assert lines[1].startswith("2 were said within 1 dB, and 1 of them are")
    assert lines[2] == "within one deviation: 65% of the errors on average, 60% to 70% (68 % meant)"
    assert lines[3].startswith("within two deviations: 93%")


def test_every_method_of_the_trial_is_compared_with_the_truth(run, monkeypatch, tmp_path):
    monkeypatch.setattr(guard, "NOISES", (0.004,))
    code, out, _ = run(
        "chart", "--stated", "--scene", "near-planar", "--size", "48x64", "--out", "out"
    )
    assert code == 0
    assert "lie in their interval" in out
    metrics = json.loads((tmp_path / "out" / METRICS).read_text())
    assert [one["method"] for one in metrics["rows"]] == list(CANDIDATES)
    for one in metrics["rows"]:
        assert one["low_db"] <= one["psnr_db"] <= one["high_db"]
        assert 10 < one["true_db"] < 40
        assert (one["within_one"] is None) == (one["method"] == "tv")
    assert 0.3 < metrics["rows"][-1]["within_one"] < metrics["rows"][-1]["within_two"]

"""`emmc-rig chart --guard`: figures that fall fail, on a tiny built-in scene."""

import json

import pytest

from emmc_rig.study import guard

SMALL = ("chart", "--guard", "--scene", "near-planar", "--size", "32x40", "--out", "out")


@pytest.fixture
def one_noise(monkeypatch):
    monkeypatch.setattr(guard, "NOISES", (0.004,))


def test_a_figure_that_fell_fails_and_is_named(run, one_noise, monkeypatch, tmp_path):
    key = guard.key(guard.cases(["near-planar"], (32, 40))[0])
    monkeypatch.setattr(guard, "stored_figures", lambda: {key: 99.0})
    code, out, err = run(*SMALL)
    assert code == 1
    assert key in err
    assert "fell" in out
    measured = json.loads((tmp_path / "out" / "guard.json").read_text())[key]
    assert 15 < measured < 60
    monkeypatch.setattr(guard, "stored_figures", lambda: {key: measured + 0.9 * 0.3})
    code, out, err = run(*SMALL)
    assert code == 0


def test_without_a_stored_figure_nothing_fails_and_the_row_says_so(run, one_noise, monkeypatch):
    monkeypatch.setattr(guard, "stored_figures", dict)
    code, out, _ = run(*SMALL)
    assert code == 0
    assert "none stored" in out


def test_every_built_in_case_has_a_stored_figure(monkeypatch):
    monkeypatch.delenv("EMMC_LIGHTFIELDS", raising=False)
    stored = guard.stored_figures()
    assert {guard.key(case) for case in guard.cases()} <= set(stored)


def test_real_light_fields_are_measured_where_they_are(monkeypatch, tmp_path):
    (tmp_path / "fish").mkdir()
    monkeypatch.setenv("EMMC_LIGHTFIELDS", str(tmp_path))
    assert {case.scene for case in guard.cases()} == {*guard.BUILT_IN, str(tmp_path / "fish")}

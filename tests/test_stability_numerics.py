"""Numerical stability: the float64 reference, bit-identity of every method, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from emmc_rig.study.stability import numerics
from emmc_rig.study.stability import rounding as rounding_checks
from emmc_rig.study.stability.numerics import identical, measure_numerics, numerics_section
from emmc_rig.study.stability.rounding import (
    BROKEN,
    SOUND,
    WEAK,
    Attempt,
    Finding,
    Reference,
    attempted,
    example,
    relative,
    rounding,
    step_sizes,
)
from reconstruction.bpdn import BPDNSettings
from reconstruction.methods import MethodSettings
from reconstruction.problem import colour_metric
from reconstruction.sparse import SparseSettings


class Silent:
    def begin(self, stage, steps):
        pass

    def step(self, detail):
        pass


@pytest.fixture(scope="module")
def capture():
    return example()


@pytest.mark.parametrize(("cfa", "binning", "shots"), [("rggb", 1, 2), ("mono", 2, 1)])
def test_the_reference_is_dense_algebra(coded_psi, cfa, binning, shots):
    psi = coded_psi(cfa, binning, shots)
    metric = colour_metric(2.0)
    plain = Reference(psi, metric)
    dense = psi.to_scipy().toarray().astype(np.float64)
    rng = np.random.default_rng(0)
    light_field, frames = rng.random(psi.light_field_shape), rng.random(psi.frames_shape)
    gamma = 0.7
    system = np.eye(dense.shape[1]) + gamma * dense.T @ dense
    expected = np.linalg.solve(system, light_field.ravel() + gamma * dense.T @ frames.ravel())
    got = plain.data_step(light_field, frames, gamma)
    np.testing.assert_allclose(got.ravel(), expected, atol=1e-10)
    square = 0.0
    for axis in range(4):
        shape = [1 if i == axis else n for i, n in enumerate(psi.light_field_shape)]
        step = np.concatenate([np.diff(light_field, axis=axis), np.zeros(shape)], axis=axis)
        square = square + np.square(step @ metric.T).sum(axis=-1)
    assert plain.variation(light_field) == pytest.approx(float(np.sqrt(square).sum()))


def test_kernels_round_as_float32_must(capture):
    findings = rounding([capture, example("rgbw-mono"), example(shots=3, binning=2)])
    assert len(findings) == 5
    assert [one.name for one in findings if one.verdict != SOUND] == []


def test_a_kernel_that_is_wrong_is_found(capture, monkeypatch):
    def forgetful(weights, colour, light_field, binning, frames):
        frames[:] = 0.999 * np.float32(1)

    monkeypatch.setattr("emmc_rig.model.kernels.project", forgetful)
    verdicts = {one.name: one.verdict for one in rounding([capture])}
    assert verdicts["float32 against float64: Psi"] == BROKEN
    assert verdicts["float32 against float64: Psi^T"] == SOUND


@pytest.mark.parametrize("method", numerics.ANY_VIEWS)
def test_a_method_run_twice_gives_the_same_bits(capture, method):
    # Few steps are enough: what differs from run to run differs from the first.
    few = MethodSettings(sparse=SparseSettings(solver=BPDNSettings(max_steps=60)))
    assert identical(capture.solved(method, few), capture.solved(method, few))


def test_results_that_differ_in_a_bit_are_not_identical(capture):
    first = capture.solved("tv")
    other = first.light_field.copy()
    other[0, 0, 0, 0, 0] = np.nextafter(other[0, 0, 0, 0, 0], np.float32(2))
    assert not identical(first, replace(first, light_field=other))


@pytest.mark.parametrize("method", ["tv", "dict-omp"])
@pytest.mark.parametrize("factor", [1e-6, 1e-2])
def test_a_dimmer_scene_gives_the_same_light_field_but_dimmer(capture, method, factor):
    usual = attempted(capture, method).db
    dim = attempted(numerics.scaled(capture, factor), method, factor)
    assert dim.db == pytest.approx(usual, abs=0.1)


def test_how_dim_a_scene_is_does_not_matter_to_the_adaptive_method(capture):
    usual = attempted(capture, "adaptive-fast").db
    dim, dimmer = (
        attempted(numerics.scaled(capture, factor), "adaptive-fast", factor).db
        for factor in (1e-2, 1e-6)
    )
    assert dimmer == pytest.approx(dim, abs=0.05)
    # Where total variation is taken, held-out readings decide: rounding may tip a region.
    assert dim > usual - 0.3


def test_how_dark_a_mask_is_does_not_matter_to_the_adaptive_method(capture):
    usual = attempted(capture, "adaptive-fast").db
    for factor in (1e-2, 1e-6):
        dark = attempted(numerics.dimmed(capture, factor), "adaptive-fast").db
        assert dark == pytest.approx(usual, abs=0.3)


def test_a_deviation_is_as_dim_as_its_scene():
    twice = example(shots=2)
    dim, dimmer = (
        numerics.scaled(twice, factor).solved("adaptive-fast").maps["sigma"] / factor
        for factor in (1e-2, 1e-4)
    )
    np.testing.assert_allclose(dimmer, dim, rtol=0.05)


@pytest.mark.parametrize("method", ["tv", "dict-omp", "adaptive-fast"])
def test_readings_brighter_than_white_are_refused_in_one_line(capture, method):
    found = attempted(numerics.scaled(capture, 1e6), method, 1e6)
    assert "normalise" in found.refused
    assert "\n" not in found.refused


@pytest.mark.parametrize("condition", numerics.CONDITIONS, ids=lambda one: one.name)
def test_no_condition_of_psi_breaks_total_variation(capture, condition):
    trial = condition.change(capture if condition.shots == 1 else example(shots=condition.shots))
    found = attempted(trial, "tv")
    if condition.same:
        # Not the same to the last: mu was fitted at masks that pass half the light.
        assert found.db > attempted(capture, "tv").db - 2
    else:
        assert found.db > numerics.card_db(capture)


def test_absurd_steps_stay_finite_and_are_reported(capture):
    findings = step_sizes(capture)
    assert len(findings) == len(rounding_checks.STEP_FACTORS) + 2
    assert {one.verdict for one in findings} == {SOUND}
    assert any("step limit reached" in one.figure for one in findings)


def test_the_worst_method_is_named():
    outcomes = {"tv": Attempt(20.0), "adaptive": Attempt(17.5), "dict-omp": Attempt(np.nan, "no")}
    wanted = dict.fromkeys(outcomes, 20.0)
    figure, verdict = numerics.condition_verdict(outcomes, wanted, True)
    assert figure == "refused: dict-omp; at most 2.5 dB apart (adaptive)"
    assert verdict == WEAK
    outcomes["tv"] = Attempt(np.nan)
    figure, verdict = numerics.condition_verdict(outcomes, wanted, True)
    assert figure.startswith("not finite: tv")
    assert verdict == BROKEN
    assert relative(np.ones(3, np.float32), np.ones(3)) == 0


def test_the_section_shows_every_check_and_method(tmp_path, monkeypatch):
    monkeypatch.setattr(numerics, "CONDITIONS", numerics.CONDITIONS[:1])
    found = measure_numerics(Silent(), True, ("tv", "adaptive-fast"))
    section = numerics_section(found, tmp_path)
    assert all(isinstance(one, Finding) and one.figure for one in found.findings)
    for one in found.findings:
        assert one.name.replace(" & ", " &amp; ").split(",")[0] in section.body
    assert "adaptive-fast" in section.body
    assert (tmp_path / "numerics.svg").is_file()
    assert (tmp_path / "numerics.png").is_file()

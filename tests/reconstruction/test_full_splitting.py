"""The paper's eq. 10-13 against the exact data step: one minimiser; and its step sizes."""

import numba
import numpy as np
import pytest
from full_splitting import (
    FullSplittingSettings,
    from_patches,
    into_ball,
    reconstruct_full_splitting,
    step_sizes,
)

from emmc_rig.model.settings import validated
from reconstruction.errors import ReconstructionError
from reconstruction.tv import TVSettings, reconstruct_tv


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Small arrays: waking threads would take longer than the work."""
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


def capture(psi, flat_from):
    """Return a light field that is random but for a flat end, its frames, and usable pixels."""
    rng = np.random.default_rng(0)
    truth = 0.2 + 0.5 * rng.random(psi.light_field_shape)
    truth[:, :, :, flat_from:] = [0.7, 0.3, 0.5]
    frames = psi.forward(truth)
    return truth, frames, rng.random(frames.shape) < 0.9


CASES = [
    (1, "rggb", 1, 8, (1, 2), False, 4e-3, 0.7, 3.0),
    (1, "mono", 2, 2, (2, 2), True, 4e-3, 1.0, 10.0),
    (1, "mono", 1, 1, (2, 2), True, 4e-3, 1.0, 10.0),
    (2, "mono", 1, 8, (1, 2), False, 1e-2, 1.0, 0.7),
    (2, "rggb", 2, 2, (2, 2), True, 2e-3, 1.0, 3.0),
    (3, "mono", 1, 8, (1, 2), False, 3e-3, 1.0, 1.4),
    (3, "rggb", 1, 1, (1, 3), True, 1e-3, 1.0, 3.0),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "cfa", "binning", "shots", "views", "patched", "mu", "gamma", "primal_step"), CASES
)
def test_the_exact_data_step_reaches_the_minimiser_of_the_papers_algorithm(
    coded_psi, order, cfa, binning, shots, views, patched, mu, gamma, primal_step
):
    """In double precision, with pixels left out; the objectives agree to 1e-6."""
    psi = coded_psi(cfa, binning, shots, (4, 6), views, np.float64)
    truth, frames, usable = capture(psi, 4)
    term = None
    if patched:
        patches = [truth[:, :, :4, :4], truth[:, :, :2, :4]]
        term = from_patches([(0, 0), (2, 2)], patches, [1, 0.5], truth.shape)
    common = {"order": order, "mu": mu, "rho": 0.1, "chroma_weight": 1.0}
    slow = FullSplittingSettings(**common, gamma=gamma, rtol=1e-9, max_steps=5000)
    fast = TVSettings(**common, primal_step=primal_step, rtol=1e-9, max_steps=3000)
    paper = reconstruct_full_splitting(psi, frames, 0.0, slow, usable, patch_term=term)
    ours = reconstruct_tv(psi, frames, 0.0, fast, usable, patch_term=term)
    assert ours.objective[-1][1] == pytest.approx(paper.objective[-1][1], rel=1e-6)
    np.testing.assert_allclose(ours.light_field, paper.light_field, atol=1e-3)
    assert ours.light_field.std() > 0.08


@pytest.mark.parametrize("chroma_weight", [0.5, 2.0])
def test_chrominance_is_weighted_alike(coded_psi, chroma_weight):
    psi = coded_psi("mono", 1, 8, (4, 6), (1, 2), np.float64)
    _, frames, usable = capture(psi, 4)
    common = {"mu": 4e-3, "chroma_weight": chroma_weight, "rtol": 1e-11, "max_steps": 3000}
    paper = reconstruct_full_splitting(
        psi, frames, 0.0, FullSplittingSettings(gamma=1.0, **common), usable
    )
    ours = reconstruct_tv(psi, frames, 0.0, TVSettings(primal_step=3.0, **common), usable)
    assert ours.objective[-1][1] == pytest.approx(paper.objective[-1][1], rel=1e-6)


def test_the_start_does_not_change_the_minimiser_and_a_good_one_saves_steps(coded_psi):
    psi = coded_psi("mono", 1, 2, (4, 6), (2, 2), np.float64)
    truth, frames, _ = capture(psi, 4)
    term = from_patches([(0, 0)], [truth], None, truth.shape)
    settings = TVSettings(mu=1e-3, rho=0.1, rtol=1e-9, max_steps=4000, primal_step=30.0)
    plain = reconstruct_tv(psi, frames, 0.0, settings, patch_term=term)
    reference = FullSplittingSettings(mu=1e-3, rho=0.1, chroma_weight=2.0, rtol=1e-9)
    starts = plain.light_field, np.ones_like(plain.light_field)
    ours = [
        reconstruct_tv(psi, frames, 0.0, settings, patch_term=term, start=start) for start in starts
    ]
    papers = [
        reconstruct_full_splitting(psi, frames, 0.0, reference, patch_term=term, start=start)
        for start in starts
    ]
    for near, far in (ours, papers):
        assert near.steps < far.steps
        for found in (near, far):
            np.testing.assert_allclose(found.light_field, plain.light_field, atol=1e-4)


def test_a_large_rho_gives_the_patches_and_none_ignores_them(coded_psi):
    psi = coded_psi("rggb", 1, 1, (4, 6), (2, 2))
    truth, frames, _ = capture(psi, 4)
    frames = frames.astype(np.float32)
    term = from_patches([(0, 0)], [truth], None, truth.shape)
    near = reconstruct_tv(psi, frames, 0.01, TVSettings(rho=1e4), patch_term=term)
    np.testing.assert_allclose(near.light_field, truth, atol=1e-3)
    ignored = reconstruct_tv(psi, frames, 0.01, TVSettings(rho=0), patch_term=term)
    alone = reconstruct_tv(psi, frames, 0.01)
    np.testing.assert_array_equal(ignored.light_field, alone.light_field)
    assert (near.method, ignored.method) == ("tv-patch", "tv")


def test_a_light_field_that_explains_everything_stays(coded_psi):
    """A constant light field, its frames and itself as patches: nothing pulls at it."""
    for order in (1, 2, 3):
        psi = coded_psi("rggb", 2, 2, (6, 8), (2, 3))
        grey = np.full(psi.light_field_shape, 0.4, np.float32)
        term = from_patches([(0, 0)], [grey], None, grey.shape)
        settings = TVSettings(order=order, mu=1e-3, max_steps=20)
        found = reconstruct_tv(psi, psi.forward(grey), 0.01, settings, patch_term=term)
        np.testing.assert_allclose(found.light_field, 0.4, atol=1e-5)
        assert found.method == ("tv-patch", "dv2-patch", "dv3-patch")[order - 1]


SMOOTH, DIFFERENCES = 0.25, 15.0


def test_the_step_sizes_left_open_meet_the_condition():
    for gamma, tau in ((None, None), (2.0, None), (None, 0.3), (None, 1e-6)):
        sizes = step_sizes(SMOOTH, DIFFERENCES, gamma, tau, wanted=0.7)
        assert 0.9 < sizes.gamma * (SMOOTH + sizes.tau * DIFFERENCES) < 1
        assert gamma in (None, sizes.gamma)
        assert tau in (None, sizes.tau)


def test_step_sizes_that_violate_the_condition_are_refused_with_the_largest_allowed():
    with pytest.raises(
        ReconstructionError, match=r"gamma must be below 1, .* tau below 0\.0166667"
    ):
        step_sizes(SMOOTH, DIFFERENCES, 2.0, 0.05, wanted=1.0)
    with pytest.raises(ReconstructionError, match=r"too large for any tau: .* below 4"):
        step_sizes(SMOOTH, DIFFERENCES, 4.0, None, wanted=1.0)
    for gamma, tau in ((0.999, 0.05), (2.0, 0.01666)):
        assert step_sizes(SMOOTH, DIFFERENCES, gamma, tau, wanted=1.0).tau == tau


@pytest.mark.parametrize("patched", [False, True])
def test_the_condition_counts_frames_differences_and_patches(coded_psi, patched):
    """The largest gamma named is the paper's bound, of Psi, the patches and the differences."""
    psi = coded_psi("mono", 1, 2, (4, 6), (1, 2), np.float64)
    truth, frames, _ = capture(psi, 4)
    term = from_patches([(0, 0)], [truth], [3.0], truth.shape) if patched else None
    bad = FullSplittingSettings(mu=1e-2, rho=0.5, gamma=50.0, tau=0.1)
    dense = psi.to_scipy().toarray()
    differences = sum(2 - 2 * np.cos(np.pi * (n - 1) / n) for n in (2, 4, 6))
    smooth = np.linalg.norm(dense, 2) ** 2 / 2 + (0.5 * 3 / 2 if patched else 0)
    bound = 1 / (smooth + 0.1 * differences)
    wanted = f"below {bound:.6g}," if 50 * smooth < 1 else f"below {1 / smooth:.6g}"
    with pytest.raises(ReconstructionError, match=wanted):
        reconstruct_full_splitting(psi, frames, 0.0, bad, patch_term=term)


def test_the_prox_of_the_conjugate_follows_from_moreaus_identity():
    """prox of tau f* at K is K - tau prox of f / tau at K / tau; f = mu |.|_1,2 shrinks."""
    dual = np.random.default_rng(1).standard_normal((4, 2, 2, 3, 3, 3))
    mu, tau = 0.7, 0.3
    scaled = dual / tau
    length = np.sqrt(np.square(scaled).sum(axis=(0, -1)))[None, ..., None]
    shrunk = scaled * np.maximum(1 - mu / tau / length, 0)
    np.testing.assert_allclose(into_ball(dual, mu), dual - tau * shrunk, atol=1e-12)
    assert not into_ball(dual, 0.0).any()


def test_frames_and_settings_that_make_no_sense_are_refused(coded_psi):
    psi = coded_psi()
    frames = np.full(psi.frames_shape, 0.3, np.float32)
    with pytest.raises(ReconstructionError, match="frames of shape"):
        reconstruct_full_splitting(psi, frames[:, 1:], 0.0)
    with pytest.raises(ReconstructionError, match="not finite: exclude them"):
        reconstruct_full_splitting(psi, frames * np.nan, 0.0)
    for settings, key, value in (
        (TVSettings, "mu", -1),
        (TVSettings, "rho", -0.1),
        (TVSettings, "order", 0),
        (FullSplittingSettings, "mu", -1),
        (FullSplittingSettings, "rho", -1),
        (FullSplittingSettings, "tau", 0),
    ):
        with pytest.raises(ReconstructionError, match=f"solver: {key}: .*greater than") as fault:
            validated(settings, {key: value}, "solver", ReconstructionError)
        assert "\n" not in str(fault.value)


@pytest.mark.slow
def test_not_converging_is_a_status_with_advice(coded_psi):
    psi = coded_psi()
    frames = np.full(psi.frames_shape, 0.3, np.float32)
    seen = []
    result = reconstruct_full_splitting(
        psi,
        frames,
        0.01,
        FullSplittingSettings(max_steps=3, objective_every=2),
        on_step=seen.append,
    )
    assert (result.status, result.steps) == ("step limit reached", 3)
    assert result.advice
    assert [progress.step for progress in seen] == [1, 2, 3]
    assert [step for step, _ in result.objective] == [2]

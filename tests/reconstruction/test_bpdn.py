"""Sparse codes: ADMM finds the minimiser that slow, independent code finds."""

import numpy as np
import pytest

from emmc_rig.reconstruction import bpdn
from emmc_rig.reconstruction.bpdn import BPDNSettings, SensedDictionary, ridge_inverse
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.patches import padded

SIZES = [(60, 20), (33, 16), (300, 45), (12, 30)]


def problem(count, length, sparsity=4, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    atoms = rng.normal(size=(count, length)) * rng.uniform(0.3, 2, (count, 1))
    code = np.zeros(count)
    code[rng.choice(count, sparsity, replace=False)] = rng.normal(size=sparsity) + 2
    return atoms, code @ atoms + noise * rng.normal(size=length), code


def solve_bpdn(atoms, data, noise_sigma=0.0, settings=None):
    """The sparse code of one patch's measurements."""
    wide = np.zeros((len(atoms), padded(data.size)), np.float32)
    wide[:, : data.size] = atoms
    row = np.zeros((1, wide.shape[1]), np.float32)
    row[0, : data.size] = data
    sensed = SensedDictionary(wide, row, noise_sigma, settings or BPDNSettings())
    return sensed.code(row[0])


def objective(atoms, data, eta, code):
    code = np.asarray(code, dtype=np.float64)
    return 0.5 * np.sum((data - code @ atoms) ** 2) + eta * np.abs(code).sum()


def coordinate_descent(atoms, data, eta, sweeps=5000):
    """The minimiser of eq. 8, one coefficient at a time in float64."""
    code = np.zeros(len(atoms))
    residual = data.copy()
    power = (atoms**2).sum(axis=1)
    for _ in range(sweeps):
        largest = 0.0
        for j, atom in enumerate(atoms):
            old = code[j]
            pull = atom @ residual + power[j] * old
            code[j] = np.sign(pull) * max(abs(pull) - eta, 0) / power[j]
            residual -= (code[j] - old) * atom
            largest = max(largest, abs(code[j] - old))
        if largest < 1e-13:
            break
    return code


@pytest.mark.parametrize(("count", "length"), SIZES)
@pytest.mark.parametrize("share", [0.02, 0.3])
def test_the_objective_is_the_least_to_a_millionth(count, length, share):
    atoms, data, _ = problem(count, length, noise=0.1)
    eta = share * np.abs(atoms @ data).max()
    least = objective(atoms, data, eta, coordinate_descent(atoms, data, eta))
    settings = BPDNSettings(penalty=eta, rtol=1e-7, max_steps=3000)
    code = solve_bpdn(atoms, data, settings=settings)
    assert objective(atoms, data, eta, code.weights) <= least * (1 + 1e-6)


def test_the_gap_bounds_the_distance_from_the_least_objective():
    atoms, data, _ = problem(300, 45, noise=0.1)
    eta = 0.05 * np.abs(atoms @ data).max()
    least = objective(atoms, data, eta, coordinate_descent(atoms, data, eta))
    for rtol in (0.3, 0.03, 0.003):
        code = solve_bpdn(atoms, data, settings=BPDNSettings(penalty=eta, rtol=rtol))
        value = objective(atoms, data, eta, code.weights)
        assert code.gap <= rtol
        assert value - least <= (code.gap + 1e-6) * value


def test_equal_atoms_and_dark_atoms_do_no_harm():
    atoms, data, _ = problem(60, 20, noise=0.1)
    atoms[10] = atoms[3]
    atoms[20] = 0
    eta = 0.05 * np.abs(atoms @ data).max()
    lit = np.delete(atoms, 20, axis=0)
    least = objective(lit, data, eta, coordinate_descent(lit, data, eta))
    settings = BPDNSettings(penalty=eta, rtol=1e-5, max_steps=50_000)
    weights = solve_bpdn(atoms, data, settings=settings).weights
    assert weights[20] == 0
    assert objective(atoms, data, eta, weights) <= least * (1 + 1e-4)


def test_a_planted_sparse_code_is_found():
    atoms, data, planted = problem(300, 80, sparsity=5)
    settings = BPDNSettings(penalty=1e-4 * np.abs(atoms @ data).max())
    found = solve_bpdn(atoms, data, settings=settings).weights
    np.testing.assert_allclose(found, planted, atol=0.02)


def test_the_penalty_follows_the_noise_and_the_size_of_the_sensed_atoms():
    atoms, data, _ = problem(300, 45)
    small, large = (solve_bpdn(atoms, data, sigma).penalty for sigma in (0.5, 1.0))
    assert large == pytest.approx(2 * small)
    size = np.median(np.linalg.norm(atoms, axis=1))
    expected = 0.2 * 0.5 * size * np.sqrt(2 * np.log(300))
    assert small == pytest.approx(expected, rel=1e-5)
    scaled = solve_bpdn(3 * atoms, 3 * data, 0.5).penalty
    assert scaled == pytest.approx(3 * small)


def test_without_noise_the_penalty_is_a_small_share_of_the_largest_useful_one():
    atoms, data, _ = problem(300, 45)
    largest = np.abs(atoms @ data).max()
    bound = np.median(np.linalg.norm(atoms, axis=1)) * np.linalg.norm(data)
    assert solve_bpdn(atoms, data).penalty == pytest.approx(5e-4 * bound, rel=1e-5)
    zero = solve_bpdn(atoms, data, settings=BPDNSettings(penalty=1.01 * largest, rtol=1e-6))
    assert not zero.weights.any()


def test_a_step_limit_is_a_status():
    atoms, data, _ = problem(300, 45, noise=0.3)
    settings = BPDNSettings(penalty=1e-3, max_steps=2)
    code = solve_bpdn(atoms, data, settings=settings)
    assert not code.converged
    assert np.isfinite(code.weights).all()


def test_no_data_gives_no_atoms():
    atoms, _, _ = problem(60, 20)
    code = solve_bpdn(atoms, np.zeros(20))
    assert not code.weights.any()
    assert code.converged


@pytest.mark.parametrize("count", [50, 13])
def test_the_inverse_is_that_of_the_gram_matrix_with_its_ridge(count):
    atoms = problem(count, 20)[0].astype(np.float32)
    expected = np.linalg.inv(atoms.T.astype(float) @ atoms + 0.7 * np.eye(20))
    np.testing.assert_allclose(ridge_inverse(atoms, 0.7), expected, atol=1e-5)
    with pytest.raises(ReconstructionError, match="raise the penalty"):
        ridge_inverse(np.zeros((5, 20), np.float32), 0.0)


def plain_admm(atoms, data, eta, rho, steps):
    """The paper's ADMM [59] in float64: scaled form, one factor, no relaxation."""
    inverse = np.linalg.inv(atoms.T @ atoms + rho * np.eye(data.size))
    z = u = np.zeros(len(atoms))
    for _ in range(steps):
        q = z - u
        x = q + atoms @ (inverse @ (data - q @ atoms))
        z = np.sign(x + u) * np.maximum(np.abs(x + u) - eta / rho, 0)
        u = u + x - z
    return z


def test_the_default_settings_reach_the_objective_of_ten_thousand_plain_steps_to_a_thousandth():
    atoms, data, _ = problem(300, 45, sparsity=12, noise=0.2)
    for share in (0.002, 0.05):
        eta = share * np.abs(atoms @ data).max()
        reached = objective(atoms, data, eta, plain_admm(atoms, data, eta, 0.3 * eta, 10_000))
        code = solve_bpdn(atoms, data, settings=BPDNSettings(penalty=eta))
        assert objective(atoms, data, eta, code.weights) <= reached * (1 + 1e-3)
        assert code.steps < 200


@pytest.mark.parametrize("together", [1, 30, 3000])
def test_patches_together_have_the_codes_of_each_alone(monkeypatch, together):
    """Whether all steps, some or hardly any are made together; readings that are lost differ."""
    monkeypatch.setattr(bpdn, "STEPS_TOGETHER", together)
    rng = np.random.default_rng(3)
    atoms = np.zeros((60, padded(20)), np.float32)
    atoms[:, :20] = rng.normal(size=(60, 20)) * rng.uniform(0.3, 2, (60, 1))
    usable = rng.uniform(size=(bpdn.FEWEST_TOGETHER + 3, 20)) > 0.15
    usable[0] = False
    usable[1] = True
    data = np.zeros((len(usable), atoms.shape[1]), np.float32)
    data[:, :20] = rng.normal(size=usable.shape) * usable
    settings = BPDNSettings(rtol=1e-5, max_steps=20000)
    found = bpdn.codes(atoms, data, usable, 0.05, settings)
    assert not found[0].weights.any()
    assert len({seen.tobytes() for seen in usable}) > bpdn.FEWEST_TOGETHER
    for code, row, seen in zip(found[1:], data[1:], usable[1:], strict=True):
        shown = atoms[:, :20].astype(float) * seen
        alone = SensedDictionary(
            np.pad(shown, ((0, 0), (0, atoms.shape[1] - 20))).astype(np.float32),
            row[None],
            0.05,
            settings,
        )
        assert code.converged
        assert together < 3000 or code.steps <= together
        assert code.penalty == pytest.approx(alone.penalty(row), rel=1e-5)
        least = objective(
            shown,
            row[:20],
            code.penalty,
            coordinate_descent(shown, row[:20].astype(float), code.penalty),
        )
        assert objective(shown, row[:20], code.penalty, code.weights) == pytest.approx(
            least, rel=2e-5
        )


def test_patches_together_stop_at_the_step_limit():
    atoms, data, _ = problem(60, 16, noise=0.1)
    rows = np.repeat(data[None], bpdn.FEWEST_TOGETHER, axis=0).astype(np.float32)
    settings = BPDNSettings(rtol=1e-5, max_steps=3)
    usable = np.ones(rows.shape, bool)
    found = bpdn.codes(atoms.astype(np.float32), rows, usable, 0.05, settings)
    assert [(code.steps, code.converged) for code in found] == [(3, False)] * len(rows)

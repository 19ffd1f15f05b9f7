"""DV_K with frames and patches against a conic solver (extra `peers`)."""

import numpy as np
import pytest
from variation import from_patches, gradient

from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.tv import TVSettings, reconstruct_tv


def capture(psi):
    rng = np.random.default_rng(0)
    truth = 0.2 + 0.5 * rng.random(psi.light_field_shape)
    truth[:, :, :, 3:] = [0.7, 0.3, 0.5]
    return truth, psi.forward(truth)


@pytest.mark.parametrize(
    ("order", "mu", "primal_step"), [(1, 4e-3, 3.0), (2, 3e-3, 2.0), (3, 1e-3, 3.0)]
)
@pytest.mark.parametrize("patched", [False, True])
def test_the_objective_is_that_of_a_conic_solver(coded_psi, order, mu, primal_step, patched):
    cvxpy = pytest.importorskip("cvxpy")
    psi = coded_psi("mono", 1, 8, (4, 5), (1, 2), np.float64)
    truth, frames = capture(psi)
    usable = np.random.default_rng(1).random(frames.shape) < 0.9
    samples = truth.size
    identity = np.eye(samples).reshape(samples, *truth.shape)
    differences = np.stack([gradient(unit, order).ravel() for unit in identity], axis=-1)
    unknown = cvxpy.Variable(samples)
    count = len(differences) // samples
    parts = [
        cvxpy.reshape(
            differences[i * samples : (i + 1) * samples] @ unknown, (samples // 3, 3), "C"
        )
        for i in range(count)
    ]
    regulariser = cvxpy.sum(cvxpy.norm(cvxpy.hstack(parts), 2, axis=1))
    dense = psi.to_scipy().toarray()[usable.ravel()]
    value = 0.5 * cvxpy.sum_squares(dense @ unknown - frames[usable]) + mu * regulariser
    term, rho = None, 0.1
    if patched:
        patches = [truth[:, :, :3, :3], truth[:, :, 1:, 2:]]
        term = from_patches([(0, 0), (1, 1)], patches, [1, 0.5], truth.shape)
        spread = np.broadcast_to(term.weight[..., None], truth.shape).ravel()
        apart = cvxpy.multiply(np.sqrt(spread), unknown - term.target.ravel())
        value += rho / 2 * cvxpy.sum_squares(apart)
    tight = {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9}
    least = cvxpy.Problem(cvxpy.Minimize(value)).solve(solver="CLARABEL", **tight)
    settings = TVSettings(
        order=order,
        mu=mu,
        rho=rho,
        primal_step=primal_step,
        chroma_weight=1.0,
        rtol=1e-10,
        max_steps=6000,
    )
    found = reconstruct_tv(psi, even_frames(frames, 0.0, usable), settings, patch_term=term)
    assert found.objective[-1][1] == pytest.approx(least, rel=1e-6)

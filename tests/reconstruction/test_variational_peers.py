"""DV_K with frames and patches against other people's solvers (extra `peers`)."""

import numpy as np
import pytest
from full_splitting import from_patches, gradient, variation

from emmc_rig.model import kernels
from reconstruction.differences import norm_squared
from reconstruction.tv import TVSettings, reconstruct_tv


class PeerProblem:
    """The problem in pyproximal's terms, on flattened light fields (c, v, u, y, x)."""

    def __init__(self, psi, frames, mu):
        import pylops
        import pyproximal as proximal

        self.psi, self.mu = psi, mu
        views_v, views_u, rows, columns, colours = psi.light_field_shape
        self.shape = (colours, views_v, views_u, rows, columns)
        derivatives = [
            pylops.FirstDerivative(
                self.shape, axis=axis, kind="forward", edge=False, dtype=psi.weights.dtype
            )
            for axis in (4, 3, 2, 1)
        ]
        self.differences = pylops.VStack(derivatives, dtype=psi.weights.dtype)
        self.variation = proximal.L21(ndim=4 * colours, sigma=mu)
        problem = self

        class Misfit(proximal.ProxOperator):
            """1/2 |Psi L - I|^2 with its exact proximal step."""

            def __init__(self) -> None:
                super().__init__(None, False)
                self.step, self.inverse = 0.0, np.empty(0)

            def __call__(self, x) -> float:
                residual = psi.forward(problem.natural(x)) - frames
                return 0.5 * float(np.sum(np.square(residual, dtype=np.float64)))

            def prox(self, x, tau: float):
                if self.step != tau:
                    self.step, self.inverse = tau, psi.solver(1 / tau).inverse
                planar = np.ascontiguousarray(np.moveaxis(x.reshape(problem.shape), 0, 3))
                kernels.data_step(
                    psi.weights, psi.colour_map, self.inverse, frames, psi.binning, planar
                )
                return np.moveaxis(planar, 3, 0).ravel()

        self.misfit = Misfit()

    def natural(self, flat):
        """Return a flattened light field as (v, u, y, x, c)."""
        return np.moveaxis(flat.reshape(self.shape), 0, -1)

    def flat(self, light_field):
        """Return a light field (v, u, y, x, c) as pyproximal takes it."""
        return np.ascontiguousarray(np.moveaxis(light_field, -1, 0)).ravel()

    def solve(
        self,
        start,
        primal_step: float,
        steps: int,
        dual_step: float,
    ):
        """Return the light field (v, u, y, x, c) after pyproximal's primal-dual steps."""
        import pyproximal as proximal

        found = proximal.optimization.primaldual.PrimalDual(
            self.misfit,
            self.variation,
            self.differences,
            x0=self.flat(start),
            tau=primal_step,
            mu=dual_step,
            niter=steps,
            gfirst=False,
        )
        return self.natural(found)


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
    found = reconstruct_tv(psi, frames, 0.0, settings, usable, patch_term=term)
    assert found.objective[-1][1] == pytest.approx(least, rel=1e-6)


@pytest.mark.slow
def test_the_steps_without_over_relaxation_are_pyproximals(coded_psi):
    pytest.importorskip("pyproximal")
    psi = coded_psi("rggb", 2, 3, (4, 6), (2, 3), np.float64)
    truth, frames = capture(psi)
    mu, primal_step, steps = 1e-3, 3.0, 60
    peer = PeerProblem(psi, frames, mu)
    flat = peer.flat(truth)
    regulariser = peer.variation(np.asarray(peer.differences @ flat))
    assert regulariser == pytest.approx(mu * variation(truth, 1), rel=1e-12)
    start = np.full_like(truth, 0.5)
    dual_step = 1 / (norm_squared(1, (2, 3, None, None)) * primal_step)
    theirs = peer.solve(start, primal_step, steps, dual_step)
    settings = TVSettings(
        mu=mu,
        primal_step=primal_step,
        chroma_weight=1.0,
        relaxation=1.0,
        rtol=1e-30,
        max_steps=steps,
    )
    ours = reconstruct_tv(psi, frames, 0.0, settings, start=start)
    assert theirs.min() > 0.05
    assert theirs.max() < 0.95
    np.testing.assert_allclose(ours.light_field, theirs, atol=1e-6)
    value = peer.misfit(peer.flat(theirs)) + peer.variation(
        np.asarray(peer.differences @ peer.flat(theirs))
    )
    assert ours.objective[-1] == (steps, pytest.approx(value, rel=1e-9))

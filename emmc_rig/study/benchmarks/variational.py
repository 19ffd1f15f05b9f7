"""The fused primal-dual step timed against pyproximal's, on one total-variation problem.

Both minimise 1/2 |Psi L - I|^2 + mu DV_1(L) in float32. pyproximal (extra `peers`) is given our own
exact data step, and once none at all, so that only its loop, its differences and its projection
are timed.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.model import kernels
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.study.benchmarks.running import Asked, Show
from emmc_rig.study.benchmarks.timing import Figures
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]

OURS = "fused step"
MU, PRIMAL_STEP, DUAL_STEP = 1e-5, 1000.0, 1 / 16000
"""The settings that both take; they do not change the time of a step."""


@dataclass(frozen=True)
class StepTiming(Figures):
    """Seconds of one primal-dual iteration, and how many times ours that is."""

    name: str
    seconds: float
    times_ours: float


def peer_module(name: str) -> Any:
    """Import a library of the extra `peers`; raise AppError saying how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError as fault:
        raise AppError(f"{name} is not installed: pip install 'emmc-rig[peers]'") from fault


class PeerProblem:
    """The problem in pyproximal's terms, on flattened light fields (c, v, u, y, x)."""

    def __init__(self, psi: ImagingMatrix, frames: Array, mu: float, data_step: bool = True):
        proximal, pylops = peer_module("pyproximal"), peer_module("pylops")
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

            def __call__(self, x: Array) -> float:
                residual = psi.forward(problem.natural(x)) - frames
                return 0.5 * float(np.sum(np.square(residual, dtype=np.float64)))

            def prox(self, x: Array, tau: float) -> Array:
                if not data_step:
                    return x
                if self.step != tau:
                    self.step, self.inverse = tau, psi.solver(1 / tau).inverse
                planar = np.ascontiguousarray(np.moveaxis(x.reshape(problem.shape), 0, 3))
                kernels.data_step(
                    psi.weights, psi.colour_map, self.inverse, frames, psi.binning, planar
                )
                return np.moveaxis(planar, 3, 0).ravel()

        self.misfit = Misfit()

    def natural(self, flat: Array) -> Array:
        """Return a flattened light field as (v, u, y, x, c)."""
        return np.moveaxis(flat.reshape(self.shape), 0, -1)

    def flat(self, light_field: Array) -> Array:
        """Return a light field (v, u, y, x, c) as pyproximal takes it."""
        return np.ascontiguousarray(np.moveaxis(light_field, -1, 0)).ravel()

    def solve(
        self,
        start: Array,
        primal_step: float,
        steps: int,
        dual_step: float,
        on_step: Callable[[object], None] | None = None,
    ) -> Array:
        """Return the light field (v, u, y, x, c) after pyproximal's primal-dual steps."""
        proximal = peer_module("pyproximal")
        found = proximal.optimization.primaldual.PrimalDual(
            self.misfit,
            self.variation,
            self.differences,
            x0=self.flat(start),
            tau=primal_step,
            mu=dual_step,
            niter=steps,
            gfirst=False,
            callback=on_step,
        )
        return self.natural(found)


def variational_timings(
    camera: Camera, size: tuple[int, int], repeats: int
) -> Iterator[StepTiming]:
    """Yield the seconds of our step, of pyproximal's, and of that without its data step.

    Each is the median time between the ends of two steps of one run.
    """
    psi = build_imaging_matrix(camera, size)
    truth = np.random.default_rng(0).random(psi.light_field_shape, dtype=np.float32)
    frames = psi.forward(truth)
    grey = np.full_like(truth, 0.5)
    steps = repeats + 2
    settings = TVSettings(
        mu=MU, primal_step=PRIMAL_STEP, rtol=1e-30, max_steps=steps, objective_every=10**6
    )
    ends: list[float] = []

    def ended(_: object) -> None:
        ends.append(time.perf_counter())

    reconstruct_tv(psi, frames, 0.0, settings, on_step=ended, start=grey)
    own_s = _step_s(ends)
    yield StepTiming(OURS, own_s, 1.0)
    for name, data_step in (("pyproximal", True), ("pyproximal without data step", False)):
        ends.clear()
        problem = PeerProblem(psi, frames, MU, data_step)
        problem.solve(grey, PRIMAL_STEP, steps, DUAL_STEP, ended)
        peer_s = _step_s(ends)
        yield StepTiming(name, peer_s, peer_s / own_s)


def _step_s(ends: list[float]) -> float:
    """Return the median seconds between the ends of steps; the first one may have compiled."""
    return float(np.median(np.diff(ends)))


def benchmark(asked: Asked, show: Show, folder: Path) -> dict[str, Any]:
    """Time the primal-dual step, and that of another library (`chart --peers`)."""
    size = asked.size or (593, 840)
    steps = list(variational_timings(asked.described, size, asked.repeats or 7))
    show.table(
        ("primal-dual step", "ms", "times ours"),
        [(one.name, f"{one.seconds * 1e3:.1f}", f"{one.times_ours:.1f}") for one in steps],
    )
    rows = [one.as_dict() for one in steps]
    return {"camera": asked.camera, "size": list(size), "steps": rows}

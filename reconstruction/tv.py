"""DV_K and patches with the exact data step, by default total variation: the paper's eq. 9.

min 1/2 |Psi L - I|^2 + mu DV_K(L) + rho/2 sum W |L - M|^2, the last being what a collection of
patches asks for (see `problem`), if one is given. DV_K is the paper's colour-coupled
spatio-angular differential (Section VI-B; K = 1: total variation), with one liberty: the
differences are measured in opponent colours (luminance and two chrominances, orthonormal), and
those of the chrominances count `chroma_weight` times. Colours vary less than brightness, so this
resolves what mask and CFA leave ambiguous; a weight of 1 is the paper's DV_K exactly.

The algorithm is over-relaxed primal-dual splitting (Condat 2013, algorithm 3.1) with the proximal
step of frames and patches together. D are the derivatives of the weighted opponent colours, p the
dual variable (a vector for each sample), gamma and tau the primal and dual steps, and
a = 1/gamma + rho W:

    q  = L - gamma D^T p
    z  = (q / gamma + rho W M) / a
    L' = z - Psi^T (Psi Psi^T + a)^-1 (Psi z - I)       one small block for each pixel
    p' = p + tau D (2 L' - L),  each vector shortened to mu
    L  = L + relaxation (L' - L),  p = p + relaxation (p' - p)

The paper's eq. 10-13 take gradients of the misfit instead.

Bytes of one step, float32, for N = v u y x c values, one stored colour of three and s shots:
light field read and written 2 x 4N, and once more written, 4N; dual variable read and written
2 x 16N, weights s x 4N/3; with patches their target read, 4N. Of DV_2 the dual variable is 10/4 as
large, of DV_3 20/4; they are bound by operations, 2 x 36 and 2 x 120 multiplications and additions
per value.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.compiling import running_s
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi, rows_of_colours
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction import differences, kernels
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.problem import (
    PatchTerm,
    Problem,
    choose_mu,
    choose_primal_step,
    colour_metric,
    contrast,
    first_light_field,
    smooth_guess,
)
from emmc_rig.reconstruction.result import Progress, Reconstruction, Status

Array = NDArray[np.floating]


class TVSettings(Settings):
    """Settings of the solver; None lets the noise and the data choose."""

    mu: float | None = Field(
        default=None, gt=0, description="weight of DV_K, in units of the readings"
    )
    order: int = Field(default=1, ge=1, description="K of DV_K; 1: total variation")
    rho: float = Field(default=1e-2, ge=0, description="weight of the patch term, if one is given")
    chroma_weight: float = Field(
        default=2.0, gt=0, description="of chrominance against luminance differences; 1: DV_K"
    )
    primal_step: float | None = Field(
        default=None, gt=0, description="gamma; the dual step follows"
    )
    relaxation: float = Field(default=1.9, ge=1, lt=2)
    rtol: float = Field(
        default=3e-4,
        gt=0,
        description="relative change of the light field per step; less for a lesser primal_step",
    )
    max_steps: int = Field(default=200, ge=1)
    objective_every: int = Field(default=10, ge=1)


def method_name(order: int, with_patches: bool) -> str:
    """Return the name of a method: tv, tv-patch, dv2, dv2-patch, ..."""
    return ("tv" if order == 1 else f"dv{order}") + ("-patch" if with_patches else "")


class Sweeps:
    """Steps of the solver on a light field, in place; `planar` is it, (v, u, y, colour, x).

    begin: the light field to begin with, (v, u, y, x, c). gamma: the primal step, of Psi's type.
    The frames of the problem may change between steps.
    """

    def __init__(
        self, problem: Problem, gamma: np.floating, relaxation: np.floating, begin: Array
    ) -> None:
        psi, dtype = problem.psi, problem.psi.weights.dtype
        a = 1 / gamma + problem.pixel_weight()
        inverse = psi.inverted_blocks(np.where(problem.usable, a, np.inf))
        fit = kernels.FrameFit(psi.weights, psi.colour_map, inverse, problem.frames, psi.binning)
        if problem.patch_term is not None:
            # z = share q + pulled
            share = np.kron(1 / (gamma * a), np.ones((psi.binning, psi.binning))).astype(dtype)
            pulled = rows_of_colours(problem.patch_term.target) * (1 - share)[:, None, :]
            fit = fit._replace(share=share, pulled=np.ascontiguousarray(pulled, dtype=dtype))
        # The splitting converges where tau gamma |D|^2 is at most 1.
        of_colours = float(np.linalg.norm(problem.metric, 2)) ** 2
        norm2 = of_colours * differences.norm_squared(problem.order, (*psi.views, None, None))
        tau = dtype.type(1 / (norm2 * gamma))
        steps = kernels.Steps(gamma, tau, dtype.type(problem.mu), relaxation, problem.metric)
        self.planar = np.empty((*begin.shape[:3], 3, begin.shape[3]), dtype)
        self.planar[:] = rows_of_colours(begin)
        taps = differences.stencils(problem.order, begin.shape, dtype)
        dual = np.zeros((*begin.shape[:3], len(taps.reach), 3, begin.shape[3]), dtype)
        self._moved = np.zeros((psi.frames_shape[1], 2))
        room = np.empty_like(self.planar)
        self._sweep = partial(kernels.sweep, fit, steps, taps, self.planar, dual, room, self._moved)

    @classmethod
    def usual(cls, psi: Psi, frames: Array, usable: NDArray[np.bool_], mu: float) -> Sweeps:
        """Return steps of total variation with the usual settings, begun with a smooth picture.

        frames, usable: (shot, pixel_y, pixel_x), checked, the frames in Psi's type and finite. mu:
        the weight of total variation.
        """
        settings, dtype = TVSettings(), psi.weights.dtype.type
        guess = smooth_guess(psi, frames, usable)
        gamma = choose_primal_step(contrast(guess), mu, settings.chroma_weight)
        metric = colour_metric(settings.chroma_weight).astype(dtype)
        problem = Problem(psi, frames, usable, mu, 1, metric)
        begin = np.broadcast_to(guess, psi.light_field_shape)
        return cls(problem, dtype(gamma), dtype(settings.relaxation), begin)

    def advance(self, steps: int = 1) -> float:
        """Do some steps; return the relative change of the light field in the last one."""
        for _ in range(steps):
            self._sweep()
        squared_change, squared_size = self._moved.sum(axis=0)
        return float(np.sqrt(squared_change / max(squared_size, 1e-300)))

    def end(self) -> None:
        """Give back what further steps need, mostly the dual: four times the light field."""
        del self._sweep

    @property
    def light_field(self) -> NDArray[np.float32]:
        """The estimate so far, (v, u, y, x, c) in [0, 1], a copy."""
        values = np.ascontiguousarray(np.moveaxis(self.planar, -2, -1), dtype=np.float32)
        return np.clip(values, 0, 1, out=values)


def few_steps(
    psi: Psi, frames: Array, usable: NDArray[np.bool_], mu: float, count: int
) -> NDArray[np.float32]:
    """Return the light field (v, u, y, x, c) of `count` steps of total variation.

    Arguments: see `Sweeps.usual`.
    """
    sweeps = Sweeps.usual(psi, frames, usable, mu)
    sweeps.advance(count)
    sweeps.end()
    return sweeps.light_field


def reconstruct_tv(
    psi: Psi,
    frames: Frames,
    settings: TVSettings | None = None,
    on_step: Callable[[Progress], None] | None = None,
    patch_term: PatchTerm | None = None,
) -> Reconstruction:
    """Return the light field of least total variation that explains the frames.

    Their typical deviation sets mu when the settings do not; saturated and dead pixels are left out
    exactly. patch_term: estimates to stay near, rho times their weight, and to begin with. Raises
    ReconstructionError for frames that do not fit Psi, see `checked_inputs`.
    """
    settings = settings or TVSettings()
    started = running_s()
    if settings.rho == 0:
        patch_term = None
    frames = checked_inputs(psi, frames)
    data, usable, dtype = frames.readings, frames.usable, psi.weights.dtype.type
    mu = settings.mu or choose_mu(psi, data[usable], frames.noise_sigma, settings.order)
    guess = smooth_guess(psi, data, usable)
    usual = choose_primal_step(contrast(guess), mu, settings.chroma_weight, settings.order)
    gamma = settings.primal_step or usual
    # A step that small moves little however far there is to go.
    rtol = settings.rtol * min(1.0, gamma / usual)
    metric = colour_metric(settings.chroma_weight).astype(dtype)
    problem = Problem(psi, data, usable, mu, settings.order, metric, patch_term, settings.rho)
    begin = first_light_field(psi, guess, patch_term)
    sweeps = Sweeps(problem, dtype(gamma), dtype(settings.relaxation), begin)
    history: list[tuple[int, float]] = []
    change, step = np.inf, 0
    while step < settings.max_steps and change > rtol:
        change = sweeps.advance()
        step += 1
        value = None
        if step % settings.objective_every == 0:
            value = problem.value(np.moveaxis(sweeps.planar, -2, -1))
            history.append((step, value))
        if on_step is not None:
            on_step(Progress(step, change, value))
    sweeps.end()
    converged = change <= rtol
    return Reconstruction(
        method=method_name(settings.order, patch_term is not None),
        light_field=sweeps.light_field,
        status=Status.CONVERGED if converged else Status.STEP_LIMIT,
        advice="" if converged else "raise max_steps or loosen rtol",
        steps=step,
        objective=tuple(history),
        seconds=running_s() - started,
        parameters={
            "mu": float(mu),
            "chroma_weight": settings.chroma_weight,
            "primal_step": float(gamma),
            "noise_sigma": frames.noise_sigma,
            "order": settings.order,
            "rho": settings.rho,
        },
    )

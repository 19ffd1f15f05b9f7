"""The paper's full-splitting algorithm (Section VI-B, eq. 10-13), in plain NumPy: a reference.

It takes the gradients of the misfits of frames and patches where `reconstruction.tv` takes their
exact proximal step, reaches the same minimiser, and needs many times the steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import sparse

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import Settings
from reconstruction.choices import (
    choose_mu,
    choose_primal_step,
    contrast,
    first_light_field,
    smooth_guess,
)
from reconstruction.differences import fitting_indices, norm_squared, planar_variation
from reconstruction.errors import ReconstructionError
from reconstruction.inputs import check_light_fields, checked_inputs
from reconstruction.patch_term import PatchTerm
from reconstruction.problem import Problem, colour_metric
from reconstruction.result import Progress, Reconstruction, Status

Array = NDArray[np.floating]
AXIS = (3, 2, 1, 0)
"""Entries of a multi-index, x y u v, as axes of (v, u, y, x, c)."""
METHOD = "full-splitting"
MARGIN = 0.99
"""Of the largest step sizes allowed, what is taken where the settings leave it open."""


def from_patches(positions, patches, weights, shape):
    """Return the term of patches (v, u, y, x, c) at their corners; weights: None counts each once.

    The paper's P and its weights: what covers a sample is averaged, as each patch weighs.
    """
    total: Array = np.zeros(shape, np.float32)
    weight: Array = np.zeros(shape[2:4], np.float32)
    for (y, x), patch, share in zip(
        positions, patches, weights or [1.0] * len(patches), strict=True
    ):
        place = np.s_[y : y + patch.shape[2], x : x + patch.shape[3]]
        weight[place] += share
        total[(slice(None), slice(None), *place)] += (
            np.asarray(share, np.float32)[..., None] * patch
        )
    target = total / np.where(weight > 0, weight, 1)[..., None]
    return PatchTerm(np.asarray(target, np.float32), np.asarray(weight, np.float32))


@cache
def difference_matrix(shape, order):
    """Return the derivatives of flattened light fields as a sparse matrix, index by index."""
    blocks = []
    for index in fitting_indices(order, shape):
        parts = [sparse.eye_array(length) for length in shape]
        for entry, axis in zip(index, AXIS, strict=True):
            inside = sparse.csr_array(np.diff(np.eye(shape[axis]), entry, axis=0))
            inside.resize((shape[axis], shape[axis]))
            parts[axis] = inside
        blocks.append(reduce(sparse.kron, parts))
    return sparse.vstack(blocks).tocsr()


def variation(light_field, order, metric=None):
    """DV_K of a light field (v, u, y, x, c), its colours first multiplied by a metric."""
    planar = np.ascontiguousarray(np.swapaxes(light_field, -1, -2))
    metric = np.eye(3) if metric is None else metric
    return planar_variation(planar, order, metric.astype(planar.dtype))


def gradient(light_field, order):
    """Return all derivatives (index, v, u, y, x, c) that fit somewhere, 0 where they do not."""
    matrix = difference_matrix(light_field.shape, order)
    return (matrix @ light_field.ravel()).reshape(-1, *light_field.shape)


def adjoint(derivatives, order):
    """Return the adjoint of `gradient`; values where a derivative does not fit do not count."""
    shape = derivatives.shape[1:]
    return (difference_matrix(shape, order).T @ derivatives.ravel()).reshape(shape)


class FullSplittingSettings(Settings):
    """Settings of eq. 9-13; None lets the code choose."""

    order: int = Field(default=1, ge=1, description="K of DV_K")
    mu: float | None = Field(default=None, ge=0, description="weight of DV_K")
    rho: float = Field(default=1e-2, ge=0, description="weight of the patch term, if one is given")
    gamma: float | None = Field(default=None, gt=0, description="primal step")
    tau: float | None = Field(default=None, gt=0, description="dual step")
    chroma_weight: float = Field(default=1.0, gt=0, description="as of TV; 1: the paper's DV_K")
    rtol: float = Field(default=1e-6, ge=0, description="relative change per step")
    max_steps: int = Field(default=20000, ge=1)
    objective_every: int = Field(default=100, ge=1)


@dataclass(frozen=True)
class StepSizes:
    """gamma and tau that meet the paper's condition below eq. 13."""

    gamma: float
    tau: float


def step_sizes(
    smooth: float, differences: float, gamma: float | None, tau: float | None, wanted: float
) -> StepSizes:
    """Return step sizes with gamma (smooth + tau differences) < 1, those given unchanged.

    smooth: |Psi* Psi| / 2 + rho |P* P| / 2. differences: |grad* grad|. wanted: a gamma that suits
    the data, taken as far as the condition allows when neither is given. Raises
    ReconstructionError for steps that violate the condition, naming the largest allowed.
    """
    if gamma is not None and gamma * smooth >= 1:
        raise ReconstructionError(
            f"gamma {gamma:g} is too large for any tau: it must be below {1 / smooth:.6g}"
        )
    if tau is None:
        tau = MARGIN * (1 / gamma - smooth) / differences if gamma else 1 / (wanted * differences)
    bound = 1 / (smooth + tau * differences)
    if gamma is None:
        gamma = MARGIN * bound
    if gamma >= bound:
        largest_tau = (1 / gamma - smooth) / differences
        raise ReconstructionError(
            f"gamma {gamma:g} and tau {tau:g} violate the condition of convergence: with this tau "
            f"gamma must be below {bound:.6g}, with this gamma tau below {largest_tau:.6g}"
        )
    return StepSizes(gamma, tau)


def into_ball(dual: Array, radius: float) -> Array:
    """Return prox of tau (radius |.|_1,2)*: every sample's derivatives and colours in a ball.

    dual: (index, v, u, y, x, c). By Moreau's identity the prox is this projection for every tau.
    """
    length = np.sqrt(np.square(dual).sum(axis=(0, -1)))[None, ..., None]
    return dual * (radius / np.maximum(length, max(radius, 1e-300)))


def reconstruct_full_splitting(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float,
    settings: FullSplittingSettings | None = None,
    usable: NDArray[np.bool_] | None = None,
    on_step: Callable[[Progress], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    patch_term: PatchTerm | None = None,
    start: Array | None = None,
) -> Reconstruction:
    """Return the minimiser of eq. 9; arguments and errors as of `reconstruct_tv`.

    Works in Psi's precision; the light field returned is float32, cut to [0, 1].
    """
    settings = settings or FullSplittingSettings()
    started = clock()
    data, usable = checked_inputs(psi, frames, noise_sigma, usable)
    check_light_fields(psi, patch_term, start)
    dtype = psi.weights.dtype
    mu = choose_mu(psi, data[usable], noise_sigma) if settings.mu is None else settings.mu
    order, rho = settings.order, settings.rho if patch_term is not None else 0.0
    metric = colour_metric(settings.chroma_weight).astype(dtype)
    problem = Problem(psi, data, usable, mu, order, metric, patch_term, rho)
    spread = float(np.linalg.norm(metric, 2)) ** 2
    heaviest = 0.0 if patch_term is None else float(patch_term.weight.max())
    smooth = (psi.norm**2 + rho * heaviest) / 2
    differences = spread * norm_squared(order, psi.light_field_shape)
    guess = smooth_guess(psi, data, usable)
    wanted = choose_primal_step(contrast(guess), max(mu, 1e-12), settings.chroma_weight, order)
    sizes = step_sizes(smooth, differences, settings.gamma, settings.tau, wanted)
    begin = first_light_field(psi, guess, patch_term) if start is None else start
    light_field = np.array(begin, dtype=dtype)
    dual = np.zeros_like(gradient(light_field, order))
    history: list[tuple[int, float]] = []
    change, step = np.inf, 0
    while step < settings.max_steps and change > settings.rtol:
        slope = psi.adjoint((psi.forward(light_field) - data) * usable)
        if patch_term is not None:
            slope += rho * patch_term.weight[..., None] * (light_field - patch_term.target)
        new = light_field - sizes.gamma * (slope + adjoint(dual, order) @ metric)
        raised = gradient((2 * new - light_field) @ metric.T, order)
        dual = into_ball(dual + sizes.tau * raised, mu)
        change = float(np.linalg.norm(new - light_field) / max(np.linalg.norm(new), 1e-300))
        light_field, step = new, step + 1
        value = problem.value(light_field) if step % settings.objective_every == 0 else None
        if value is not None:
            history.append((step, value))
        if on_step is not None:
            on_step(Progress(step, change, value))
    converged = change <= settings.rtol
    return Reconstruction(
        method=METHOD,
        light_field=np.clip(light_field, 0, 1).astype(np.float32),
        status=Status.CONVERGED if converged else Status.STEP_LIMIT,
        advice="" if converged else "raise max_steps or loosen rtol",
        steps=step,
        objective=tuple(history),
        seconds=clock() - started,
        parameters={
            "mu": float(mu),
            "chroma_weight": settings.chroma_weight,
            "gamma": sizes.gamma,
            "tau": sizes.tau,
            "noise_sigma": noise_sigma,
            "order": order,
            "rho": rho,
        },
    )

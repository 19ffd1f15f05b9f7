"""Rounding and step sizes: float32 kernels against float64 through SciPy, absurd steps of TV."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model import kernels as psi_kernels
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix, rows_of_colours
from emmc_rig.study.stability.checks import BROKEN, SOUND, VIEWS, WEAK, Finding, solved
from emmc_rig.study.stability.reference import Reference
from emmc_rig.study.stability.trial import Trial
from reconstruction.choices import choose_mu, first_light_field, smooth_guess
from reconstruction.differences import norm_squared
from reconstruction.methods import MethodSettings
from reconstruction.problem import Problem, colour_metric
from reconstruction.result import Status
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]
EPSILON = float(np.finfo(np.float32).eps)
ROUNDING = 4.0
"""Relative error of sums of some dozen float32 terms, in its epsilons."""
SOLVED = 40.0
"""Likewise after the steps of a solver."""
TV_STEPS = 20
STEP_FACTORS = (1e-6, 1e-3, 1e3, 1e6)
SAME_DB = 0.01


def relative(found: Array, reference: Array) -> float:
    """Return |found - reference| / |reference|, in epsilons of float32."""
    off = np.linalg.norm((found.astype(np.float64) - reference).ravel())
    return float(off / max(np.linalg.norm(reference.ravel()), 1e-300)) / EPSILON


def _judged(name: str, epsilons: float, limit: float, meaning: str) -> Finding:
    verdict = SOUND if epsilons <= limit else WEAK if epsilons <= 100 * limit else BROKEN
    figure = f"{epsilons:.2g} epsilons of float32"
    return Finding(name, figure, verdict, meaning)


def rounding(trials: Sequence[Trial]) -> list[Finding]:
    """Float32 kernels against float64 through SciPy, the worst of several sensors."""
    worst: dict[str, float] = {}

    def note(name: str, epsilons: float) -> None:
        worst[name] = max(worst.get(name, 0.0), epsilons)

    for trial in trials:
        psi, metric = trial.psi, colour_metric(TVSettings().chroma_weight)
        plain = Reference(psi, metric.astype(np.float32).astype(np.float64))
        truth, frames = trial.truth, trial.readings
        note("Psi", relative(psi.forward(truth), plain.forward(truth)))
        note("Psi^T", relative(psi.adjoint(frames), plain.adjoint(frames)))
        gamma = 1 / float(psi.gram.mean())
        begin = np.ascontiguousarray(rows_of_colours(np.full_like(truth, 0.3)))
        inverse = psi.solver(1 / gamma).inverse
        psi_kernels.data_step(psi.weights, psi.colour_map, inverse, frames, psi.binning, begin)
        stepped = plain.data_step(np.full_like(truth, 0.3), frames, gamma)
        note("proximal step", relative(np.moveaxis(begin, -2, -1), stepped))
        every = np.ones(psi.frames_shape, dtype=bool)
        problem = Problem(psi, np.asarray(frames), every, 1.0, 1, metric.astype(np.float32))
        misfit = 0.5 * float(np.square(plain.forward(truth) - frames).sum())
        value = misfit + plain.variation(truth)
        note("objective of TV", abs(problem.value(truth) / value - 1) / EPSILON)
        note("TV, 20 steps", _tv_against(plain, trial))
    meanings = {
        "Psi": (ROUNDING, "sums over the views of a pixel round as they must"),
        "Psi^T": (ROUNDING, "one product a sample"),
        "proximal step": (ROUNDING, "blocks are inverted in float64, applied in float32"),
        "objective of TV": (ROUNDING, "sums run in float64"),
        "TV, 20 steps": (SOLVED, "rounding does not grow from step to step"),
    }
    return [
        _judged(f"float32 against float64: {name}", epsilons, *meanings[name])
        for name, epsilons in worst.items()
    ]


def _tv_against(plain: Reference, trial: Trial) -> float:
    psi, settings = trial.psi, TVSettings(max_steps=TV_STEPS, rtol=1e-12, objective_every=TV_STEPS)
    data = np.where(trial.usable, trial.readings, 0)
    every = np.ones(psi.frames_shape, dtype=bool)
    mu = choose_mu(psi, data, trial.noise_sigma)
    gamma = 0.02 / mu
    start = first_light_field(psi, smooth_guess(psi, data, every), None)
    chosen = settings.model_copy(update={"mu": mu, "primal_step": gamma})
    found = reconstruct_tv(psi, data, trial.noise_sigma, chosen, every, start=np.array(start))
    spread = float(np.linalg.norm(plain.metric, 2)) ** 2
    dual_step = 1 / (spread * norm_squared(1, (*VIEWS, None, None)) * gamma)
    steps = plain.steps(data, start, mu, gamma, dual_step, settings.relaxation)
    reference = next(one for i, one in enumerate(steps) if i == TV_STEPS - 1)
    return relative(found.light_field, np.clip(reference, 0, 1))


def double_precision(trial: Trial) -> Finding:
    """The light field of TV run to its end in float32 and in float64, by PSNR."""
    wide = ImagingMatrix(trial.psi.weights.astype(np.float64), trial.psi.colour, trial.psi.binning)
    narrow = solved(trial, "tv").light_field
    other = solved(replace(trial, psi=wide), "tv").light_field
    apart = psnr_db(narrow, trial.truth) - psnr_db(other, trial.truth)
    verdict = SOUND if abs(apart) < SAME_DB else WEAK
    meaning = "all of Psi and the solver in float64 find the same light field"
    return Finding("TV to its end, float32 less float64", f"{apart:+.4f} dB", verdict, meaning)


def step_sizes(trial: Trial) -> list[Finding]:
    """TV with primal steps and mu far from those that it chooses."""
    usual = solved(trial, "tv", MethodSettings(tv=TVSettings(objective_every=1)))
    objective = usual.objective[-1][1]
    findings = []
    for factor in STEP_FACTORS:
        step = usual.parameters["primal_step"] * factor
        chosen = TVSettings(mu=usual.parameters["mu"], primal_step=step, objective_every=1)
        found = solved(trial, "tv", MethodSettings(tv=chosen))
        value = found.objective[-1][1]
        finite = bool(np.isfinite(found.light_field).all())
        stopped = found.status != Status.CONVERGED
        reached = value / objective
        honest = reached < 1.05 or stopped
        findings.append(
            Finding(
                f"TV, primal step x {factor:g}",
                f"objective {reached:.3g} times the usual after {found.steps} steps; "
                f"{found.status}",
                BROKEN if not finite else SOUND if honest else WEAK,
                "stays finite; the status says where it did not converge",
            )
        )
    for mu in (1e-12, 1e6):
        found = solved(trial, "tv", MethodSettings(tv=TVSettings(mu=mu)))
        finite = bool(np.isfinite(found.light_field).all())
        db = psnr_db(found.light_field, trial.truth) if finite else math.nan
        findings.append(
            Finding(
                f"TV, mu {mu:g}",
                f"{db:.1f} dB, usual {psnr_db(usual.light_field, trial.truth):.1f}; {found.status}",
                SOUND if finite else BROKEN,
                "no smoothness at all, and nothing but smoothness: finite",
            )
        )
    return findings

"""Float32 kernels against float64 through SciPy, written from the formulas; absurd steps of TV."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from emmc_rig.files.cameras import find_camera
from emmc_rig.model import kernels as psi_kernels
from emmc_rig.model.errors import ModelError
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix, rows_of_colours
from emmc_rig.study.trial import Capture, Trial, trial_of
from reconstruction.choices import choose_mu, first_light_field, smooth_guess
from reconstruction.differences import norm_squared
from reconstruction.errors import ReconstructionError
from reconstruction.methods import MethodSettings
from reconstruction.problem import Problem, colour_metric
from reconstruction.result import Status
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]
AXES = (3, 2, 1, 0)
"""Directions of the differences, x y u v, as axes of (v, u, y, x, c)."""


@dataclass(frozen=True, eq=False)
class Reference:
    """metric: (3, 3), turns colours into those whose differences count (see `reconstruct_tv`)."""

    psi: ImagingMatrix
    metric: NDArray[np.float64]

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """Psi as it is stored, in float64."""
        return self.psi.to_scipy().astype(np.float64).tocsr()

    @cached_property
    def differences(self) -> list[sparse.csr_array]:
        """Forward differences along x, y, u and v, 0 across the far border, of mixed colours."""
        shape = self.psi.light_field_shape
        found = []
        for axis in AXES:
            parts: list = [sparse.eye_array(n) for n in shape[:4]]
            step = np.eye(shape[axis], k=1) - np.eye(shape[axis])
            step[-1] = 0
            parts[axis] = sparse.csr_array(step)
            found.append(reduce(sparse.kron, [*parts, self.metric]).tocsr())
        return found

    def forward(self, light_field: Array) -> NDArray[np.float64]:
        """Return Psi light_field, (shot, pixel_y, pixel_x)."""
        flat = np.asarray(light_field, dtype=np.float64).ravel()
        return (self.matrix @ flat).reshape(self.psi.frames_shape)

    def adjoint(self, frames: Array) -> NDArray[np.float64]:
        """Return Psi^T frames, (v, u, y, x, c)."""
        flat = np.asarray(frames, dtype=np.float64).ravel()
        return (self.matrix.T @ flat).reshape(self.psi.light_field_shape)

    def _system(self, gamma: float) -> sparse.csc_array:
        matrix, readings = self.matrix, self.psi.shape[0]
        return sparse.csc_array(matrix @ matrix.T + sparse.eye_array(readings) / gamma)

    def data_step(self, light_field: Array, frames: Array, gamma: float) -> NDArray[np.float64]:
        """Return the proximal point of gamma / 2 |Psi z - frames|^2: the normal equations."""
        missed = self.forward(light_field) - np.asarray(frames, dtype=np.float64)
        return np.asarray(light_field, np.float64) - self.adjoint(
            splu(self._system(gamma)).solve(missed.ravel()).reshape(missed.shape)
        )

    def variation(self, light_field: Array) -> float:
        """Return the sum over samples of the length of their differences, colours together."""
        flat = np.asarray(light_field, dtype=np.float64).ravel()
        square = sum(np.square(one @ flat).reshape(-1, 3).sum(axis=1) for one in self.differences)
        return float(np.sqrt(square).sum())

    def steps(
        self, frames: Array, start: Array, mu: float, gamma: float, dual_step: float, relax: float
    ) -> Iterator[NDArray[np.float64]]:
        """Yield the light fields of over-relaxed primal-dual steps (Condat 2013, algorithm 3.1)."""
        matrix, shape = self.matrix, self.psi.light_field_shape
        now = np.asarray(start, dtype=np.float64).ravel()
        duals = [np.zeros(now.size) for _ in self.differences]
        data = np.asarray(frames, dtype=np.float64).ravel()
        factor = splu(self._system(gamma))
        while True:
            pulled = sum(one.T @ dual for one, dual in zip(self.differences, duals, strict=True))
            down = now - gamma * pulled
            new = down - matrix.T @ factor.solve(matrix @ down - data)
            ahead = 2 * new - now
            raised = [
                dual + dual_step * (one @ ahead)
                for one, dual in zip(self.differences, duals, strict=True)
            ]
            square = sum(np.square(one).reshape(-1, 3).sum(axis=1) for one in raised)
            shrink = np.repeat(1 / np.maximum(np.sqrt(square) / mu, 1), 3)
            duals = [
                relax * shrink * one + (1 - relax) * dual
                for one, dual in zip(raised, duals, strict=True)
            ]
            now = relax * new + (1 - relax) * now
            yield now.reshape(shape)


SOUND, WEAK, BROKEN = "sound", "weak", "broken"
SCENE, SIZE, VIEWS, ZOOM = "near-planar", (24, 32), (3, 3), 6


@dataclass(frozen=True)
class Finding:
    """One check. figure: what was measured, in words. verdict: sound, weak or broken."""

    name: str
    figure: str
    verdict: str
    meaning: str


@dataclass(frozen=True)
class Attempt:
    """What a method made of a capture: its PSNR, or why there is none.

    refused: the error's line, "" where it ran. db: NaN where it did not run or is not finite.
    """

    db: float
    refused: str = ""

    @property
    def words(self) -> str:
        """Return it for a table."""
        if self.refused:
            return "refused"
        return f"{self.db:.2f}" if math.isfinite(self.db) else "not finite"


def example(camera: str = "rgbw-bayer-1shot", shots: int = 1, binning: int = 1) -> Trial:
    """Return a small noisy capture of a built-in scene."""
    chosen = find_camera(camera)
    sensor = chosen.sensor.model_copy(update={"binning": binning})
    chosen = chosen.with_shots(shots).model_copy(update={"views": VIEWS, "sensor": sensor})
    return trial_of(Capture(SCENE, chosen, SIZE, zoom=ZOOM))


def attempted(trial: Trial, method: str, scale: float = 1.0) -> Attempt:
    """Return the attempt of a method, its light field divided by `scale`."""
    try:
        found = np.clip(trial.solved(method).light_field.astype(np.float64) / scale, 0, 1)
    except (ReconstructionError, ModelError) as fault:
        return Attempt(math.nan, str(fault))
    if not np.isfinite(found).all():
        return Attempt(math.nan)
    return Attempt(psnr_db(found, trial.truth))


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
    narrow = trial.solved("tv").light_field
    other = replace(trial, psi=wide).solved("tv").light_field
    apart = psnr_db(narrow, trial.truth) - psnr_db(other, trial.truth)
    verdict = SOUND if abs(apart) < SAME_DB else WEAK
    meaning = "all of Psi and the solver in float64 find the same light field"
    return Finding("TV to its end, float32 less float64", f"{apart:+.4f} dB", verdict, meaning)


def step_sizes(trial: Trial) -> list[Finding]:
    """TV with primal steps and mu far from those that it chooses."""
    usual = trial.solved("tv", MethodSettings(tv=TVSettings(objective_every=1)))
    objective = usual.objective[-1][1]
    findings = []
    for factor in STEP_FACTORS:
        step = usual.parameters["primal_step"] * factor
        chosen = TVSettings(mu=usual.parameters["mu"], primal_step=step, objective_every=1)
        found = trial.solved("tv", MethodSettings(tv=chosen))
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
        found = trial.solved("tv", MethodSettings(tv=TVSettings(mu=mu)))
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

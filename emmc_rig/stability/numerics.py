"""Numerical stability: rounding, ill-conditioned Psi, step sizes, the data's scale, repeatability.

Kernels are compared with float64 through SciPy (`reference`), methods with themselves on the same
capture: what should change nothing must change nothing, what cannot be solved must be refused or
come out finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import get_num_threads, set_num_threads
from numpy.typing import NDArray

from emmc_rig.camera_sheet import find_camera
from emmc_rig.demo import Watcher
from emmc_rig.model import kernels as psi_kernels
from emmc_rig.model.errors import ModelError
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix, rows_of_colours
from emmc_rig.reconstruct import open_dictionary
from emmc_rig.stability.reference import Reference
from emmc_rig.stability.trial import Setup, Trial, taken
from reconstruction.choices import choose_mu, first_light_field, smooth_guess
from reconstruction.differences import norm_squared
from reconstruction.errors import ReconstructionError
from reconstruction.methods import METHODS, MethodSettings, reconstruct
from reconstruction.problem import Problem, colour_metric
from reconstruction.result import Reconstruction
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]
SOUND, WEAK, BROKEN = "sound", "weak", "broken"
EPSILON = float(np.finfo(np.float32).eps)
SCENE, SIZE, VIEWS, ZOOM = "near-planar", (24, 32), (3, 3), 6
ROUNDING = 4.0
"""Relative error of sums of some dozen float32 terms, in its epsilons."""
SOLVED = 40.0
"""Likewise after the steps of a solver."""
SAME_DB, FEW_DB = 0.1, 3.0
TV_STEPS = 20
SCALES = (1e-6, 1e-3, 1e-1, 1e1, 1e3, 1e6)
QUICK_SCALES = (1e-6, 1e6)
OPAQUE = 0.02
SLOW = ("dict-ista", "dict-fista", "dict-lars", "dict-sl0")
STEP_FACTORS = (1e-6, 1e-3, 1e3, 1e6)


@dataclass(frozen=True)
class Finding:
    """One check. figure: what was measured, in words. verdict: sound, weak or broken."""

    name: str
    figure: str
    verdict: str
    meaning: str


@dataclass(frozen=True)
class Outcome:
    """What became of a method: its PSNR, or why there is none.

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


@dataclass(frozen=True)
class Numerics:
    """findings: every check. outcomes: condition -> method -> outcome; scales likewise, by factor,
    of results divided by it."""

    findings: list[Finding]
    outcomes: dict[str, dict[str, Outcome]]
    scales: dict[float, dict[str, Outcome]]


def example(camera: str = "rgbw-bayer-1shot", shots: int = 1, binning: int = 1) -> Trial:
    """Return a small noisy capture of a built-in scene."""
    chosen = find_camera(camera)
    sensor = chosen.sensor.model_copy(update={"binning": binning})
    chosen = chosen.with_shots(shots).model_copy(update={"views": VIEWS, "sensor": sensor})
    return taken(Setup(SCENE, chosen, SIZE, zoom=ZOOM))


def solved(trial: Trial, method: str, settings: MethodSettings | None = None) -> Reconstruction:
    """Return what a method makes of a trial; raises ReconstructionError as it does."""
    psi = trial.psi
    dictionary = None
    if METHODS[method].needs_dictionary:
        dictionary = open_dictionary(None, psi.light_field_shape[:2], psi.binning)
    return reconstruct(
        method, psi, trial.readings, trial.noise_sigma, dictionary, settings, trial.usable
    )


def outcome_of(trial: Trial, method: str, scale: float = 1.0) -> Outcome:
    """Return the outcome of a method, its light field divided by `scale`."""
    try:
        found = np.clip(solved(trial, method).light_field.astype(np.float64) / scale, 0, 1)
    except (ReconstructionError, ModelError) as fault:
        return Outcome(math.nan, str(fault))
    if not np.isfinite(found).all():
        return Outcome(math.nan)
    return Outcome(psnr_db(found, trial.truth))


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
    verdict = SOUND if abs(apart) < SAME_DB / 10 else WEAK
    meaning = "all of Psi and the solver in float64 find the same light field"
    return Finding("TV to its end, float32 less float64", f"{apart:+.4f} dB", verdict, meaning)


def _dimmed(trial: Trial, factor: float) -> Trial:
    weights = trial.psi.weights * np.float32(factor)
    psi = replace(trial.psi, weights=weights)
    readings = trial.readings * np.float32(factor)
    return replace(trial, psi=psi, readings=readings, noise_sigma=trial.noise_sigma * factor)


def _opaque(trial: Trial) -> Trial:
    psi = replace(trial.psi, weights=trial.psi.weights * np.float32(OPAQUE))
    noise = trial.readings - trial.psi.forward(trial.truth)
    return replace(trial, psi=psi, readings=psi.forward(trial.truth) + noise)


def _blind_rows(trial: Trial) -> Trial:
    dark = np.random.default_rng(0).random(trial.psi.size) < 0.05
    weights = np.where(dark[:, None, :], 0, trial.psi.weights).astype(np.float32)
    readings = np.where(dark, 0, trial.readings).astype(np.float32)
    return replace(trial, psi=replace(trial.psi, weights=weights), readings=readings)


def _dark_shot(trial: Trial) -> Trial:
    weights, readings = trial.psi.weights.copy(), trial.readings.copy()
    weights[-1], readings[-1] = 0, 0
    return replace(trial, psi=replace(trial.psi, weights=weights), readings=readings)


def _repeated(trial: Trial) -> Trial:
    psi = trial.psi
    colour = None if psi.colour is None else psi.colour[[0, 0]]
    twice = replace(psi, weights=psi.weights[[0, 0]], colour=colour)
    return replace(trial, psi=twice, readings=trial.readings[[0, 0]], usable=trial.usable[[0, 0]])


@dataclass(frozen=True)
class _Condition:
    """same: whether the outcome should be that of the capture as it was, or may be any that is
    finite and no worse than a card of the mean colour."""

    name: str
    shots: int
    change: Callable[[Trial], Trial]
    same: bool
    meaning: str


CONDITIONS = (
    _Condition(
        "Psi, readings and noise x 1e-6", 1, lambda one: _dimmed(one, 1e-6), True,
        "the units of the readings do not matter",
    ),
    _Condition(
        "Psi, readings and noise x 1e6", 1, lambda one: _dimmed(one, 1e6), True,
        "the units of the readings do not matter",
    ),
    _Condition(
        "nearly opaque mask", 1, _opaque, False,
        "a fiftieth of the light under the same noise: what is seen is hardly more than the noise",
    ),
    _Condition(
        "5 % of the rows are 0", 1, _blind_rows, False, "readings that see nothing, not told",
    ),
    _Condition("a dark shot", 2, _dark_shot, False, "blocks of Psi Psi^T are singular"),
    _Condition(
        "two identical shots", 1, _repeated, True,
        "blocks of Psi Psi^T are singular; the same readings twice tell the same",
    ),
)  # fmt: skip


def card_db(trial: Trial) -> float:
    """Return the PSNR of a card of the scene's mean colour: of knowing next to nothing."""
    mean = trial.truth.mean(axis=(0, 1, 2, 3))
    return psnr_db(np.broadcast_to(mean, trial.truth.shape), trial.truth)


def _told(outcomes: dict[str, Outcome], wanted: dict[str, float], same: bool) -> tuple[str, str]:
    """Return figure and verdict of a condition: the worst over the methods."""
    broken = [name for name, one in outcomes.items() if not one.refused and math.isnan(one.db)]
    refused = [name for name, one in outcomes.items() if one.refused]
    lost = {name: wanted[name] - one.db for name, one in outcomes.items() if math.isfinite(one.db)}
    told = []
    if broken:
        told.append(f"not finite: {', '.join(broken)}")
    if refused:
        told.append(f"refused: {'all' if len(refused) == len(outcomes) else ', '.join(refused)}")
    if lost:
        worst = max(lost, key=lambda name: abs(lost[name]) if same else lost[name])
        if same:
            told.append(f"at most {abs(lost[worst]):.2g} dB apart ({worst})")
        else:
            told.append(f"at least {-lost[worst]:+.1f} dB over a card ({worst})")
    off = [abs(one) if same else one for one in lost.values()]
    most = max(off, default=0.0)
    verdict = SOUND if most <= (SAME_DB if same else 0) else WEAK if most <= FEW_DB else BROKEN
    return "; ".join(told), BROKEN if broken else verdict


def repeats(trial: Trial, methods: Sequence[str]) -> list[Finding]:
    """Every method twice with the same threads; where there are several, once with one thread."""
    differ, threaded = [], {}
    threads = get_num_threads()
    for method in methods:
        first = solved(trial, method)
        if not identical(first, solved(trial, method)):
            differ.append(method)
        if threads == 1:
            continue
        try:
            set_num_threads(1)
            alone = solved(trial, method).light_field
        finally:
            set_num_threads(threads)
        threaded[method] = float(np.abs(alone - first.light_field).max())
    findings = [
        Finding(
            "a second run",
            f"differs: {', '.join(differ)}" if differ else f"bit-identical, {len(methods)} methods",
            BROKEN if differ else SOUND,
            "same readings, seed and threads: the same bits",
        )
    ]
    if threaded:
        worst = max(threaded, key=lambda name: threaded[name])
        findings.append(
            Finding(
                f"1 thread against {threads}",
                f"at most {threaded[worst]:.1g} of full scale ({worst})",
                SOUND if threaded[worst] < 1e-3 else WEAK,
                "sums in another order may round otherwise, no more",
            )
        )
    return findings


def identical(one: Reconstruction, other: Reconstruction) -> bool:
    """Return whether two results agree in every bit of light field and maps."""
    return np.array_equal(one.light_field, other.light_field) and all(
        np.array_equal(one.maps[name], other.maps[name]) for name in one.maps
    )


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
        stopped = found.status != "converged"
        reached = value / objective
        honest = reached < 1.05 or stopped
        findings.append(
            Finding(
                f"TV, primal step x {factor:g}",
                f"objective {reached:.3g} times the usual after {found.steps} steps; "
                f"{found.status}",
                BROKEN if not finite else SOUND if honest else WEAK,
                "stays finite; not converging is told",
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


def _scaled(trial: Trial, factor: float) -> Trial:
    readings = trial.readings * np.float32(factor)
    return replace(trial, readings=readings, noise_sigma=trial.noise_sigma * factor)


def measure_numerics(
    watcher: Watcher, fast: bool = False, every: Sequence[str] = tuple(METHODS)
) -> Numerics:
    """Return every check, on small captures of a built-in scene.

    every: methods run twice; fast: of those, the slow ones are not run under every condition.
    """
    methods = [name for name in every if not (fast and name in SLOW)]
    scales = QUICK_SCALES if fast else SCALES
    watcher.begin("numerical stability", 4 + len(CONDITIONS) + len(scales))
    sensors = [("rgbw-bayer-1shot", 1, 1), ("rgbw-mono", 1, 1), ("rgbw-bayer-1shot", 3, 2)]
    findings = rounding([example(*sensor) for sensor in sensors])
    watcher.step("kernels")
    one, two = example(), example(shots=2)
    findings.append(double_precision(one))
    findings += step_sizes(one)
    watcher.step("step sizes")
    findings += repeats(one, every)
    watcher.step("repeated runs")
    usual = {1: {name: outcome_of(one, name).db for name in methods}}
    watcher.step("methods as they are")
    outcomes = {"as it is": {name: Outcome(usual[1][name]) for name in methods}}
    card = dict.fromkeys(methods, card_db(one))
    for condition in CONDITIONS:
        trial = condition.change(one if condition.shots == 1 else two)
        found = {name: outcome_of(trial, name) for name in methods}
        outcomes[condition.name] = found
        figure, verdict = _told(found, usual[1] if condition.same else card, condition.same)
        findings.append(Finding(condition.name, figure, verdict, condition.meaning))
        watcher.step(condition.name)
    scaled = {}
    for factor in scales:
        trial = _scaled(one, factor)
        scaled[factor] = {name: outcome_of(trial, name, factor) for name in methods}
        figure, verdict = _told(scaled[factor], usual[1], True)
        meaning = "a scene so much dimmer: the same light field, so much dimmer"
        if factor > 1:
            meaning = "a scene so much brighter than white cannot be: to be refused"
        findings.append(Finding(f"readings and noise x {factor:g}", figure, verdict, meaning))
        watcher.step(f"scale {factor:g}")
    return Numerics(findings, outcomes, scaled)

"""Numerical stability: rounding, ill-conditioned Psi, step sizes, the scale of data, repeatability.

Kernels are compared with float64 through SciPy (`rounding`), methods with themselves on the same
capture: what should change nothing must change nothing, what cannot be solved must be refused or
come out finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numba import get_num_threads, set_num_threads

from emmc_rig.pages.drawing import LEGEND, colours_of, save_drawing, sheet, titled
from emmc_rig.pages.page import Section, embedded, fragment
from emmc_rig.progress import Watcher
from emmc_rig.study.stability.rounding import (
    BROKEN,
    SOUND,
    WEAK,
    Attempt,
    Finding,
    attempted,
    double_precision,
    example,
    rounding,
    step_sizes,
)
from emmc_rig.study.trial import Trial
from reconstruction.methods import installed_methods
from reconstruction.result import Reconstruction

OPAQUE = 0.02


def dimmed(trial: Trial, factor: float) -> Trial:
    """Return a capture whose Psi, readings and noise are `factor` times as large."""
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


def scaled(trial: Trial, factor: float) -> Trial:
    """Return a capture whose readings and noise are `factor` times as large, Psi as it was."""
    readings = trial.readings * np.float32(factor)
    return replace(trial, readings=readings, noise_sigma=trial.noise_sigma * factor)


@dataclass(frozen=True)
class Condition:
    """One such capture.

    shots: of the capture that is changed. same: whether the outcome should be that of the capture
    as it was, or may be any that is finite and no worse than a card of the mean colour.
    """

    name: str
    shots: int
    change: Callable[[Trial], Trial]
    same: bool
    meaning: str


CONDITIONS = (
    Condition(
        "Psi, readings and noise x 1e-6", 1, lambda one: dimmed(one, 1e-6), True,
        "the units of the readings do not matter",
    ),
    Condition(
        "Psi, readings and noise x 1e6", 1, lambda one: dimmed(one, 1e6), True,
        "the units of the readings do not matter",
    ),
    Condition(
        "nearly opaque mask", 1, _opaque, False,
        "a fiftieth of the light under the same noise: what is seen is hardly more than the noise",
    ),
    Condition(
        "5 % of the rows are 0", 1, _blind_rows, False, "readings without light, not marked",
    ),
    Condition("a dark shot", 2, _dark_shot, False, "blocks of Psi Psi^T are singular"),
    Condition(
        "two identical shots", 1, _repeated, True,
        "blocks of Psi Psi^T are singular; repeated readings add nothing",
    ),
)  # fmt: skip


SAME_DB, FEW_DB = 0.1, 3.0
SCALES = (1e-6, 1e-3, 1e-1, 1e1, 1e3, 1e6)
QUICK_SCALES = (1e-6, 1e6)
SLOW = ("dict-ista", "dict-fista", "dict-lars", "dict-sl0")


@dataclass(frozen=True)
class Numerics:
    """findings: every check. outcomes: condition -> method -> outcome; scales likewise, by factor,
    of results divided by it."""

    findings: list[Finding]
    outcomes: dict[str, dict[str, Attempt]]
    scales: dict[float, dict[str, Attempt]]


def card_db(trial: Trial) -> float:
    """Return the PSNR of a card of the scene's mean colour, a lower bound for any method."""
    return trial.psnr_db(trial.even)


def condition_verdict(
    outcomes: Mapping[str, Attempt], wanted: Mapping[str, float], same: bool
) -> tuple[str, str]:
    """Return figure and verdict of a condition: the worst over the methods."""
    broken = [name for name, one in outcomes.items() if not one.refused and math.isnan(one.db)]
    refused = [name for name, one in outcomes.items() if one.refused]
    lost = {name: wanted[name] - one.db for name, one in outcomes.items() if math.isfinite(one.db)}
    words = []
    if broken:
        words.append(f"not finite: {', '.join(broken)}")
    if refused:
        words.append(f"refused: {'all' if len(refused) == len(outcomes) else ', '.join(refused)}")
    if lost:
        worst = max(lost, key=lambda name: abs(lost[name]) if same else lost[name])
        if same:
            words.append(f"at most {abs(lost[worst]):.2g} dB apart ({worst})")
        else:
            words.append(f"at least {-lost[worst]:+.1f} dB over a card ({worst})")
    off = [abs(one) if same else one for one in lost.values()]
    most = max(off, default=0.0)
    verdict = SOUND if most <= (SAME_DB if same else 0) else WEAK if most <= FEW_DB else BROKEN
    return "; ".join(words), BROKEN if broken else verdict


def repeats(trial: Trial, methods: Sequence[str]) -> list[Finding]:
    """Every method twice with the same threads; where there are several, once with one thread."""
    differ, threaded = [], {}
    threads = get_num_threads()
    for method in methods:
        first = trial.solved(method)
        if not identical(first, trial.solved(method)):
            differ.append(method)
        if threads == 1:
            continue
        try:
            set_num_threads(1)
            alone = trial.solved(method).light_field
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


def measure_numerics(
    watcher: Watcher, fast: bool = False, every: Sequence[str] | None = None
) -> Numerics:
    """Return every check, on small captures of a built-in scene.

    every: methods run twice (default: all that are installed); fast: of those, the slow ones are
    not run under every condition.
    """
    every = installed_methods() if every is None else every
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
    usual = {name: attempted(one, name).db for name in methods}
    watcher.step("methods as they are")
    outcomes = {"as it is": {name: Attempt(db) for name, db in usual.items()}}
    card = dict.fromkeys(methods, card_db(one))
    for condition in CONDITIONS:
        trial = condition.change(one if condition.shots == 1 else two)
        found = {name: attempted(trial, name) for name in methods}
        outcomes[condition.name] = found
        figure, verdict = condition_verdict(
            found, usual if condition.same else card, condition.same
        )
        findings.append(Finding(condition.name, figure, verdict, condition.meaning))
        watcher.step(condition.name)
    by_scale = {}
    for factor in scales:
        trial = scaled(one, factor)
        by_scale[factor] = {name: attempted(trial, name, factor) for name in methods}
        figure, verdict = condition_verdict(by_scale[factor], usual, True)
        meaning = "a scene so much dimmer: the same light field, so much dimmer"
        if factor > 1:
            meaning = "a scene so much brighter than white cannot be: to be refused"
        findings.append(Finding(f"readings and noise x {factor:g}", figure, verdict, meaning))
        watcher.step(f"scale {factor:g}")
    return Numerics(findings, outcomes, by_scale)


def draw_numerics(found: Numerics, path: Path) -> Path:
    """Write the PSNR of every method by the scale of its data as SVG and PNG."""
    figure, (axes,) = sheet(1, 6.4, 3.2)
    usual = found.outcomes["as it is"]
    for method, colour in colours_of(usual).items():
        levels = {1.0: usual[method]} | {
            scale: outcomes[method] for scale, outcomes in found.scales.items()
        }
        known = sorted((s, one.db) for s, one in levels.items() if math.isfinite(one.db))
        axes.plot(
            [s for s, _ in known], [db for _, db in known], "-o", markersize=3.6,
            color=colour, label=method,
        )  # fmt: skip
    axes.set_xscale("log")
    across = "readings and noise, times what they were (no mark: refused)"
    titled(axes, "The scale of the data", across)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), **LEGEND)
    return save_drawing(figure, path)


def numerics_section(found: Numerics, folder: Path) -> Section:
    """Return the section, its chart written into a folder."""
    picture = draw_numerics(found, folder / "numerics.svg")
    scales = {f"x {scale:g}": outcomes for scale, outcomes in found.scales.items()}
    body = fragment(
        "numerics.html",
        findings=found.findings,
        picture=embedded(picture),
        outcomes={**found.outcomes, **scales},
        methods=list(found.outcomes["as it is"]),
    )
    return Section("numerics", "Numerical stability", body)

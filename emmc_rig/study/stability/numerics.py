"""Numerical stability: rounding, ill-conditioned Psi, step sizes, the data's scale, repeatability.

Kernels are compared with float64 through SciPy (`rounding`), methods with themselves on the same
capture (`conditions`): what should change nothing must change nothing, what cannot be solved must
be refused or come out finite.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads, set_num_threads

from emmc_rig.model.lightfield import psnr_db
from emmc_rig.progress import Watcher
from emmc_rig.study.stability.checks import (
    BROKEN,
    SOUND,
    WEAK,
    Attempt,
    Finding,
    attempted,
    example,
    solved,
)
from emmc_rig.study.stability.conditions import CONDITIONS, scaled
from emmc_rig.study.stability.rounding import double_precision, rounding, step_sizes
from emmc_rig.study.stability.trial import Trial
from reconstruction.methods import installed_methods
from reconstruction.result import Reconstruction

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
    mean = trial.truth.mean(axis=(0, 1, 2, 3))
    return psnr_db(np.broadcast_to(mean, trial.truth.shape), trial.truth)


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

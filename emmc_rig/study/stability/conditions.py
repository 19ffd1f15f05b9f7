"""Ill-conditioned captures: dark masks, rows of zeros, dark and repeated shots, scales."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from emmc_rig.study.stability.trial import Trial

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

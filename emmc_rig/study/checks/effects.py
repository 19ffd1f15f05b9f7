"""Every effect of a real bench, alone and all together: the error of Psi, true and as stated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from emmc_rig.calibrate.bench import BenchTruth
from emmc_rig.calibrate.settings import CalibrateSettings
from emmc_rig.calibrate.simulated import run_calibration
from emmc_rig.study.checks.rows import COVERED, COVERED_TWICE, Row, covered, target_row
from simulators.effects import EFFECTS, ORDINARY, TOGETHER, flawed

TRUE_ERROR = 0.01


def effects(shipped: BenchTruth) -> Mapping[str, BenchTruth]:
    """Return benches by what is wrong with them beside what is wrong with every one."""
    named = [name for name in (*EFFECTS, TOGETHER) if name != ORDINARY]
    return {"shipped": shipped, **{name: flawed(shipped, [name]) for name in named}}


def check_effect(settings: CalibrateSettings, name: str) -> tuple[list[Row], dict]:
    """One effect: true and stated error, and the coefficients within one and two deviations."""
    truth = effects(settings.truth)[name]
    metrics = run_calibration(replace(settings, route="auto", truth=truth)).metrics
    chosen = metrics["chosen"]
    true, stated = (metrics[key][chosen] for key in ("psi_relative_error", "psi_stated_error"))
    once, twice = metrics["psi_coverage"][chosen]
    rows = [
        target_row(f"{name}: true error of Psi ({chosen}, states {stated:.2%})", true, TRUE_ERROR,
               ".2%"),
        covered(f"{name}: within one deviation", once, COVERED),
        covered(f"{name}: within two", twice, COVERED_TWICE),
    ]  # fmt: skip
    return rows, {key: metrics[key] for key in KEPT}


KEPT = (
    "chosen",
    "why",
    "findings",
    "advice",
    "unwatched",
    "held_out",
    "psi_relative_error",
    "psi_stated_error",
    "psi_coverage",
)

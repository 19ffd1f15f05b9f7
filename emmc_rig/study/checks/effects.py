"""Every effect of a real bench, alone and all together: the error of Psi, true and as stated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import emmc_rig as emmc
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.processing.bench import BenchTruth
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.processing.simulated import run_calibration
from emmc_rig.study.checks.rows import COVERED, COVERED_TWICE, Row, covered, target_row
from emmc_rig.study.checks.scenes import BUILT_IN, captured_scene
from simulators.effects import EFFECTS, ORDINARY, TOGETHER, flawed

Array = NDArray[np.floating]
TRUE_ERROR = 0.01
LARGEST_COST_DB = 0.05


def effects(shipped: BenchTruth) -> Mapping[str, BenchTruth]:
    """Return benches by what is wrong with them beside what is wrong with every one."""
    named = [name for name in (*EFFECTS, TOGETHER) if name != ORDINARY]
    return {"shipped": shipped, **{name: flawed(shipped, [name]) for name in named}}


def check_effect(settings: CalibrateSettings, name: str) -> tuple[list[Row], dict]:
    """One effect: true and stated error, and the coefficients within one and two deviations."""
    truth = effects(settings.truth)[name]
    run = run_calibration(replace(settings, route="auto", truth=truth))
    metrics = run.metrics
    chosen = metrics["chosen"]
    true, stated = (metrics[key][chosen] for key in ("psi_relative_error", "psi_stated_error"))
    once, twice = metrics["psi_coverage"][chosen]
    rows = [
        target_row(f"{name}: true error of Psi ({chosen}, states {stated:.2%})", true, TRUE_ERROR,
               ".2%"),
        covered(f"{name}: within one deviation", once, COVERED),
        covered(f"{name}: within two", twice, COVERED_TWICE),
    ]  # fmt: skip
    detail = {key: metrics[key] for key in KEPT}
    if settings.psnr:
        captured = captured_scene(BUILT_IN[1], settings.camera, truth, settings.seed, settings.size)
        known = run.outcome.calibration
        readings, _, usable, sigma = captured.read(known)
        true = run.bench.true_psi()
        detail["cost_db"] = cost_db = psnr_cost_db(
            known.psi, true, readings, sigma, usable, captured.truth
        )
        rows.append(target_row(f"{name}: cost in PSNR, dB", cost_db, LARGEST_COST_DB, ".3f"))
    return rows, detail


def psnr_cost_db(
    psi: ImagingMatrix,
    true: Array,
    readings: Array,
    noise_sigma: float,
    usable: NDArray[np.bool_],
    scene: Array,
) -> float:
    """Return what a measured Psi costs the default method against the bench's own, in dB.

    true: Psi's coefficients in three colours. readings, usable: (shot, pixel_y, pixel_x). scene:
    the light field that was captured.
    """
    exact = replace(psi, weights=true.astype(np.float32), colour=None)
    of_exact, of_known = (
        psnr_db(
            emmc.reconstruct(one, readings, noise_sigma=noise_sigma, usable=usable).light_field,
            scene,
        )
        for one in (exact, psi)
    )
    return of_exact - of_known


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

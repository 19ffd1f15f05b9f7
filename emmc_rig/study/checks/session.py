"""Every effect of a bench together, from a session: planned, captured by the rig, calibrated."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import emmc_rig as emmc
from emmc_rig.bench.hardware import NO_FLAWS
from emmc_rig.bench.rig_config import APERTURE_FACTOR, PIXEL_FACTOR
from emmc_rig.files.scenes import fine_scene
from emmc_rig.processing.bench import BenchTruth, WhiteboardBench
from emmc_rig.processing.board_plan import PLAN, write_plan
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.processing.comparison import coverage, stated_error, true_error
from emmc_rig.session.readings import session_readings
from emmc_rig.study.checks.bench import STATED_TRUE
from emmc_rig.study.checks.effects import LARGEST_COST_DB, TRUE_ERROR, psnr_cost_db
from emmc_rig.study.checks.rows import Row, target_row
from emmc_rig.study.checks.scenes import BUILT_IN
from simulators.effects import TOGETHER, flawed

SESSION_SIZE, SESSION_RAYS = (48, 64), 1024
"""Of the rig: as large as a session of 120 frames is traced in minutes."""
SCENE = BUILT_IN[1]


def check_session(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """All effects together on the simulated rig: error of Psi by `calibrate SESSION`, in dB too."""
    rows, columns = (min(pair) for pair in zip(settings.size, SESSION_SIZE, strict=True))
    wanted = replace(settings, size=(rows, columns))
    rig = emmc.rig(
        "simulated",
        scene=SCENE,
        size=wanted.size,
        seed=wanted.seed,
        rays=SESSION_RAYS,
        flaws=(TOGETHER,),
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        planned = write_plan(wanted, folder)
        session = emmc.capture(folder / PLAN, rig, out=folder / "session")
        found = emmc.calibrate(session)
        seen = session_readings(session)
    flaws = flawed(NO_FLAWS, [TOGETHER])
    truth = BenchTruth(
        flaws.mounting, flaws.optics, flaws.sensor, flaws.board, flaws.lamp, SESSION_RAYS
    )
    true = WhiteboardBench(wanted.camera, wanted.size, truth, wanted.seed).true_psi()
    known, good = found.calibration, found.outcome.good
    error, stated = true_error(known.psi, true, good), stated_error(known, good)
    once, twice = coverage(known, true, good)
    views = wanted.camera.views
    fine = fine_scene(
        SCENE, APERTURE_FACTOR, PIXEL_FACTOR, size=wanted.size, views=views, seed=wanted.seed
    )
    scene = fine.scene.light_field
    cost_db = psnr_cost_db(known.psi, true, seen.readings, seen.noise_sigma, seen.usable, scene)
    label = f"session, all effects together, {planned['frames']} frames"
    within = min(STATED_TRUE * stated, TRUE_ERROR)
    measured = [
        target_row(f"{label}: true error of Psi (states {stated:.2%})", error, within, ".2%"),
        Row("session: within one, within two deviations", f"{once:.1%}, {twice:.1%}"),
        target_row("session: cost in PSNR, dB", cost_db, LARGEST_COST_DB, ".3f"),
    ]
    detail = {
        **{key: found.metrics[key] for key in ("chosen", "findings", "advice", "unwatched")},
        "psi_relative_error": error,
        "psi_stated_error": stated,
        "psi_coverage": [once, twice],
        "cost_db": cost_db,
    }
    return measured, detail

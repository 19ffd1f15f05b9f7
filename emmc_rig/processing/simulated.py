"""Calibration of the simulated bench, whose truth is known."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.boards import BoardSet, as_readings
from calibration.parametric import Parametric
from calibration.planning import (
    PlannedFrames,
)
from calibration.routes import Outcome, calibrate
from calibration.sensor import SensorSheet, characterise
from calibration.shadow import shadow_mask
from calibration.stage_map import StageMap, locate, stage_map
from calibration.whiteboard import lamps_needed
from emmc_rig.errors import AppError
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.pages.calibration_page import write_calibration_report
from emmc_rig.processing.bench import Setting, WhiteboardBench
from emmc_rig.processing.board_plan import (
    few_plan,
    few_settings,
    free_settings,
    held_out_settings,
    parametric_plan,
    plan_light,
)
from emmc_rig.processing.calibration_settings import ROUTES, CalibrateSettings
from emmc_rig.processing.comparison import coverage, stated_error, true_error, true_parameters
from emmc_rig.processing.stored import REPORT, outcome_figures, save_outcome
from emmc_rig.progress import Silent, Watcher

FREE_REPEATS = 2
BOARD_TURN_DEG = 90.0
STAGE_PLACES, STAGE_REACH_UM = 16, 220.0


@dataclass(frozen=True, eq=False)
class Run:
    """A calibration of the simulated bench, with everything that the report shows."""

    settings: CalibrateSettings
    bench: WhiteboardBench
    outcome: Outcome
    few: BoardSet | None
    held_out: BoardSet
    planned: PlannedFrames | None
    metrics: dict
    sensor: SensorSheet
    stage: StageMap | None


@one_blas_thread()
def run_calibration(settings: CalibrateSettings, watcher: Watcher | None = None) -> Run:
    """Capture the whiteboards that the route needs from the simulated bench, and calibrate."""
    watcher = watcher or Silent()
    if settings.route not in ROUTES:
        raise AppError(f"--route {settings.route}: use one of {', '.join(ROUTES)}")
    # Few whiteboards do not open every view.
    few_alone = settings.few and settings.route == "auto"
    routes = ROUTES["mixed" if few_alone else settings.route]
    camera = settings.camera
    watcher.begin("design", None)
    design = build_imaging_matrix(camera, settings.size)
    bench = WhiteboardBench(camera, settings.size, settings.truth, settings.seed)
    lamps = lamps_needed(design)
    few = pinholes = planned = None
    started = time.perf_counter()
    fitted: list[Setting] = []
    if "parametric" in routes:
        mask = shadow_mask(camera, settings.size)
        light = plan_light(bench, mask)
        if settings.few:
            planned = few_plan(settings, mask, light)
        else:
            planned = parametric_plan(camera, mask, light, settings.target)
        fitted = few_settings(planned)
    through: list[Setting] = []
    if "free" in routes:
        through = free_settings(camera, lamps, FREE_REPEATS)
        fitted = [one for one in fitted if one.pinhole is None]
    judges = held_out_settings(camera)[: 2 if "parametric" in routes else 1]
    watcher.begin("whiteboards", len(fitted) + len(through) + len(judges))
    every = [*fitted, *through, *judges]
    boards = bench.capture(every, watcher.step, settings.leave_out)
    first, last = len(fitted), len(fitted) + len(through)
    held_out = boards.with_frames(boards.frames[last:])
    if "free" in routes:
        pinholes = boards.with_frames(boards.frames[first:last])
    if "parametric" in routes:
        few = boards.with_frames([one for one in boards.frames[:last] if one.shot == 0])
    turned = {}
    if "combined" in routes and "turned" not in settings.leave_out:
        watcher.begin("whiteboards, the board turned", 1)
        turned[BOARD_TURN_DEG] = bench.capture(
            [Setting(lamp=lamps[0], repeats=4, board_turn_deg=BOARD_TURN_DEG)], watcher.step
        )
    captured_s = time.perf_counter() - started
    started = time.perf_counter()
    outcome = calibrate(
        camera,
        design,
        routes,
        held_out,
        few,
        pinholes,
        settings.fit,
        on_stage=lambda name: watcher.begin(name, None),
        turned=turned,
    )
    calibrated_s = time.perf_counter() - started
    watcher.begin("sensor", None)
    sensor = characterise(*bench.sensor_pairs(), camera.sensor.noise.white_level_dn)
    stage = None
    best = outcome.mixed or outcome.parametric
    if settings.map_stage:
        if best is None:
            raise AppError("--stage needs a parametric route: leave --route at auto")
        stage = measured_stage(bench, design, best, watcher)
    watcher.begin("the true Psi, for comparison", None)
    true = bench.true_psi()
    errors = {
        name: true_error(one.psi, true, outcome.good) for name, one in outcome.calibrations.items()
    }
    metrics = {
        "camera": settings.camera_name,
        "size": list(settings.size),
        "route": settings.route,
        **outcome_figures(outcome),
        "psi_relative_error": errors,
        "psi_stated_error": {
            name: stated_error(one, outcome.good) for name, one in outcome.calibrations.items()
        },
        "psi_coverage": {
            name: coverage(one, true, outcome.good) for name, one in outcome.calibrations.items()
        },
        "design_relative_error": true_error(design, true, outcome.good),
        "held_out_frames": held_out.exposures,
        "sensor": {name: value for name, value, _, _ in sensor.rows()},
        "stage": None if stage is None else {name: value for name, value, _, _ in stage.rows()},
        "capture_seconds": captured_s,
        "calibration_seconds": calibrated_s,
        "seed": settings.seed,
        "command": command_line(),
        "versions": versions(),
    }
    return Run(settings, bench, outcome, few, held_out, planned, metrics, sensor, stage)


def measured_stage(
    bench: WhiteboardBench, design: ImagingMatrix, known: Parametric, watcher: Watcher
) -> StageMap:
    """Move the mask stage about, from both sides, with a whiteboard each; return its map."""
    if not bench.camera.moving_masks:
        raise AppError("--stage: no mask of this camera moves")
    rng = np.random.default_rng(bench.seed)
    reach = STAGE_REACH_UM
    places_um = rng.uniform(-reach, reach, (STAGE_PLACES, 2))
    # Every pair of sides equally often.
    wanted = [
        Setting(
            stage_um=(float(x), float(y)),
            repeats=1,
            came_from=(1 - 2 * (k % 2), 1 - 2 * (k // 2 % 2)),
        )
        for k, (x, y) in enumerate(places_um)
    ]
    watcher.begin("whiteboards for the stage map", len(wanted))
    boards = as_readings(bench.capture(wanted, watcher.step), design.layout)
    places = [locate(board, known.shadow.mask, known.fit.placement) for board in boards]
    return stage_map([one.stage_um for one in wanted], [one.came_from for one in wanted], places)


def run_calibrate(
    settings: CalibrateSettings, folder: Path, watcher: Watcher | None = None
) -> dict:
    """Calibrate the simulated bench into an existing folder and return the metrics.

    Writes psi.h5, calibration.h5, metrics.json and report.html.
    """
    run = run_calibration(settings, watcher)
    save_outcome(folder, run.outcome, run.outcome.calibration)
    write_calibration_report(
        folder / REPORT,
        run.outcome,
        run.metrics,
        true_parameters(settings.truth),
        run.sensor,
        run.stage,
    )
    write_metrics(folder, run.metrics)
    return run.metrics

"""Effect of the calibration on reconstructions: cost in dB, frames, drifts and false alarms.

Scenes are captured ray by ray through the same bench as the whiteboards.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.drift import Captures, Drift, displacement_px, drifted, find_drift
from calibration.parametric import psi_at, shot_stages
from calibration.residuals import ResidualCheck, check_residuals
from calibration.routes import calibrate
from calibration.shadow import Shadow, shadow_mask
from calibration.whiteboard import Calibration
from emmc_rig.files.scenes import fine_scene
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.processing.bench import (
    BenchTruth,
    WhiteboardBench,
)
from emmc_rig.processing.board_plan import (
    few_settings,
    free_settings,
    held_out_settings,
    parametric_plan,
    plan_light,
)
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.study.checks.rows import Row, target_row
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]
REAL_SCENES = ("dragons", "buttercup", "antinous")
BUILT_IN = ("deep-occlusions", "near-planar", "non-lambertian")
SCENE_SIZE = (96, 128)
DRIFTS = {
    "shift of 0.5 px": (8.5, -8.5, 0.0, 0.0, 0.0),
    "rotation of 0.1 degrees": (0.0, 0.0, float(np.deg2rad(0.1)), 0.0, 0.0),
    "distance error of 2 %": (0.0, 0.0, 0.0, 0.0, 0.02),
    "all of them": (8.5, -8.5, float(np.deg2rad(0.1)), 0.0, 0.02),
}
DRIFT_SCENES = 2
FRAME_TARGETS = (0.06, 0.04, 0.025, 0.015, 0.01, 0.005)
SAME_DB = 0.05
ALARM_RUNS = 20


def scenes() -> list[str]:
    """Return three scenes: real ones where EMMC_LIGHTFIELDS has them, else built-in ones."""
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    real = [str(Path(folder) / name) for name in REAL_SCENES] if folder else []
    return real if real and all(Path(one).is_dir() for one in real) else list(BUILT_IN)


@dataclass(frozen=True, eq=False)
class _Captured:
    """A scene captured on a bench, and what it is compared with."""

    bench: WhiteboardBench
    truth: Array
    frames_dn: NDArray[np.uint16]
    exposures_s: Array

    def read(self, calibration: Calibration) -> tuple[Array, Array, NDArray[np.bool_], float]:
        """Return readings, their variance, what is usable, and the deviation of all together."""
        given = self.frames_dn, self.exposures_s
        white = self.bench.camera.sensor.noise.white_level_dn
        usable = calibration.usable(self.frames_dn, white)
        variance = calibration.reading_variance(*given)
        return calibration.readings(*given), variance, usable, float(variance[usable].mean() ** 0.5)


def captured_scene(
    spec: str, camera: Camera, truth: BenchTruth, seed: int, size: tuple[int, int] = SCENE_SIZE
) -> _Captured:
    """Return a scene captured on a bench; spec: a built-in scene or a folder."""
    fine = fine_scene(spec, 1, 2, size=size, views=camera.views)
    bench = WhiteboardBench(camera, size, truth, seed, fine.samples)
    frames, exposures_s = bench.capture_scene()
    return _Captured(bench, fine.scene.light_field, frames, exposures_s)


def _psnr(psi: ImagingMatrix, calibration: Calibration, captured: _Captured) -> float:
    return _reconstructed(psi, calibration, captured)[0]


def _reconstructed(
    psi: ImagingMatrix, calibration: Calibration, captured: _Captured
) -> tuple[float, ResidualCheck]:
    """Return the PSNR of a TV reconstruction, and what its residuals look like."""
    readings, variance, usable, sigma = captured.read(calibration)
    result = reconstruct_tv(psi, readings, sigma, TVSettings(), usable)
    residual = readings - psi.forward(result.light_field)
    return psnr_db(result.light_field, captured.truth), check_residuals(residual, variance, usable)


def _calibrated(settings: CalibrateSettings, target: float):
    """Return the outcome of the parametric routes on the bench as it stands, and the frames."""
    camera = settings.camera
    mask = shadow_mask(camera, SCENE_SIZE)
    bench = WhiteboardBench(camera, SCENE_SIZE, settings.truth, settings.seed)
    design = build_imaging_matrix(camera, SCENE_SIZE)
    planned = parametric_plan(camera, mask, plan_light(bench, mask), target)
    few = bench.capture(few_settings(planned))
    held_out = bench.capture(held_out_settings(camera))
    outcome = calibrate(camera, design, ("parametric", "mixed"), held_out, few)
    return bench, design, outcome, few


def check_cost(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """What the measured Psi costs a TV reconstruction, against the bench's own Psi."""
    bench, design, outcome, few = _calibrated(settings, settings.target)
    exact = bench.exact_psi(design)
    rows: list[Row] = []
    detail: dict[str, object] = {"frames": few.exposures}
    for spec in scenes():
        captured = captured_scene(spec, settings.camera, settings.truth, settings.seed + 1)
        calibration = outcome.calibrations["mixed"]
        with_exact = _psnr(exact, calibration, captured)
        costs = {
            name: with_exact - _psnr(one.psi, one, captured)
            for name, one in outcome.calibrations.items()
        }
        costs["design"] = with_exact - _psnr(design, calibration, captured)
        name = Path(spec).name
        detail[name] = {"exact_psnr_db": with_exact, **costs}
        for what, limit, form in (
            ("parametric Psi", 0.3, ".3f"), ("mixed Psi", 0.3, ".3f"), ("design", None, ".2f")
        ):  # fmt: skip
            cost_db = costs[what.removesuffix(" Psi")]
            rows.append(target_row(f"{name}: cost of the {what}, dB", cost_db, limit, form))
    return rows, detail


def check_frames(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """Fewest frames with which the parametric routes reach the free route's reconstruction."""
    camera = settings.camera
    bench = WhiteboardBench(camera, SCENE_SIZE, settings.truth, settings.seed)
    design = build_imaging_matrix(camera, SCENE_SIZE)
    mask = shadow_mask(camera, SCENE_SIZE)
    held_out = bench.capture(held_out_settings(camera))
    free_boards = bench.capture(free_settings(camera, ("white",), 1))
    free = calibrate(camera, design, ("free",), held_out, pinholes=free_boards).calibration
    spec = scenes()[0]
    captured = captured_scene(spec, camera, settings.truth, settings.seed + 1)
    reached = _psnr(free.psi, free, captured)
    detail: dict[str, object] = {"free": {"psnr_db": reached, "frames": free_boards.exposures}}
    rows = [
        Row(
            f"free route, one frame a view: {free_boards.exposures} frames, "
            f"{len(free_boards.frames)} of them whiteboards",
            f"{reached:.2f} dB on {Path(spec).name}",
        )
    ]
    for target in FRAME_TARGETS:
        planned = parametric_plan(camera, mask, plan_light(bench, mask), target)
        few = bench.capture(few_settings(planned))
        outcome = calibrate(camera, design, ("parametric", "mixed"), held_out, few)
        db = _psnr(outcome.calibration.psi, outcome.calibration, captured)
        boards = sum(one.frame.count for one in few.frames)
        detail[f"{target}"] = {
            "psnr_db": db, "frames": few.exposures, "whiteboards": boards, "route": outcome.chosen,
        }  # fmt: skip
        rows.append(
            Row(
                f"plan for {target:.1%}: {few.exposures} frames, {boards} of them whiteboards",
                f"{db:.2f} dB by {outcome.chosen}",
            )
        )
        if db > reached - SAME_DB:
            for what, times in (
                ("whiteboards", len(free_boards.frames) / boards),
                ("all frames", free_boards.exposures / few.exposures),
            ):
                named = f"{what}, free over parametric"
                rows.append(target_row(named, times, 5.0, ".1f", above=True))
            break
    else:
        rows.append(Row("the parametric routes do not reach it", "-", "at least 5.0", "missed"))
    return rows, detail


def _drift_of(
    calibration: Calibration, shadow: Shadow, captured: _Captured, design: ImagingMatrix
) -> Drift:
    readings, variance, usable, _ = captured.read(calibration)
    colour, k = design.colour, design.binning
    taken = Captures(readings, variance, usable, None if colour is None else colour[:, ::k, ::k])
    stages = shot_stages(captured.bench.camera)
    return find_drift(taken, shadow.mask, shadow.placement, stages)


def moved_truth(truth: BenchTruth, drift: tuple[float, ...]) -> BenchTruth:
    """Return the bench after a drift, in the order of `calibration.drift.KINDS`."""
    mounting = truth.mounting
    x, y = mounting.offset_um
    return replace(
        truth,
        mounting=replace(
            mounting,
            offset_um=(x + drift[0], y + drift[1]),
            rotation_deg=mounting.rotation_deg + float(np.degrees(drift[2])),
            stretch=mounting.stretch + drift[3],
            distance_share=mounting.distance_share + drift[4],
        ),
    )


def check_drift(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """Ideal, mismatched, oracle-corrected and blind-corrected Psi after drifts, by PSNR."""
    camera = settings.camera
    _, design, outcome, _ = _calibrated(settings, settings.target)
    calibration = outcome.calibrations["mixed"]
    assert outcome.mixed is not None
    shadow = outcome.mixed.shadow
    stages = shot_stages(camera)
    rows, detail = [], {}
    for what, drift in DRIFTS.items():
        truth = moved_truth(settings.truth, drift)
        gained = lost = 0.0
        exact = WhiteboardBench(camera, SCENE_SIZE, truth).exact_psi(design)
        for spec in scenes()[:DRIFT_SCENES]:
            captured = captured_scene(spec, camera, truth, settings.seed + 2)
            found = _drift_of(calibration, shadow, captured, design)
            oracle = drifted(shadow.placement, np.array(drift))
            matrices = {
                "ideal": exact,
                "mismatched": calibration.psi,
                "oracle": psi_at(Shadow(shadow.mask, oracle), design.layout, stages),
                "blind": psi_at(Shadow(shadow.mask, found.placement), design.layout, stages),
            }
            done = {
                kind: _reconstructed(psi, calibration, captured) for kind, psi in matrices.items()
            }
            db = {kind: one[0] for kind, one in done.items()}
            left = np.array(list(found.values.values()))[: len(drift)] - np.array(drift)
            left_px = displacement_px(shadow.mask, shadow.placement, left)
            name = Path(spec).name
            detail[f"{what}, {name}"] = {
                **db,
                "residuals": {kind: asdict(one[1]) for kind, one in done.items()},
                "found": found.values,
                "drifted": found.drifted,
                "left_px": left_px,
            }
            lost += db["oracle"] - db["mismatched"]
            gained += db["blind"] - db["mismatched"]
            rows.append(
                Row(
                    f"{what}, {name}: ideal / mismatched / oracle / blind",
                    " / ".join(f"{value:.2f}" for value in db.values())
                    + f" dB; left {left_px:.3f} px; "
                    + ("drift detected" if found.drifted else "no drift detected"),
                )
            )
        if lost > 0.05:
            share = gained / lost
            rows.append(target_row(f"{what}: lost dB recovered", share, 0.85, ".0%", above=True))
        else:
            rows.append(Row(f"{what}: loss below 0.05 dB", f"{lost:.3f} dB in all"))
    return rows, detail


def check_alarms(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """False alarms: captures of many scenes through a bench that has not moved."""
    camera = settings.camera
    _, design, outcome, _ = _calibrated(settings, settings.target)
    assert outcome.mixed is not None
    calibration, shadow = outcome.calibrations["mixed"], outcome.mixed.shadow
    found = []
    known = [*scenes(), *(name for name in BUILT_IN if name not in scenes())]
    for run in range(ALARM_RUNS):
        spec = known[run % len(known)]
        captured = captured_scene(spec, camera, settings.truth, settings.seed + 10 + run)
        drift = _drift_of(calibration, shadow, captured, design)
        found.append((Path(spec).name, drift.drifted, drift.displacement_px, drift.chi2))
    alarms = sum(one[1] for one in found)
    largest = max(one[2] for one in found)
    rows = [
        target_row("false alarms on a Psi that fits", alarms / len(found), 0.01, ".1%"),
        Row("largest displacement found there, px", f"{largest:.3f} in {len(found)} captures"),
    ]
    return rows, {"captures": found}

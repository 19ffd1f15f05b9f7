"""Sessions of the simulated rig, calibrated and compared with the Psi of its own rays."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.bench.hardware import ALL_FITTED, Fitted, Rig, simulated_rig
from emmc_rig.calibration.shadow import shadow_mask
from emmc_rig.calibration.whiteboard import Calibration
from emmc_rig.captures.board_plan import (
    PlanSettings,
    capture_plan,
    combined_plan,
    few_plan,
    plan_light,
)
from emmc_rig.captures.by_hand import with_hands
from emmc_rig.captures.expand import expand, mask_offsets_um
from emmc_rig.captures.plan import Plan
from emmc_rig.captures.run import CaptureRequest, planned_frames
from emmc_rig.demo import simulated_session
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.sensing import Psi
from emmc_rig.process.calibrating import calibrate
from emmc_rig.process.session_calibration import SessionCalibration
from emmc_rig.progress import Watcher
from emmc_rig.simulators.bench import Bench
from emmc_rig.simulators.effects import ORDINARY, Flaws, flawed

Array = NDArray[np.floating]
PINHOLE_REPEATS = 2
GREY = 0.5
"""Of the scene that a calibration's shots show."""


ORDINARY_BENCH = flawed(Flaws(), [ORDINARY])


@dataclass(frozen=True)
class CalibrateSettings(PlanSettings):
    """What to plan for, and the simulated bench: what is wrong with it, rays per view and pixel.

    route: of `emmc_rig.calibrate`. fitted: what of the bench is; hands move what it lacks.
    """

    route: str = "auto"
    seed: int = 0
    flaws: Flaws = ORDINARY_BENCH
    rays: int = 512
    fitted: Fitted = ALL_FITTED


def place_masks(rig: Rig, camera: Camera, shot: int) -> None:
    """Bring the masks on the stage to where a shot has them."""
    offsets_um = mask_offsets_um(camera, shot)
    if offsets_um:
        rig.stage.move_to_um({axis: rig.zero_um[axis] + um for axis, um in offsets_um.items()})


def true_psi(camera: Camera, rig: Rig, bench: Bench) -> NDArray[np.float32]:
    """Return `Bench.true_psi` of every shot, (shot, v, u, y, colour, x)."""
    found = []
    for shot in range(len(camera.shots)):
        place_masks(rig, camera, shot)
        found.append(bench.true_psi(shot))
    return np.stack(found)


def in_three_colours(values: Array, psi: Psi) -> NDArray[np.float32]:
    """Return values shaped as Psi's weights for all three colours: 0 where it stores none."""
    if psi.colour is None:
        return np.asarray(values, dtype=np.float32)
    own = np.arange(3)[:, None] == psi.colour[:, None, None, :, None, :]
    return np.where(own, values, 0).astype(np.float32)


def _of_good(psi: Psi, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return good.repeat(psi.binning, axis=0).repeat(psi.binning, axis=1)[:, None, :]


def true_error(psi: Psi, true: Array, good: NDArray[np.bool_]) -> float:
    """Return |Psi - true| / |true| in three colours over the good pixels, Frobenius.

    true: (shot, v, u, y, colour, x). A colour that Psi does not store counts as 0.
    """
    chosen = _of_good(psi, good)
    off = np.where(chosen, in_three_colours(psi.weights, psi) - true, 0)
    return float(np.linalg.norm(off) / np.linalg.norm(np.where(chosen, true, 0)))


def stated_error(known: Calibration, good: NDArray[np.bool_]) -> float:
    """Return the relative error of Psi that a calibration states, as `true_error`."""
    chosen = _of_good(known.psi, good)
    off = np.where(chosen, known.deviation, 0)
    return float(np.linalg.norm(off) / np.linalg.norm(np.where(chosen, known.psi.weights, 0)))


def coverage(known: Calibration, true: Array, good: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the share of true coefficients within one and two stated deviations.

    Coefficients that are 0 in truth and in Psi do not count.
    """
    psi = known.psi
    chosen = np.broadcast_to(_of_good(psi, good), true.shape)
    off = np.abs(in_three_colours(psi.weights, psi) - true)
    stated = in_three_colours(known.deviation, psi)
    counted = chosen & ((true != 0) | (stated != 0))
    within = [float((off <= k * stated)[counted].mean()) for k in (1, 2)]
    return within[0], within[1]


def true_parameters(flaws: Flaws) -> dict[str, float]:
    """Return the scalars of the placement that a simulated bench really has, where comparable.

    Its vignetting and falloff follow another law.
    """
    mounting, optics = flaws.mounting, flaws.optics
    return {
        "offset_x_um": mounting.offset_um[0],
        "offset_y_um": mounting.offset_um[1],
        "rotation_rad": float(np.deg2rad(mounting.rotation_deg)),
        "scale": mounting.stretch,
        "skew": mounting.skew,
        "distance_share": mounting.distance_share,
        "distortion_um": mounting.distortion_um,
        "blur_um": mounting.edge_blur_um,
        "clear": optics.clear,
        "leak": optics.leak,
    }


@dataclass(frozen=True, eq=False)
class SimulatedCalibration:
    """A calibration of the simulated rig and the coefficients that its rays integrate to.

    true: (shot, v, u, y, colour, x).
    """

    found: SessionCalibration
    true: NDArray[np.float32]


def rig_to_calibrate(settings: CalibrateSettings, scene: Array | None = None) -> tuple[Rig, Bench]:
    """Return the simulated rig, homed; scene: see `simulated_rig` (default: grey)."""
    rows, columns = settings.size
    if scene is None:
        scene = np.full((*settings.camera.views, rows, columns, 3), GREY, np.float32)
    rig, bench = simulated_rig(
        settings.camera,
        np.asarray(scene, np.float32),
        settings.size,
        settings.seed,
        rays_per_view=settings.rays,
        flaws=settings.flaws,
        fitted=settings.fitted,
    )
    rig.stage.home()
    return rig, bench


def simulated_plan(settings: CalibrateSettings) -> Plan:
    """Return the plan of `write_plan`, with the pinhole before the views of every shot.

    Raises AppError where the target cannot be reached.
    """
    mask = shadow_mask(settings.camera, settings.size)
    light = plan_light(settings.camera, mask)
    planned = (few_plan if settings.few else combined_plan)(settings, mask, light)
    plan = capture_plan(settings, planned)
    assert plan.whiteboards is not None
    # As bright as planned for: a metering frame shows hot pixels, too.
    changes: dict[str, Any] = {"exposure_s": light.exposure_s}
    if not settings.few:
        repeats = max(plan.whiteboards.repeats, PINHOLE_REPEATS)
        changes |= {"shots": "all", "repeats": repeats}
    boards = plan.whiteboards.model_copy(update=changes)
    return plan.model_copy(update={"whiteboards": boards})


def calibrate_simulated(
    settings: CalibrateSettings, watcher: Watcher | None = None
) -> SimulatedCalibration:
    """Plan, capture and calibrate a session of the simulated rig, and compare it with the truth.

    Raises AppError or CalibrationError.
    """
    watcher = watcher or Watcher()
    camera, route = settings.camera, settings.route
    watcher.begin("plan", None)
    plan = simulated_plan(settings)
    rig, bench = rig_to_calibrate(settings)
    rig = with_hands(rig, expand(plan, camera, rig.window_um, rig.window_side_um))
    frames = planned_frames(CaptureRequest(Path(), plan, "", camera, Path(), {}), rig)
    watcher.begin("whiteboards", len(frames))
    started = time.perf_counter()
    # What a sensor is takes its response.
    sensor = "response" not in settings.skip
    with simulated_session(plan, camera, rig, watcher) as session:
        captured_s = time.perf_counter() - started
        found = calibrate(session, method=route, sensor=sensor, watcher=watcher)
        held_out = sum(frame.kind == "held-out" for frame in session.frames)
    watcher.begin("the true Psi, for comparison", None)
    true = true_psi(camera, rig, bench)
    outcome = found.outcome
    known, good = outcome.calibrations, outcome.good
    design = build_imaging_matrix(camera, settings.size)
    metrics = {
        **found.metrics,
        "camera": settings.camera_name,
        "psi_relative_error": {k: true_error(v.psi, true, good) for k, v in known.items()},
        "psi_stated_error": {k: stated_error(v, good) for k, v in known.items()},
        "psi_coverage": {k: coverage(v, true, good) for k, v in known.items()},
        "design_relative_error": true_error(design, true, good),
        "held_out_frames": held_out,
        "capture_seconds": captured_s,
        "seed": settings.seed,
    }
    return SimulatedCalibration(replace(found, metrics=metrics), true)

"""`emmc-rig calibrate`: whiteboards to Psi, with the choice of route told.

They come from a session that `capture` took, or from a simulated bench whose truth is known.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

from calibration.boards import BoardSet, as_readings
from calibration.fit import FitSettings
from calibration.placement import SCALARS, Placement, designed_placement, labels
from calibration.planning import (
    MODEL_ERROR,
    MOST_FRAMES,
    REFERENCE_FRAMES,
    Kind,
    Light,
    PlannedFrames,
    free_noise,
    plan_free,
    plan_parametric,
)
from calibration.routes import Outcome, Parametric, calibrate
from calibration.sensor import SensorSheet, characterise
from calibration.shadow import ShadowMask, shadow_mask
from calibration.stage_map import StageMap, locate, stage_map
from calibration.whiteboard import Calibration, lamps_needed
from emmc_rig.calibrate.bench import BenchTruth, Setting, WhiteboardBench
from emmc_rig.calibrate.drift import CALIBRATION
from emmc_rig.capture.plan import (
    METERING_EXPOSURE_S,
    Boards,
    Darks,
    OpenBoard,
    Plan,
    PlannedShot,
)
from emmc_rig.errors import AppError
from emmc_rig.files.frames import PSI
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.pages.calibration_page import write_calibration_report
from emmc_rig.progress import Silent, Watcher

Array = NDArray[np.floating]
PLAN, REPORT = "plan.yaml", "report.html"
PLAN_HEAD = """\
# Whiteboards of every view and of all together, then shots: emmc-rig capture plan.yaml --rig ...
# and after it: emmc-rig calibrate plan-session, or emmc-rig reconstruct plan-session.
"""
ROUTES = {
    "auto": ("parametric", "mixed", "free", "combined"),
    "parametric": ("parametric",),
    "mixed": ("parametric", "mixed"),
    "free": ("free",),
}
FREE_REPEATS = 2
BOARD_TURN_DEG = 90.0
PLANNED_DARKS = 4
LONGER_DARK = 1.25
"""Of the planned exposure through the pinhole: metering may choose a longer one."""
TARGET = 0.005
STAGE_KINDS_UM = ((0.0, 0.0), (270.0, 162.0))
VERIFY_UM = (-207.0, 118.0)
STAGE_PLACES, STAGE_REACH_UM = 16, 220.0


@dataclass(frozen=True)
class CalibrateSettings:
    """What to calibrate: camera, size, route (a key of ROUTES); what to plan for.

    target: relative error of Psi. most_frames: of the plan, None: as many as it takes.
    """

    camera_name: str
    camera: Camera
    size: tuple[int, int]
    route: str = "auto"
    target: float = TARGET
    seed: int = 0
    truth: BenchTruth = field(default_factory=BenchTruth)
    fit: FitSettings = field(default_factory=FitSettings)
    map_stage: bool = False
    most_frames: int | None = None


def plan_light(bench: WhiteboardBench, mask: ShadowMask) -> Light:
    """Return what the plan counts on: the exposure of a whiteboard, and how many pixels see it."""
    rows, columns = mask.pixel_shape()
    views = bench.camera.views
    single = bench.camera.sensor.cfa_name != "mono"
    light = (1 if single else 3) * bench.camera.sensor.binning**2
    return Light(
        bench.camera.sensor.noise,
        bench.board_exposure_s(),
        views[0] * views[1],
        light,
        rows * columns,
    )


def soft_design(camera: Camera, mask: ShadowMask) -> Placement:
    """Return the design with edges as soft as a bench's may be: what a plan is made for."""
    return replace(designed_placement(camera), blur_um=0.1 * mask.cell_um)


def parametric_plan(camera: Camera, mask: ShadowMask, light: Light, target: float) -> PlannedFrames:
    """Return the whiteboards for the parametric route."""
    stages = STAGE_KINDS_UM if camera.moving_masks else STAGE_KINDS_UM[:1]
    kinds = [Kind(None, stage) for stage in stages]
    kinds += [Kind((v, u)) for v, u in np.ndindex(camera.views)]
    return plan_parametric(mask, soft_design(camera, mask), kinds, light, target)


def few_settings(planned: PlannedFrames, lamp: str = "white") -> list[Setting]:
    """Return a plan as settings of the bench, in shot 0."""
    return [
        Setting(0, kind.pinhole, lamp, kind.stage_um, count)
        for kind, count in planned.counts.items()
    ]


def free_settings(camera: Camera, lamps: Sequence[str], repeats: int) -> list[Setting]:
    """Return the settings of the free route: every shot, view and lamp."""
    return [
        Setting(shot, (v, u), lamp, repeats=repeats)
        for shot in range(len(camera.shots))
        for v, u in np.ndindex(camera.views)
        for lamp in lamps
    ]


def held_out_settings(camera: Camera) -> list[Setting]:
    """Return the whiteboards to judge by: where shot 0 is, and where the stage has not been."""
    return [Setting(0), *([Setting(0, stage_um=VERIFY_UM)] if camera.moving_masks else [])]


def capture_plan(settings: CalibrateSettings, planned: PlannedFrames, light: Light) -> Plan:
    """Return the plan of a capture: whiteboards for every route, and the camera's shots."""
    repeats = max(1, *(count for kind, count in planned.counts.items() if kind.pinhole))
    fitted = [
        OpenBoard(mask_um=kind.stage_um, repeats=count)
        for kind, count in planned.counts.items()
        if kind.pinhole is None
    ]
    judging = [
        OpenBoard(mask_um=one.stage_um, repeats=one.repeats, held_out=True)
        for one in held_out_settings(settings.camera)
    ]
    # The metering chooses the real exposures; darks on both sides of them are interpolated.
    longest_s = light.exposure_s * light.pinhole_times * LONGER_DARK
    return Plan(
        title=f"{settings.camera_name}, to calibrate to {settings.target:.2%}",
        camera=settings.camera_name,
        shots=tuple(PlannedShot() for _ in settings.camera.shots),
        whiteboards=Boards(
            views="all",
            shots=(0,),
            repeats=repeats,
            references=max(2, planned.reference_frames),
            open=(*fitted, *judging),
        ),
        darks=Darks(
            exposure_s=(
                METERING_EXPOSURE_S,
                round(light.exposure_s, 4),
                round(longest_s, 3),
            ),
            repeats=max(4, planned.dark_frames),
        ),
    )


def combined_plan(
    camera: Camera, mask: ShadowMask, light: Light, target: float, most_frames: int | None = None
) -> PlannedFrames:
    """Return the whiteboards for all routes in one: the same number of every view, and open ones.

    Raises AppError, with the best there is, where the error asked for cannot be reached with at
    most `most_frames` frames in all (default: MOST_FRAMES before every view).
    """
    stages = STAGE_KINDS_UM if camera.moving_masks else STAGE_KINDS_UM[:1]
    opened = {Kind(None, stage): 2 for stage in stages}
    judging = sum(one.repeats for one in held_out_settings(camera))
    others = sum(opened.values()) + judging + REFERENCE_FRAMES + 3 * PLANNED_DARKS
    views = camera.views[0] * camera.views[1]
    most = MOST_FRAMES if most_frames is None else (most_frames - others) // views
    if most < 1:
        raise AppError(
            f"--frames {most_frames}: a plan opens each of the {views} views at least once, and "
            f"takes {others} frames beside: name at least {views + others}"
        )
    soft = soft_design(camera, mask)
    planned = plan_free(mask, soft, light, target, 1, most, modelled=True)
    if planned.expected_error > target:
        raise AppError(
            f"a relative error of Psi of {target:.3%} cannot be reached"
            f"{'' if most_frames is None else f' with {most_frames} frames'}: the best is "
            f"{planned.expected_error:.3%}, with {others + most * views}; raise --target"
            f"{'' if most_frames is None else ' or --frames'}"
        )
    return replace(planned, counts={**opened, **planned.counts}, dark_frames=3 * PLANNED_DARKS)


def write_plan(settings: CalibrateSettings, folder: Path) -> dict:
    """Write plan.yaml, for `emmc-rig capture`, and metrics.json: how many whiteboards of which
    kind reach the target. Raises AppError where none do.
    """
    camera = settings.camera
    mask = shadow_mask(camera, settings.size)
    bench = WhiteboardBench(camera, settings.size, settings.truth, settings.seed)
    light = plan_light(bench, mask)
    planned = combined_plan(camera, mask, light, settings.target, settings.most_frames)
    judging = sum(one.repeats for one in held_out_settings(camera))
    metrics = {
        "camera": settings.camera_name,
        "size": list(settings.size),
        "target_relative_error": settings.target,
        "model_error": MODEL_ERROR,
        "exposures": {
            "open_s": light.exposure_s,
            "pinhole_s": light.exposure_s * light.pinhole_times,
        },
        "dark_frames": planned.dark_frames,
        "reference_frames": planned.reference_frames,
        "held_out_frames": judging,
        "whiteboards": [
            {
                "pinhole": None if kind.pinhole is None else list(kind.pinhole),
                "stage_um": list(kind.stage_um),
                "frames": count,
            }
            for kind, count in planned.counts.items()
        ],
        "frames": planned.exposures + judging,
        "expected_relative_error": planned.expected_error,
        "command": command_line(),
        "versions": versions(),
    }
    to_capture = capture_plan(settings, planned, light).model_dump(
        mode="json", exclude_defaults=True
    )
    text = yaml.safe_dump(to_capture, sort_keys=False, default_flow_style=None)
    (folder / PLAN).write_text(PLAN_HEAD + text, encoding="utf-8")
    write_metrics(folder, metrics)
    return metrics


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


def run_calibration(settings: CalibrateSettings, watcher: Watcher | None = None) -> Run:
    """Capture the whiteboards that the route needs from the simulated bench, and calibrate."""
    watcher = watcher or Silent()
    if settings.route not in ROUTES:
        raise AppError(f"--route {settings.route}: use one of {', '.join(ROUTES)}")
    routes = ROUTES[settings.route]
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
        planned = parametric_plan(camera, mask, plan_light(bench, mask), settings.target)
        fitted = few_settings(planned)
    through: list[Setting] = []
    if "free" in routes:
        through = free_settings(camera, lamps, FREE_REPEATS)
        fitted = [one for one in fitted if one.pinhole is None]
    judges = held_out_settings(camera)[: 2 if "parametric" in routes else 1]
    watcher.begin("whiteboards", len(fitted) + len(through) + len(judges))
    boards = bench.capture([*fitted, *through, *judges], watcher.step)
    first, last = len(fitted), len(fitted) + len(through)
    held_out = boards.with_frames(boards.frames[last:])
    if "free" in routes:
        pinholes = boards.with_frames(boards.frames[first:last])
    if "parametric" in routes:
        few = boards.with_frames([one for one in boards.frames[:last] if one.shot == 0])
    turned = {}
    if "combined" in routes:
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


def outcome_figures(outcome: Outcome) -> dict:
    """Return what a calibration says of itself, for metrics.json and the report."""
    return {
        "chosen": outcome.chosen,
        "why": outcome.why,
        "findings": list(outcome.findings),
        "advice": list(outcome.advice),
        "held_out": {
            name: {
                "chi2": one.chi2,
                "chi2_without_worst_percent": one.trimmed,
                "neighbour_correlation": one.whiteness,
                "relative_error": one.relative_error,
                "chi2_by_kind": dict(one.groups),
            }
            for name, one in outcome.judged.items()
        },
        "frames": dict(outcome.frames),
        "bad_pixels": float(1 - outcome.good.mean()),
        "defects": None if outcome.mixed is None else _defect_count(outcome),
        "parameters": _parameters(outcome),
        "fit": _fit_figures(outcome),
    }


def measured_stage(
    bench: WhiteboardBench, design: ImagingMatrix, known: Parametric, watcher: Watcher
) -> StageMap:
    """Send the mask stage about, from both sides, and return what one whiteboard each tells."""
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


def in_three_colours(values: Array, psi: ImagingMatrix) -> NDArray[np.float32]:
    """Return values shaped as Psi's weights for all three colours: 0 where it stores none."""
    if psi.colour is None:
        return np.asarray(values, dtype=np.float32)
    own = np.arange(3)[:, None] == psi.colour[:, None, None, :, None, :]
    return np.where(own, values, 0).astype(np.float32)


def _of_good(psi: ImagingMatrix, good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return good.repeat(psi.binning, axis=0).repeat(psi.binning, axis=1)[:, None, :]


def true_error(psi: ImagingMatrix, true: Array, good: NDArray[np.bool_]) -> float:
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


def _defect_count(outcome: Outcome) -> int:
    assert outcome.mixed is not None
    return 0 if outcome.mixed.defects is None else outcome.mixed.defects.count


def _parameters(outcome: Outcome) -> dict[str, dict[str, float]]:
    best = outcome.mixed or outcome.parametric
    if best is None:
        return {}
    values = best.fit.placement.vector()
    views = np.array(best.fit.placement.aperture).shape
    deviations = np.sqrt(np.diag(best.fit.covariance))
    return {
        name: {"value": float(values[i]), "deviation": float(deviations[i])}
        for i, name in enumerate(labels((views[0], views[1])))
    }


def _fit_figures(outcome: Outcome) -> dict[str, object]:
    best = outcome.mixed or outcome.parametric
    if best is None:
        return {}
    fit = best.fit
    return {
        "correlation": fit.correlation,
        "chi2": fit.chi2,
        "outliers": fit.outliers,
        "steps": fit.steps,
        "status": fit.status,
        "undecided": list(fit.undecided),
        "boards": [asdict(one) for one in fit.boards],
    }


def true_parameters(truth: BenchTruth) -> dict[str, float]:
    """Return the scalars of the placement that the simulated bench really has, where comparable.

    Its vignetting and falloff follow another law.
    """
    mounting, optics = truth.mounting, truth.optics
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


def save_calibration(path: Path, calibration: Calibration, known: Parametric | None) -> None:
    """Write what turns frames into readings, how sure Psi is, and the placement, as HDF5."""
    with h5py.File(path, "w") as file:
        file.attrs["gain_dn_per_electron"] = calibration.gain.gain_dn_per_electron
        file.attrs["dark_variance_dn2"] = calibration.gain.dark_variance_dn2
        file["deviation"] = calibration.deviation
        file["dark_dn"] = calibration.dark_dn
        file["white_dn_per_s"] = calibration.white_dn_per_s
        if calibration.good is not None:
            file["good"] = calibration.good
        if known is not None:
            for name in SCALARS:
                file.attrs[name] = getattr(known.fit.placement, name)
            file["aperture"] = np.array(known.fit.placement.aperture)
            if known.defects is not None:
                file["lost"] = known.defects.lost


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


def save_outcome(folder: Path, outcome: Outcome, chosen: Calibration) -> None:
    """Write psi.h5 and calibration.h5 of the calibration chosen into an existing folder."""
    best = outcome.mixed or outcome.parametric
    known = {"parametric": outcome.parametric, "mixed": outcome.mixed, "combined": best}.get(
        outcome.chosen
    )
    chosen.psi.save(folder / PSI)
    save_calibration(folder / CALIBRATION, chosen, known)


def free_route_error(settings: CalibrateSettings, repeats: int) -> float:
    """Return the error of Psi that the free route's formula expects of so many frames a view."""
    mask = shadow_mask(settings.camera, settings.size)
    bench = WhiteboardBench(settings.camera, settings.size, settings.truth, settings.seed)
    light = plan_light(bench, mask)
    return free_noise(mask, soft_design(settings.camera, mask), light).error(repeats)

"""What calibration reaches on the simulated bench, measured against what was asked of it.

Every figure comes from whiteboards and captures traced ray by ray on a bench that is wrong in ways
the calibration is not told of (`whiteboard_bench`), but for the Monte Carlo checks of covariances,
which draw noise alone.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board, as_readings
from calibration.drift import Drift, displacement_px, drifted, find_drift
from calibration.fit import FitSettings, fit_placement
from calibration.frames import MeanFrame
from calibration.parametric import coefficient_planes, expected_psi_error, psi_at, shot_stages
from calibration.placement import (
    SCALARS,
    Placement,
    Tolerances,
    labels,
    with_aperture_mean_one,
)
from calibration.planning import REFERENCE_FRAMES
from calibration.residuals import ResidualCheck, check_residuals
from calibration.routes import calibrate
from calibration.sensor import Pair, characterise
from calibration.shadow import ANY_COLOUR, Shadow, ShadowMask, shadow_mask
from calibration.stage_map import locate
from calibration.whiteboard import Calibration, Whiteboards, measure_psi, measured_planes
from emmc_rig.calibrate import (
    CalibrateSettings,
    few_settings,
    free_route_error,
    free_settings,
    held_out_settings,
    measured_stage,
    parametric_plan,
    plan_light,
    run_calibration,
    soft_design,
    true_parameters,
)
from emmc_rig.demo import Silent
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, build_imaging_matrix, psi_layout
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.output import command_line, versions, write_metrics
from emmc_rig.scene import fine_scene
from emmc_rig.whiteboard_bench import (
    HARSH_SENSOR,
    BenchTruth,
    Setting,
    StageFaults,
    WhiteboardBench,
)
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
FRAME_TARGETS = (0.06, 0.04, 0.025, 0.015, 0.01, 0.005)
SAME_DB = 0.05
FITS, PSI_FITS = 16, 4
ALARM_RUNS = 20
DRIFT_SCENES = 2
FLAT_SHARES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 1.0)
LARGE = (4000, 6000)


@dataclass(frozen=True)
class Row:
    """One target: what, measured, asked, and whether it is met ("" where nothing was asked)."""

    what: str
    measured: str
    asked: str = ""
    verdict: str = ""


def _row(what: str, value: float, limit: float | None, form: str, above: bool = False) -> Row:
    if limit is None:
        return Row(what, format(value, form))
    met = value >= limit if above else value <= limit
    asked = f"{'at least' if above else 'at most'} {limit:{form}}"
    return Row(what, format(value, form), asked, "met" if met else "missed")


def scenes() -> list[str]:
    """Return three scenes: real ones where EMMC_LIGHTFIELDS has them, else built-in ones."""
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    real = [str(Path(folder) / name) for name in REAL_SCENES] if folder else []
    return real if real and all(Path(one).is_dir() for one in real) else list(BUILT_IN)


def run_checks(settings: CalibrateSettings, names: str, folder: Path) -> dict:
    """Run the checks named, commas between, and write metrics.json; return the metrics."""
    wanted = list(CHECKS) if names == "all" else names.split(",")
    for name in wanted:
        if name not in CHECKS:
            raise AppError(f"--check {name}: use all, or some of {', '.join(CHECKS)}")
    rows: list[Row] = []
    details: dict[str, object] = {}
    seconds: dict[str, float] = {}
    for name in wanted:
        started = time.perf_counter()
        found, detail = CHECKS[name](settings)
        rows += found
        details[name] = detail
        seconds[name] = time.perf_counter() - started
    metrics = {
        "camera": settings.camera_name,
        "size": list(settings.size),
        "rays_per_view": settings.truth.rays_per_view,
        "rows": [asdict(row) for row in rows],
        "details": details,
        "seconds": seconds,
        "command": command_line(),
        "versions": versions(),
    }
    write_metrics(folder, metrics)
    return metrics


def _check_psi(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """All routes on the harsh bench: error of Psi, of the geometry, frames."""
    run = run_calibration(replace(settings, route="all"))
    metrics = run.metrics
    errors = metrics["psi_relative_error"]
    parametric = run.outcome.parametric
    assert parametric is not None
    at, truth = parametric.fit.placement, true_parameters(settings.truth)
    pitch_um = settings.camera.sensor.sample_pitch_um
    shift_px = np.hypot(
        at.offset_x_um - truth["offset_x_um"], at.offset_y_um - truth["offset_y_um"]
    )
    distance = (1 + at.distance_share) / (1 + truth["distance_share"]) - 1
    turn = abs(np.degrees(at.rotation_rad - truth["rotation_rad"]))
    rows = [
        _row("Psi, parametric (dust not modelled)", errors["parametric"], 0.01, ".3%"),
        _row("Psi, mixed", errors["mixed"], 0.01, ".3%"),
        _row("Psi, free", errors["free"], 0.02, ".3%"),
        _row("Psi, as designed", metrics["design_relative_error"], None, ".0%"),
        _row("distance d", abs(float(distance)), 0.005, ".4%"),
        _row("shift, px", float(shift_px) / pitch_um, 0.02, ".5f"),
        _row("rotation, degrees", float(turn), 0.005, ".6f"),
    ]
    return rows, metrics


def _noise_boards(
    mask: ShadowMask,
    settings: CalibrateSettings,
    truth: Placement,
    wanted: list[Setting],
    seed: int,
) -> list[Board]:
    """Return whiteboards of a placement with the noise of one capture: for statistics."""
    rng = np.random.default_rng(seed)
    camera = settings.camera
    light = plan_light(WhiteboardBench(camera, settings.size, settings.truth, seed), mask)
    layout = psi_layout(camera, settings.size)
    shadow = Shadow(mask, truth)
    shape = mask.pixel_shape()
    pixels = np.argwhere(np.ones(shape, dtype=bool))
    k = layout.binning
    channels = np.full(shape, ANY_COLOUR, np.uint8)
    if layout.colour is not None:
        channels = np.ascontiguousarray(layout.colour[0, ::k, ::k])
    found = []
    for one in wanted:
        views_open = np.full(camera.views, one.pinhole is None)
        if one.pinhole is not None:
            views_open[one.pinhole] = True
        clean = shadow.readings(pixels, channels.ravel(), views_open, one.stage_um)
        times = 1.0 if one.pinhole is None else light.pinhole_times
        variance = light.noise.variance(clean, light.exposure_s * times, light.light) / one.repeats
        white = light.noise.variance(np.ones(1), light.exposure_s, light.light)[0]
        variance = variance + clean**2 * white / REFERENCE_FRAMES
        read = clean + rng.normal(0, 1, len(clean)) * np.sqrt(variance)
        found.append(
            Board(
                "drawn",
                read.reshape(shape).astype(np.float32),
                variance.reshape(shape).astype(np.float32),
                channels,
                views_open,
                one.stage_um,
                0,
            )
        )
    return found


def _drawn_truth(design: Placement, seed: int) -> Placement:
    """Return a bench as the prior expects one: the bound counts on it."""
    rng, prior = np.random.default_rng(seed), Tolerances()
    views = np.shape(design.aperture)
    truth = replace(
        design,
        rotation_rad=float(rng.normal(0, 0.002)),
        scale=1 + float(rng.normal(0, 0.001)),
        distance_share=float(rng.normal(0, 0.05)),
        clear=0.94,
        leak=0.03,
        vignetting=float(rng.normal(0, 0.05)),
        falloff=float(rng.normal(0, 0.2)),
        aperture=tuple(map(tuple, 1 + prior.aperture * rng.standard_normal(views))),
    )
    return with_aperture_mean_one(truth)


def _check_bound(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """Monte Carlo: deviation of every parameter over the Cramer-Rao bound, and Psi's error.

    The bound is that of the readings with the prior (van Trees), on benches drawn from it, and for
    aperture weights of mean 1.
    """
    camera = settings.camera
    mask = shadow_mask(camera, settings.size)
    bench = WhiteboardBench(camera, settings.size, settings.truth, settings.seed)
    planned = parametric_plan(camera, mask, plan_light(bench, mask), settings.target)
    wanted = few_settings(planned)
    layout = psi_layout(camera, settings.size)
    errors, bounds, reached, expected = [], [], [], []
    for seed in range(FITS):
        truth = _drawn_truth(soft_design(camera, mask), seed)
        boards = _noise_boards(mask, settings, truth, wanted, 1000 + seed)
        choice = FitSettings(first_pixels=4000, pixels_per_board=10**9, seed=seed)
        fit = fit_placement(boards, camera, mask, choice, start=truth)
        errors.append(fit.placement.vector() - truth.vector())
        level = np.eye(len(errors[0]))
        level[len(SCALARS) :, len(SCALARS) :] -= 1 / np.size(truth.aperture)
        bounds.append(np.diag(level @ fit.bound @ level.T))
        if seed < PSI_FITS:
            exact = psi_at(Shadow(mask, truth), layout, shot_stages(camera))
            psi = psi_at(Shadow(mask, fit.placement), layout, shot_stages(camera))
            reached.append(psi.relative_difference(exact))
            expected.append(expected_psi_error(Shadow(mask, truth), fit.bound))
    ratios = np.sqrt(np.mean(np.square(errors) / bounds, axis=0))
    told = f"{np.mean(expected):.3%}, {np.sqrt(np.mean(np.square(reached))):.3%}"
    rows = [
        _row(
            "deviation of the parameters / Cramer-Rao bound (root mean square)",
            float(np.sqrt(np.mean(ratios**2))),
            1.5,
            ".2f",
        ),
        _row("... the worst parameter", float(ratios.max()), 1.5, ".2f"),
        Row("Psi's error by formula, and as drawn", told),
    ]
    detail = {
        "ratios": dict(zip(labels(camera.views), ratios.tolist(), strict=True)),
        "fits": FITS,
        "whiteboards": sum(one.repeats for one in wanted),
    }
    return rows, detail


def _check_plan(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """The planner's error of Psi against that of simulated whiteboards, by both routes."""
    camera = settings.camera
    mask = shadow_mask(camera, settings.size)
    rows, detail = [], {}
    design = build_imaging_matrix(camera, settings.size)
    truth = soft_design(camera, mask)
    exact = psi_at(Shadow(mask, truth), design.layout, shot_stages(camera))
    for target in (0.02, 0.01, 0.005):
        bench = WhiteboardBench(camera, settings.size, settings.truth, settings.seed)
        planned = parametric_plan(camera, mask, plan_light(bench, mask), target)
        found = []
        for seed in range(3):
            boards = _noise_boards(mask, settings, truth, few_settings(planned), 50 + seed)
            fit = fit_placement(boards, camera, mask, start=truth)
            psi = psi_at(Shadow(mask, fit.placement), design.layout, shot_stages(camera))
            found.append(psi.relative_difference(exact))
        reached = float(np.sqrt(np.mean(np.square(found))))
        detail[f"{target}"] = [planned.expected_error, reached, planned.exposures]
        rows.append(
            Row(
                f"plan for {target:.1%}: {planned.exposures} frames",
                f"expected {planned.expected_error:.2%}, simulated {reached:.2%}",
            )
        )
    bench = WhiteboardBench(
        camera, settings.size, replace(settings.truth, sensor=replace(HARSH_SENSOR, bad_share=0.0))
    )
    one_shot = build_imaging_matrix(camera, settings.size)
    for repeats in (1, 4):
        boards = bench.capture(free_settings(camera, ("white",), repeats))
        psi = measure_psi(boards.pinholes(), one_shot).psi
        reached = psi.relative_difference(bench.exact_psi(one_shot))
        expected = free_route_error(settings, repeats)
        rows.append(
            Row(
                f"free route, {repeats} frame(s) a view",
                f"expected {expected:.2%}, simulated {reached:.2%}",
            )
        )
        detail[f"free {repeats}"] = [expected, reached]
    return rows, detail


def _check_sensor(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """EMVA 1288 figures of the simulated sensor against what it was made with."""
    noise, flaws = settings.camera.sensor.noise, settings.truth.sensor
    size, rng = settings.size, np.random.default_rng(settings.seed)
    well = flaws.full_well_electrons or noise.white_level_dn / noise.gain_dn_per_electron
    brightest_s = 1.3 * well / noise.electrons_per_s

    def pairs(reading: float, times: Array) -> list[Pair]:
        plane = np.full(size, reading)
        return [
            Pair(
                float(t),
                *(flaws.expose_dn(noise, plane, float(t), 1.0, rng) for _ in range(2)),
            )
            for t in times
        ]

    sheet = characterise(
        pairs(0.0, np.array([0.01, 1.0, 4.0])),
        pairs(
            1.0, brightest_s * np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 1])
        ),
        noise.white_level_dn,
    )
    known = {
        "gain_dn_per_electron": noise.gain_dn_per_electron,
        "read_noise_electrons": noise.read_noise_electrons,
        "dark_current_electrons_per_s": flaws.dark_electrons_per_s,
        "full_well_electrons": well,
        "prnu_percent": 100 * flaws.response_spread,
        "dsnu_electrons": flaws.offset_spread_dn / noise.gain_dn_per_electron,
    }
    rows = [
        Row(name, f"{getattr(sheet, name):.5g} +- {sheet.deviations[name]:.2g}", f"{truth:.5g}")
        for name, truth in known.items()
    ]
    hot, dead = flaws.bad(size)
    rows.append(
        Row(
            "hot, dead pixels", f"{sheet.hot_pixels}, {sheet.dead_pixels}",
            f"{int(hot.sum())}, {int(dead.sum())}",
        )
    )  # fmt: skip
    return rows, {name: [getattr(sheet, name), truth] for name, truth in known.items()}


def _check_stage(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """A stage of known faults, mapped from one whiteboard per position on the harsh bench."""
    camera, faults = settings.camera, StageFaults(1.0015, 0.3, (2.0, 1.2), 0.1)
    truth = replace(settings.truth, stage=faults)
    still = run_calibration(replace(settings, route="parametric"))
    assert still.outcome.parametric is not None
    bench = WhiteboardBench(camera, settings.size, truth, settings.seed)
    design = build_imaging_matrix(camera, settings.size)
    found = measured_stage(bench, design, still.outcome.parametric, Silent())
    setting = Setting(stage_um=(151.0, -83.0), repeats=1, came_from=(-1, 1))
    (board,) = as_readings(bench.capture([setting]), design.layout)
    parametric = still.outcome.parametric
    place = locate(board, parametric.mask, parametric.fit.placement)
    real = faults.real_um(setting.stage_um, setting.came_from)
    off_um = float(np.hypot(place.x_um - real[0], place.y_um - real[1]))
    pitch_um = camera.sensor.sample_pitch_um
    rows = [
        _row("a mask located, px off", off_um / pitch_um, 0.02, ".5f"),
        Row("scale of the stage", f"{found.scale[0]:.5f}", f"{faults.scale:.5f}"),
        Row(
            "rotation of the stage, degrees",
            f"{found.rotation_deg:.4f}",
            f"{faults.rotation_deg:.4f}",
        ),
        Row("orthogonality, degrees", f"{found.orthogonality_deg:+.4f}", "0.0000"),
        Row("backlash x, y, um", "{:.2f}, {:.2f}".format(*found.backlash_um), "2.00, 1.20"),
        Row("repeatability x, y, um", "{:.2f}, {:.2f}".format(*found.repeatability_um), "0.10"),
    ]
    return rows, {name: [value, deviation] for name, value, deviation, _ in found.rows()}


@dataclass(frozen=True, eq=False)
class _Captured:
    """A scene captured on a bench, and what it is compared with."""

    bench: WhiteboardBench
    truth: Array
    frames_dn: NDArray[np.uint16]
    exposures_s: Array


def _captured(
    spec: str, camera: Camera, truth: BenchTruth, seed: int, size: tuple[int, int] = SCENE_SIZE
) -> _Captured:
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
    readings = calibration.readings(captured.frames_dn, captured.exposures_s)
    white = captured.bench.camera.sensor.noise.white_level_dn
    usable = calibration.usable(captured.frames_dn, white)
    variance = calibration.reading_variance(captured.frames_dn, captured.exposures_s)
    sigma = float(np.sqrt(variance[usable].mean()))
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


def _check_cost(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """What the measured Psi costs a TV reconstruction, against the bench's own Psi."""
    bench, design, outcome, few = _calibrated(settings, settings.target)
    exact = bench.exact_psi(design)
    rows: list[Row] = []
    detail: dict[str, object] = {"frames": few.exposures}
    for spec in scenes():
        captured = _captured(spec, settings.camera, settings.truth, settings.seed + 1)
        calibration = outcome.calibrations["mixed"]
        with_exact = _psnr(exact, calibration, captured)
        costs = {
            name: with_exact - _psnr(one.psi, one, captured)
            for name, one in outcome.calibrations.items()
        }
        costs["design"] = with_exact - _psnr(design, calibration, captured)
        detail[Path(spec).name] = {"exact_psnr_db": with_exact, **costs}
        name = Path(spec).name
        rows.append(
            _row(f"{name}: cost of the parametric Psi, dB", costs["parametric"], 0.3, ".3f")
        )
        rows.append(_row(f"{name}: cost of the mixed Psi, dB", costs["mixed"], 0.3, ".3f"))
        rows.append(_row(f"{name}: cost of the design, dB", costs["design"], None, ".2f"))
    return rows, detail


def _check_frames(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """Fewest frames with which the parametric routes reach the free route's reconstruction."""
    camera = settings.camera
    bench = WhiteboardBench(camera, SCENE_SIZE, settings.truth, settings.seed)
    design = build_imaging_matrix(camera, SCENE_SIZE)
    mask = shadow_mask(camera, SCENE_SIZE)
    held_out = bench.capture(held_out_settings(camera))
    free_boards = bench.capture(free_settings(camera, ("white",), 1))
    free = calibrate(camera, design, ("free",), held_out, pinholes=free_boards).calibration
    spec = scenes()[0]
    captured = _captured(spec, camera, settings.truth, settings.seed + 1)
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
            whiteboards = len(free_boards.frames) / boards
            rows.append(
                _row("whiteboards, free over parametric", whiteboards, 5.0, ".1f", above=True)
            )
            every = free_boards.exposures / few.exposures
            rows.append(_row("all frames, free over parametric", every, 5.0, ".1f", above=True))
            break
    else:
        rows.append(Row("the parametric routes do not reach it", "-", "at least 5.0", "missed"))
    return rows, detail


def _drift_of(
    outcome_calibration: Calibration,
    shadow: Shadow,
    captured: _Captured,
    design: ImagingMatrix,
) -> Drift:
    calibration = outcome_calibration
    readings = calibration.readings(captured.frames_dn, captured.exposures_s)
    white = captured.bench.camera.sensor.noise.white_level_dn
    usable = calibration.usable(captured.frames_dn, white)
    variance = calibration.reading_variance(captured.frames_dn, captured.exposures_s)
    if design.colour is None:
        raise AppError("a drift is sought on sensors with a colour filter")
    return find_drift(
        readings,
        variance,
        usable,
        design.colour,
        shadow.mask,
        shadow.placement,
        shot_stages(captured.bench.camera),
    )


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


def _check_drift(settings: CalibrateSettings) -> tuple[list[Row], dict]:
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
            captured = _captured(spec, camera, truth, settings.seed + 2)
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
            left = np.array(list(found.values.values()))[:5] - np.array(drift)
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
                    + ("told" if found.drifted else "not told"),
                )
            )
        if lost > 0.05:
            rows.append(_row(f"{what}: share of the lost dB recovered", gained / lost, 0.85, ".0%",
                             above=True))  # fmt: skip
        else:
            rows.append(Row(f"{what}: nothing is lost", f"{lost:.3f} dB in all"))
    return rows, detail


def _check_alarms(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """False alarms: captures of many scenes through a bench that has not moved."""
    camera = settings.camera
    _, design, outcome, _ = _calibrated(settings, settings.target)
    assert outcome.mixed is not None
    calibration, shadow = outcome.calibrations["mixed"], outcome.mixed.shadow
    found = []
    known = [*scenes(), *(name for name in BUILT_IN if name not in scenes())]
    for run in range(ALARM_RUNS):
        spec = known[run % len(known)]
        captured = _captured(spec, camera, settings.truth, settings.seed + 10 + run)
        drift = _drift_of(calibration, shadow, captured, design)
        found.append((Path(spec).name, drift.drifted, drift.displacement_px, drift.chi2))
    alarms = sum(one[1] for one in found)
    largest = max(one[2] for one in found)
    rows = [
        _row("false alarms on a Psi that fits", alarms / len(found), 0.01, ".1%"),
        Row("largest displacement found there, px", f"{largest:.3f} in {len(found)} captures"),
    ]
    return rows, {"captures": found}


class _DrawnPinholes(Mapping):
    """Frames through the pinhole that are made as they are asked for, as a session reads them."""

    def __init__(self, shadow: Shadow, colours: NDArray[np.uint8]) -> None:
        self._shadow, self._colours, self.seconds = shadow, colours, 0.0

    def __getitem__(self, key: tuple[int, int, int, str]) -> MeanFrame:
        started = time.perf_counter()
        _, v, u, _ = key
        views_open = np.zeros(self._shadow.mask.views, dtype=bool)
        views_open[v, u] = True
        rows, columns = self._colours.shape
        frame = np.empty(self._colours.shape, np.float32)
        for first in range(0, rows, 64):
            band = slice(first, min(first + 64, rows))
            pixels = np.moveaxis(np.mgrid[band, :columns], 0, -1).reshape(-1, 2)
            read = self._shadow.readings(pixels, self._colours[band].ravel(), views_open)
            frame[band] = 256 + 45_000 * 25 * read.reshape(frame[band].shape)
        self.seconds += time.perf_counter() - started
        return MeanFrame(frame, np.nan, 1, 5.0)

    def __iter__(self):
        return iter(())

    def __len__(self) -> int:
        return int(np.prod(self._shadow.mask.views))


def _check_large(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """A 24 MP sensor with 25 views: seconds and memory of the fit and of Psi, plane by plane."""
    camera = settings.camera
    mask = shadow_mask(camera, LARGE)
    truth = replace(
        soft_design(camera, mask), offset_x_um=14.0, rotation_rad=0.0005, scale=1.0003,
        distance_share=0.03,
    )  # fmt: skip
    rng = np.random.default_rng(settings.seed)
    layout = psi_layout(camera, LARGE)
    if layout.colour is None:
        raise AppError("the large check is for sensors with a colour filter")
    colours = np.ascontiguousarray(layout.colour[0])
    shadow = Shadow(mask, truth)
    boards = []
    for pinhole in (None, (2, 2), (0, 0), (4, 0), (2, 4)):
        views_open = np.full(camera.views, pinhole is None)
        if pinhole is not None:
            views_open[pinhole] = True
        reading = np.empty(LARGE, np.float32)
        for first in range(0, LARGE[0], 64):
            band = slice(first, min(first + 64, LARGE[0]))
            pixels = np.moveaxis(np.mgrid[band, : LARGE[1]], 0, -1).reshape(-1, 2)
            clean = shadow.readings(pixels, colours[band].ravel(), views_open)
            reading[band] = (clean * (1 + rng.normal(0, 0.005, len(clean)))).reshape(
                reading[band].shape
            )
        variance = np.full(LARGE, (0.005 * float(reading.mean())) ** 2, np.float32)
        boards.append(Board("drawn", reading, variance, colours, views_open, (0.0, 0.0), 0))
    started = time.perf_counter()
    fit = fit_placement(boards, camera, mask)
    fit_s = time.perf_counter() - started
    started = time.perf_counter()
    planes = coefficient_planes(Shadow(mask, fit.placement), layout, [(0.0, 0.0)])
    next(planes)
    plane_s = time.perf_counter() - started
    frames = _DrawnPinholes(shadow, colours)
    white = MeanFrame(np.full(LARGE, 45_000, np.float32), 36_000.0, 4, 0.2)
    dark = MeanFrame(np.full(LARGE, 256, np.float32), 4.0, 4, 0.2)
    free = measured_planes(Whiteboards(dark, {(0, "white"): white}, frames), layout)
    started = time.perf_counter()
    for _ in range(2):
        next(free)
    free_s = (time.perf_counter() - started - frames.seconds) / 2
    memory_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    at = fit.placement
    rows = [
        _row("24 MP: parametric fit, s", fit_s, 120.0, ".1f"),
        Row("24 MP: one plane of Psi, s (25 of them)", f"{plane_s:.1f}"),
        Row("24 MP: free route, s a view beyond getting its frame", f"{free_s:.1f}"),
        _row("24 MP: peak memory, GiB, five whiteboards held", memory_gib, 4.0, ".2f"),
        _row("24 MP: distance d", abs(at.distance_share - 0.03) / 1.03, 0.005, ".4%"),
        _row("24 MP: rotation, degrees", abs(float(np.degrees(at.rotation_rad - 0.0005))), 0.005,
             ".6f"),
    ]  # fmt: skip
    return rows, {"fit_seconds": fit_s, "plane_seconds": plane_s, "peak_gib": memory_gib}


CHECKS: dict[str, Callable[[CalibrateSettings], tuple[list[Row], dict]]] = {
    "psi": _check_psi,
    "bound": _check_bound,
    "plan": _check_plan,
    "sensor": _check_sensor,
    "stage": _check_stage,
    "cost": _check_cost,
    "frames": _check_frames,
    "drift": _check_drift,
    "alarms": _check_alarms,
    "large": _check_large,
}

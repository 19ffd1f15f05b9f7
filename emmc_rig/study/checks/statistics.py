"""Covariances, bounds and plans against whiteboards drawn from the model with noise alone.

The one place that inverts the model that made its data: it asks of the statistics alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.fit import FitSettings, fit_placement
from calibration.parametric import expected_psi_error, psi_at, shot_stages
from calibration.placement import (
    SCALARS,
    Placement,
    Tolerances,
    labels,
    with_aperture_mean_one,
)
from calibration.planning import REFERENCE_FRAMES, Kind, reading_variance
from calibration.shadow import ANY_COLOUR, Shadow, ShadowMask, shadow_mask
from calibration.whiteboard import measure_psi
from emmc_rig.model.camera import build_imaging_matrix, psi_layout
from emmc_rig.processing.bench import (
    ORDINARY_BENCH,
    Setting,
    WhiteboardBench,
)
from emmc_rig.processing.board_plan import (
    few_settings,
    free_route_error,
    free_settings,
    parametric_plan,
    plan_light,
    soft_design,
)
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.study.checks.rows import Row, target_row

Array = NDArray[np.floating]
FITS, PSI_FITS = 16, 4


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
        views_open = one.views_open(camera.views)
        clean = shadow.readings(pixels, channels.ravel(), views_open, one.stage_um)
        kind = Kind(one.pinhole, one.stage_um, one.window)
        variance = reading_variance(clean, kind, light) / one.repeats
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


def check_bound(settings: CalibrateSettings) -> tuple[list[Row], dict]:
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
        choice = FitSettings(first_pixels=4000, pixels=10**9, seed=seed)
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
    errors_words = f"{np.mean(expected):.3%}, {np.sqrt(np.mean(np.square(reached))):.3%}"
    rows = [
        target_row(
            "deviation of the parameters / Cramer-Rao bound (root mean square)",
            float(np.sqrt(np.mean(ratios**2))),
            1.5,
            ".2f",
        ),
        target_row(
            f"... the worst of {len(ratios)}, each known to {1 / np.sqrt(2 * FITS):.0%}",
            float(ratios.max()),
            None,
            ".2f",
        ),
        Row("Psi's error by formula, and as drawn", errors_words),
    ]
    detail = {
        "ratios": dict(zip(labels(camera.views), ratios.tolist(), strict=True)),
        "fits": FITS,
        "whiteboards": sum(one.repeats for one in wanted),
    }
    return rows, detail


def check_plan(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """The planner's error of Psi against that of simulated whiteboards, by both routes."""
    camera = settings.camera
    mask = shadow_mask(camera, settings.size)
    rows, detail = [], {}
    layout, stages = psi_layout(camera, settings.size), shot_stages(camera)
    for target in (0.02, 0.01, 0.005):
        bench = WhiteboardBench(camera, settings.size, settings.truth, settings.seed)
        planned = parametric_plan(camera, mask, plan_light(bench, mask), target)
        found = []
        for seed in range(PSI_FITS):
            truth = _drawn_truth(soft_design(camera, mask), seed)
            boards = _noise_boards(mask, settings, truth, few_settings(planned), 50 + seed)
            fit = fit_placement(boards, camera, mask, start=truth)
            exact = psi_at(Shadow(mask, truth), layout, stages)
            psi = psi_at(Shadow(mask, fit.placement), layout, stages)
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
        camera,
        settings.size,
        replace(settings.truth, sensor=replace(ORDINARY_BENCH.sensor, bad_share=0.0)),
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

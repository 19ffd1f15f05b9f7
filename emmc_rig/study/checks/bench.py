"""Psi, sensor and stage on the simulated bench, whose faults are unknown to the calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import as_readings
from calibration.sensor import Pair, characterise
from calibration.stage_map import locate
from emmc_rig.model.camera import build_imaging_matrix
from emmc_rig.processing.bench import (
    Setting,
    StageFaults,
    WhiteboardBench,
)
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.processing.comparison import true_parameters
from emmc_rig.processing.simulated import measured_stage, run_calibration
from emmc_rig.progress import Silent
from emmc_rig.study.checks.rows import COVERED, COVERED_TWICE, Row, covered, target_row

Array = NDArray[np.floating]
STATED_TRUE = 1.25
"""Times the stated error: what a route that is not chosen may be off by."""
FEW_SIZE, FEW_RAYS = (96, 128), 4096
"""Of the bench for few whiteboards: fewer rays are grainier than the error asked for."""
FLAT_SHARES = (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 1.0)


def check_psi(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """All routes on the harsh bench: error of Psi, of the geometry, frames."""
    run = run_calibration(replace(settings, route="auto"))
    metrics = run.metrics
    errors, stated = metrics["psi_relative_error"], metrics["psi_stated_error"]
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
        target_row("Psi, parametric (dust not modelled)", errors["parametric"], None, ".3%"),
        target_row(
            f"Psi, mixed (states {stated['mixed']:.2%})",
            errors["mixed"],
            STATED_TRUE * stated["mixed"],
            ".3%",
        ),
        target_row("Psi, free", errors["free"], 0.02, ".3%"),
        target_row("Psi, combined", errors["combined"], 0.005, ".3%"),
        target_row("Psi, as designed", metrics["design_relative_error"], None, ".0%"),
        target_row("distance d", abs(float(distance)), 0.005, ".4%"),
        target_row("shift, px", float(shift_px) / pitch_um, 0.02, ".5f"),
        target_row("rotation, degrees", float(turn), 0.005, ".6f"),
    ]
    return rows, metrics


def check_few(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """The fitted mask from about ten whiteboards: open ones, halves and corners of the aperture."""
    rows, columns = (min(pair) for pair in zip(settings.size, FEW_SIZE, strict=True))
    truth = replace(settings.truth, rays_per_view=max(settings.truth.rays_per_view, FEW_RAYS))
    wanted = replace(settings, few=True, route="mixed", size=(rows, columns), truth=truth)
    run = run_calibration(wanted)
    metrics = run.metrics
    assert run.planned is not None
    boards = sum(run.planned.counts.values())
    chosen = metrics["chosen"]
    error, stated = (metrics[f"psi_{key}_error"][chosen] for key in ("relative", "stated"))
    once, twice = metrics["psi_coverage"][chosen]
    rows = [
        target_row("few: whiteboards", boards, 12, ".0f"),
        target_row(f"few: true error of Psi ({chosen}, states {stated:.2%})", error, 0.005, ".2%"),
        covered("few: within one deviation", once, COVERED),
        covered("few: within two", twice, COVERED_TWICE),
    ]
    return rows, {**metrics, "whiteboards": boards}


def check_sensor(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """EMVA 1288 figures of the simulated sensor against its true parameters."""
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
        pairs(1.0, brightest_s * np.array(FLAT_SHARES)),
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
    deviations = {
        **sheet.deviations,
        "prnu_percent": sheet.prnu.figure("total", 100.0)[1],
        "dsnu_electrons": sheet.dsnu.figure("total", 1 / sheet.gain_dn_per_electron)[1],
    }
    rows = [
        Row(name, f"{getattr(sheet, name):.5g} +- {deviations[name]:.2g}", f"{truth:.5g}")
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


def check_stage(settings: CalibrateSettings) -> tuple[list[Row], dict]:
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
        target_row("a mask located, px off", off_um / pitch_um, 0.02, ".5f"),
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

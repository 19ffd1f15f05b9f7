"""A sensor of 24 MP and 25 views: seconds and memory of the parametric fit."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.fit import fit_placement
from calibration.parametric import coefficient_planes
from calibration.shadow import Shadow, shadow_mask
from emmc_rig.errors import AppError
from emmc_rig.files.memory import forget_peak, peak_memory_mib
from emmc_rig.model.camera import psi_layout
from emmc_rig.processing.board_plan import soft_design
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.study.checks.rows import Row, target_row

Array = NDArray[np.floating]
LARGE = (4000, 6000)


def check_large(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """A 24 MP sensor with 25 views: seconds and memory of the fit and of Psi, plane by plane."""
    forget_peak()
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
    memory_gib = peak_memory_mib() / 2**10
    at = fit.placement
    turn = abs(np.degrees(at.rotation_rad - 0.0005))
    rows = [
        target_row("24 MP: parametric fit, s", fit_s, 120.0, ".1f"),
        Row("24 MP: one plane of Psi, s (25 of them)", f"{plane_s:.1f}"),
        target_row("24 MP: peak memory, GiB, five whiteboards held", memory_gib, 4.0, ".2f"),
        target_row("24 MP: distance d", abs(at.distance_share - 0.03) / 1.03, 0.005, ".4%"),
        target_row("24 MP: rotation, degrees", float(turn), 0.005, ".6f"),
    ]
    return rows, {"fit_seconds": fit_s, "plane_seconds": plane_s, "peak_gib": memory_gib}

"""A sensor of 24 MP and 25 views: seconds and memory of both routes."""

from __future__ import annotations

import resource
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.fit import fit_placement
from calibration.frames import MeanFrame
from calibration.parametric import coefficient_planes
from calibration.shadow import Shadow, shadow_mask
from calibration.whiteboard import Whiteboards, measured_planes
from emmc_rig.calibrate.board_plan import soft_design
from emmc_rig.calibrate.settings import CalibrateSettings
from emmc_rig.errors import AppError
from emmc_rig.model.camera import psi_layout
from emmc_rig.study.checks.rows import Row, target_row

Array = NDArray[np.floating]
LARGE = (4000, 6000)


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


def check_large(settings: CalibrateSettings) -> tuple[list[Row], dict]:
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
    turn = abs(np.degrees(at.rotation_rad - 0.0005))
    rows = [
        target_row("24 MP: parametric fit, s", fit_s, 120.0, ".1f"),
        Row("24 MP: one plane of Psi, s (25 of them)", f"{plane_s:.1f}"),
        Row("24 MP: free route, s a view beyond getting its frame", f"{free_s:.1f}"),
        target_row("24 MP: peak memory, GiB, five whiteboards held", memory_gib, 4.0, ".2f"),
        target_row("24 MP: distance d", abs(at.distance_share - 0.03) / 1.03, 0.005, ".4%"),
        target_row("24 MP: rotation, degrees", float(turn), 0.005, ".6f"),
    ]
    return rows, {"fit_seconds": fit_s, "plane_seconds": plane_s, "peak_gib": memory_gib}

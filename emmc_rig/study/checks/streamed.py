"""`calibrate SESSION --route free` of one shot at any size: memory, time and error of Psi."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.boards import channels_of
from calibration.frames import bands
from calibration.openings import views_open
from calibration.planning import Kind, PlannedFrames
from calibration.shadow import Shadow, shadow_mask
from calibration.whiteboard import LAMP_COLOURS
from drivers.dng import encode_dng
from drivers.raw import decode_raw
from emmc_rig.acquisition.expand import expand
from emmc_rig.errors import AppError
from emmc_rig.files.frames import PSI
from emmc_rig.files.psi import SavedPsi
from emmc_rig.model.camera import psi_layout
from emmc_rig.processing.bench import BOARD_LEVEL, FRAME_S
from emmc_rig.processing.board_plan import capture_plan, soft_design
from emmc_rig.processing.calibration_settings import CalibrateSettings
from emmc_rig.session.frame_file import frame_file
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Frozen, Session
from emmc_rig.study.checks.rows import Row, target_row

Array = NDArray[np.floating]
LARGEST_GIB = 4.0
COMPARED_ROWS = 32
PROGRAM = """\
import atexit, time
from emmc_rig.cli import main
from emmc_rig.files.memory import peak_memory_mib
atexit.register(lambda: print(peak_memory_mib(), time.process_time()))
main()
"""
"""The command, which prints its peak memory, MiB, and CPU seconds last."""


def check_streamed(settings: CalibrateSettings) -> tuple[list[Row], dict]:
    """A session of one shot, whiteboards of every view as drawn: the command, measured.

    The session is written beside the result, in the folder for temporary files. Raises AppError
    for sensors without colour filters, and where the command fails.
    """
    layout = psi_layout(settings.camera, settings.size)
    if layout.shots > 1 or layout.colour is None or layout.binning > 1:
        raise AppError("the streamed check is for cameras of one shot and a colour filter")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session, shadow = drawn_session(folder / "session", settings)
        peak_gib, cpu_s = _measured(session.folder, folder / "out")
        error = _error(folder / "out" / PSI, shadow, channels_of(layout))
    megapixels = settings.size[0] * settings.size[1] / 1e6
    label = f"free route of a session, {megapixels:.3g} MP"
    rows = [
        target_row(f"{label}: peak memory, GiB", peak_gib, LARGEST_GIB, ".2f"),
        Row(f"{label}: bytes a pixel", f"{peak_gib * 2**30 / megapixels / 1e6:.0f}"),
        Row(f"{label}: CPU time, s", f"{cpu_s:.1f}"),
        target_row(f"{label}: error of Psi", error, 0.02, ".2%"),
    ]
    return rows, {"peak_gib": peak_gib, "cpu_seconds": cpu_s, "error": error}


def _measured(session: Path, out: Path) -> tuple[float, float]:
    """Return peak memory, GiB, and CPU seconds of the command in a process of its own."""
    command = ["calibrate", str(session), "--route", "free", "--out", str(out)]
    child = subprocess.run(
        [sys.executable, "-c", PROGRAM, *command], capture_output=True, text=True, check=False
    )
    if child.returncode:
        raise AppError(f"emmc-rig {' '.join(command)} failed: {child.stderr.strip()[-500:]}")
    peak_mib, cpu_s = map(float, child.stdout.split()[-2:])
    return peak_mib / 2**10, cpu_s


def _error(path: Path, shadow: Shadow, channels: NDArray[np.uint8]) -> float:
    """Return the relative error of a stored Psi over the middle rows."""
    middle = channels.shape[0] // 4 * 2
    rows = slice(middle, middle + COMPARED_ROWS)
    found = SavedPsi(path).window(rows, slice(None)).weights[0, :, :, :, 0]
    missed = total = 0.0
    for view in np.ndindex(shadow.mask.views):
        true = _drawn(shadow, channels, rows, views_open(shadow.mask.views, view))
        missed += float(np.square(found[view] - true, dtype=np.float64).sum())
        total += float(np.square(true, dtype=np.float64).sum())
    return float(np.sqrt(missed / total))


def _drawn(
    shadow: Shadow,
    channels: NDArray[np.uint8],
    rows: slice,
    opened: NDArray[np.bool_],
    stage_um: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float32]:
    """Return what some rows read of a white board, (y, x)."""
    seen = channels[rows]
    pixels = np.moveaxis(np.mgrid[: seen.shape[0], : seen.shape[1]], 0, -1).reshape(-1, 2)
    read = shadow.readings(pixels + np.array([rows.start, 0]), seen.ravel(), opened, stage_um)
    return read.reshape(seen.shape).astype(np.float32)


def drawn_session(folder: Path, settings: CalibrateSettings) -> tuple[Session, Shadow]:
    """Return a session of every view, as a mask off its design draws it, and that mask's shadow.

    With shot and read noise; raises AppError where the folder cannot be made.
    """
    camera = settings.camera
    mask = shadow_mask(camera, settings.size)
    shadow = Shadow(mask, replace(soft_design(camera, mask), offset_x_um=14.0))
    views = [Kind((v, u)) for v, u in np.ndindex(camera.views)]
    plan = capture_plan(settings, PlannedFrames(dict.fromkeys(views, 1), 0.0))
    frames = expand(plan, camera, 0.0, 0.0)
    about = {"title": "drawn", "created": "", "command": "", "versions": {"emmc-rig": ""}}
    frozen = Frozen("", camera.model_dump(mode="json"), {}, frames)
    session = Session.create(folder, frozen, about)
    noise = camera.sensor.noise
    range_dn = noise.white_level_dn - noise.black_level_dn
    board_s = BOARD_LEVEL * range_dn / noise.gain_dn_per_electron / noise.electrons_per_s
    rng = np.random.default_rng(settings.seed)
    channels = channels_of(psi_layout(camera, settings.size))
    seconds, opened = 0.0, {}
    for planned in frames:
        if planned.kind == "shot":
            continue
        exposure_s = planned.exposure_s or board_s * planned.light
        seconds += exposure_s + FRAME_S
        # Open whiteboards are seen again and again, and the dearest to draw.
        key = planned.bench.lamp, planned.bench.masks_in, *planned.bench.offsets_um.items()
        reading = opened.get(key) if planned.view is None else None
        if reading is None:
            reading = _reading(planned, shadow, channels)
            if planned.view is None:
                opened[key] = reading
        electrons = reading * np.float32(noise.electrons_per_s * exposure_s)
        spread = np.sqrt(electrons + noise.read_noise_electrons**2)
        electrons += spread * rng.standard_normal(electrons.shape, dtype=np.float32)
        dn = noise.black_level_dn + noise.gain_dn_per_electron * electrons
        mosaic = np.clip(np.rint(dn), 0, noise.white_level_dn).astype(np.uint16)
        data = encode_dng(
            mosaic, camera.sensor.cfa_name, noise.black_level_dn, noise.white_level_dn, exposure_s
        )
        file = frame_file(decode_raw(data))
        facts = {**file.facts, "exposure_s": exposure_s, "gain": 1.0, "host_time_s": seconds}
        session.store(planned, file.suffix, file.data, file.sha256, lambda facts=facts: facts)
    return session, shadow


def _reading(planned: PlannedFrame, shadow: Shadow, channels: NDArray[np.uint8]) -> Array:
    """Return what pixels read of a whiteboard, (y, x)."""
    lamp = planned.bench.lamp
    if lamp == "off":
        return np.zeros(channels.shape, np.float32)
    if not planned.bench.masks_in:
        lit = np.ones(channels.shape, bool)
        if lamp in LAMP_COLOURS:
            lit = channels == LAMP_COLOURS.index(lamp)
        return lit.astype(np.float32)
    offsets = planned.bench.offsets_um
    stage_um = offsets.get("mask_x", 0.0), offsets.get("mask_y", 0.0)
    opened = views_open(shadow.mask.views, planned.view, planned.window)
    parts = [_drawn(shadow, channels, rows, opened, stage_um) for rows in bands(channels)]
    return np.concatenate(parts)

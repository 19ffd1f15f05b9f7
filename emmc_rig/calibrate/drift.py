"""`emmc-rig calibrate --drift`: does Psi still fit these captures, and the Psi that does.

Needs a calibration by a parametric route, with where the mask sat; the free route's Psi cannot be
moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.defects import mask_with_losses
from calibration.drift import Drift, DriftSettings, find_drift
from calibration.parametric import psi_at, shot_stages
from calibration.placement import SCALARS, Placement
from calibration.shadow import Shadow, ShadowMask, shadow_mask
from emmc_rig.calibrate.stored import CALIBRATION
from emmc_rig.errors import AppError
from emmc_rig.files.frames import FRAMES, PSI, read_frames
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.camera import Camera
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.sensing import ImagingMatrix


@dataclass(frozen=True, eq=False)
class Known:
    """A calibration on disk: Psi, its camera, and where the mask sat, with its defects."""

    psi: ImagingMatrix
    camera: Camera
    mask: ShadowMask
    placement: Placement


def read_calibration(folder: Path) -> Known:
    """Read a folder of `emmc-rig calibrate`; raises AppError when it is none, or damaged."""
    path = folder / CALIBRATION
    if not path.is_file() or not (folder / PSI).is_file():
        raise AppError(
            f"{folder}: holds no {CALIBRATION} and {PSI}; name a folder that `emmc-rig calibrate` "
            "wrote"
        )
    psi = ImagingMatrix.load(folder / PSI)
    camera = Camera.model_validate_json(psi.camera_json)
    with stored_arrays(path, AppError, "calibrate again") as stored:
        if "aperture" not in stored:
            raise AppError(
                f"{path}: this Psi is of the free route, which does not know where the mask "
                "sits; calibrate with --route parametric or mixed"
            )
        scalars = {name: float(np.asarray(stored.attributes[name])) for name in SCALARS}
        aperture = stored.array("aperture")
        lost = stored.array("lost") if "lost" in stored else None
    rows = tuple(tuple(map(float, row)) for row in aperture)
    placement = Placement(**scalars, aperture=rows)
    mask = shadow_mask(camera, psi.size)
    if lost is not None:
        mask = mask_with_losses(mask, placement, lost)
    return Known(psi, camera, mask, placement)


def run_drift(
    known_folder: Path, frames_folder: Path, out: Path, settings: DriftSettings | None = None
) -> dict:
    """Judge the frames of a folder against a calibration; write psi.h5 mended, and metrics.json.

    The mended Psi is written even where nothing has drifted: it is then the calibration's own.
    """
    known = read_calibration(known_folder)
    capture = read_frames(frames_folder)
    if capture.readings.shape != known.psi.frames_shape:
        raise AppError(
            f"{frames_folder / FRAMES}: {capture.readings.shape[0]} frames of "
            f"{capture.readings.shape[1]} x {capture.readings.shape[2]} pixels; this calibration "
            f"is for {known.psi.frames_shape}"
        )
    if known.psi.colour is None:
        raise AppError("a drift is sought on sensors with a colour filter")
    variance = np.full(capture.readings.shape, capture.noise_sigma**2)
    stages = shot_stages(known.camera)
    drift = find_drift(
        capture.readings,
        variance,
        capture.usable,
        known.psi.colour,
        known.mask,
        known.placement,
        stages,
        settings,
    )
    mended = known.psi
    if drift.drifted and not drift.beyond_search:
        mended = psi_at(Shadow(known.mask, drift.placement), known.psi.layout, stages)
    mended.save(out / PSI)
    metrics = {**_figures(drift), "command": command_line(), "versions": versions()}
    write_metrics(out, metrics)
    return metrics


def _figures(drift: Drift) -> dict:
    return {
        "drifted": drift.drifted,
        "words": drift.words,
        "beyond_search": drift.beyond_search,
        "displacement_px": drift.displacement_px,
        "by_kind_px": drift.by_kind_px,
        "values": drift.values,
        "deviations": drift.deviations,
        "chi2": drift.chi2,
        "probability": drift.probability,
        "status": drift.status,
    }

"""Scales on the disk: Psi in psi.h5, and beside it in calibration.h5 what makes its readings."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import h5py
import numpy as np

from emmc_rig.calibration.frames import MeanFrame, SensorGain
from emmc_rig.calibration.scale import MANY, Scale, designed_scale
from emmc_rig.errors import AppError
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.store.psi import PSI

CALIBRATION_FILE = "calibration.h5"
DARK_FACTS = tuple(f.name for f in fields(MeanFrame) if f.name != "mean_dn")


def write_scale(file: h5py.File, scale: Scale) -> None:
    """Write all of a scale but Psi into calibration.h5, open for writing."""
    file.attrs["gain_dn_per_electron"] = scale.gain.gain_dn_per_electron
    file.attrs["dark_variance_dn2"] = scale.gain.dark_variance_dn2
    file.attrs["shots"] = scale.shots
    file.attrs["darks"] = json.dumps(
        [{name: getattr(dark, name) for name in DARK_FACTS} for dark in scale.darks]
    )
    file["darks_dn"] = np.stack([dark.mean_dn for dark in scale.darks])
    file["white_dn_per_s"] = scale.white_dn_per_s
    file["good"] = scale.good


def open_scale(place: Path) -> Scale:
    """Return the scale of a folder of `emmc-rig calibrate`, or of the file of a Psi.

    A Psi without calibration.h5 beside it is scaled by its camera's noise model, which is coarser.
    Calibrations of version 0.4 and before hold one dark, as of every exposure. Raises AppError,
    SensingError or ModelError.
    """
    file = place / PSI if place.is_dir() else place
    if not file.is_file():
        raise AppError(f"{place}: no Psi; name a session, the folder of a calibration or psi.h5")
    psi, beside = ImagingMatrix.load(file), file.parent / CALIBRATION_FILE
    if not beside.is_file():
        return designed_scale(psi)
    with stored_arrays(beside, AppError, "calibrate again") as stored:
        attributes = stored.attributes
        gain = SensorGain(
            float(np.asarray(attributes["gain_dn_per_electron"])),
            float(np.asarray(attributes["dark_variance_dn2"])),
        )
        white = stored.array("white_dn_per_s")
        good = np.ones(white.shape[1:], dtype=bool)
        if "good" in stored:
            good = stored.array("good").astype(bool)
        if "darks" in attributes:
            facts = parse_json(str(attributes["darks"]), str(beside), ValueError)
            means = stored.array("darks_dn")
            darks = tuple(
                MeanFrame(mean, **{**known, "rows_dn2": tuple(known["rows_dn2"])})
                for mean, known in zip(means, facts, strict=True)
            )
            shots = tuple(int(shot) for shot in np.asarray(attributes["shots"]))
        else:
            darks = (MeanFrame(stored.array("dark_dn"), gain.dark_variance_dn2, MANY, 0.0),)
            shots = ()
    if white.shape != psi.frames_shape or (shots and len(shots) != psi.shots):
        raise AppError(f"{file}: does not fit the {CALIBRATION_FILE} beside it; calibrate again")
    return Scale(psi, white, darks, gain, good, shots)

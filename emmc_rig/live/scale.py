"""What turns the frames of a live camera into readings, from whatever holds a Psi."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.frames import MeanFrame, SensorGain
from emmc_rig.errors import AppError
from emmc_rig.files.folders import is_session
from emmc_rig.files.frames import PSI
from emmc_rig.model.camera import camera_of, pixel_light
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.session.measured_psi import Scale, session_scale
from emmc_rig.session.session import Session

CALIBRATION = "calibration.h5"
MANY = 1_000_000
"""Frames that an average stands for whose own noise is not known, and is left out."""


def open_scale(place: Path) -> Scale:
    """Return Psi and what turns frames into readings.

    place: a session, a folder of `emmc-rig calibrate`, or the file of a Psi. Without the frames of
    a calibration beside it a Psi is scaled by its camera's noise model, which is coarser. Raises
    AppError, SensingError or CalibrationError.
    """
    if is_session(place):
        return session_scale(Session(place))
    file = place / PSI if place.is_dir() else place
    if not file.is_file():
        raise AppError(
            f"{place}: no Psi; name a session, a folder of `emmc-rig calibrate` or psi.h5"
        )
    psi = ImagingMatrix.load(file)
    if not (file.parent / CALIBRATION).is_file():
        return designed_scale(psi)
    with stored_arrays(file.parent / CALIBRATION, AppError, "calibrate again") as stored:
        gain = SensorGain(
            float(np.asarray(stored.attributes["gain_dn_per_electron"])),
            float(np.asarray(stored.attributes["dark_variance_dn2"])),
        )
        dark_dn, white = stored.array("dark_dn"), stored.array("white_dn_per_s")
        good = stored.array("good").astype(bool) if "good" in stored else None
    if white.shape != psi.frames_shape:
        raise AppError(f"{file}: does not fit the {CALIBRATION} beside it; calibrate again")
    dark = MeanFrame(dark_dn, gain.dark_variance_dn2, MANY, 0.0)
    everywhere = np.ones(dark_dn.shape, dtype=bool)
    return Scale(psi, white, (dark,), gain, everywhere if good is None else good)


def designed_scale(psi: ImagingMatrix) -> Scale:
    """Return the scale of a Psi by its camera's noise model; raises AppError without a camera."""
    if not psi.camera_json:
        raise AppError("this Psi does not know its camera: name the folder of its calibration")
    camera = camera_of(psi)
    noise, shape = camera.sensor.noise, psi.frames_shape[1:]
    read_variance = (noise.gain_dn_per_electron * noise.read_noise_electrons) ** 2
    black = np.full(shape, noise.black_level_dn, dtype=np.float32)
    white = noise.gain_dn_per_electron * noise.electrons_per_s * pixel_light(camera, psi.size)
    return Scale(
        psi,
        white,
        (MeanFrame(black, read_variance, MANY, 0.0),),
        SensorGain(noise.gain_dn_per_electron, read_variance),
        np.ones(shape, dtype=bool),
    )

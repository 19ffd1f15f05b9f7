"""What a reconstruction starts from: a session or a folder of frames, Psi, and settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.files.folders import is_session
from emmc_rig.files.psi import PSI, open_psi, psi_beside, read_frames
from emmc_rig.model.arguments import path_of
from emmc_rig.model.frames import Frames
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import validated
from emmc_rig.session.readings import session_readings
from emmc_rig.session.session import Session
from reconstruction.methods import MethodSettings


def session_frames(folder: Path) -> tuple[ImagingMatrix, Frames]:
    """Return a session's shots, and the Psi of its whiteboards that they were normalised by.

    Raises AppError or CalibrationError.
    """
    taken = session_readings(Session(folder))
    return taken.psi, Frames(taken.readings, np.sqrt(taken.variance), taken.usable)


def open_frames(folder: str | Path, psi: str | Path | None = None) -> tuple[ImagingMatrix, Frames]:
    """Return Psi and the frames of a folder: a session, or what `simulate` or `demo` wrote.

    psi: the file of another imaging matrix (default: psi.h5 beside the frames; of a session, what
    its whiteboards measure). Raises AppError, SensingError, CalibrationError, or ArgumentError for
    what is no path.
    """
    takes = "the folder of a session, or one that `emmc-rig simulate` or `demo` wrote"
    folder = path_of(folder, "folder", takes)
    if psi is not None:
        psi = path_of(psi, "psi", "the file of an imaging matrix, psi.h5")
    if folder.is_file():
        raise AppError(
            f"{folder}: a file; open_frames takes {takes}; readings of your own are given to "
            "`reconstruct` as an array (shot, pixel_y, pixel_x)"
        )
    if is_session(folder):
        measured, frames = session_frames(folder)
        return measured if psi is None else open_psi(Path(psi)).load(), frames
    return open_psi(Path(psi or psi_beside(folder))).load(), read_frames(folder)


def stored_frames(folder: Path, out: Path, psi_path: Path | None) -> tuple[Frames, Path]:
    """Return the frames of a folder, and the file of their Psi: a session's is written to `out`."""
    if is_session(folder):
        measured, frames = session_frames(folder)
        measured.save(out / PSI)
        return frames, psi_path or out / PSI
    return read_frames(folder), psi_path or psi_beside(folder)


def load_settings(path: Path | None) -> MethodSettings:
    """Read method settings from YAML; misspelt keys name the nearest valid one."""
    if path is None:
        return MethodSettings()
    return validated(MethodSettings, read_yaml(path, AppError), str(path), AppError)

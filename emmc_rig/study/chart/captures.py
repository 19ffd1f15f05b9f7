"""The frames that all methods of a chart get: a scene through a camera, with noise, kept in a file.

They are made with the camera's designed Psi, which also reconstructs them, as in the paper: an
inverse crime, the same for every method, which `emmc-rig demo` avoids.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.model.files import whole_file
from emmc_rig.model.frames import Frames
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.study.sweep import check_size, digest_of
from emmc_rig.study.trial import Capture

Array = NDArray[np.floating]
SMALLEST_PX = 16


def kept_capture(capture: Capture, folder: Path) -> tuple[Path, str]:
    """Return the file of a capture's frames and truth, made where missing, and its digest.

    Raises AppError for a picture too small to be judged, and what `zoomed_scene` does.
    """
    check_size(capture.size, SMALLEST_PX)
    digest = digest_of(capture.identity())
    path = folder / f"{digest}.h5"
    if not path.is_file():
        folder.mkdir(exist_ok=True)
        scene, psi = capture.scene_seen(), capture.psi()
        shots = capture.described.expose(scene.light_field, capture.seed, psi)
        psi.save(path.with_suffix(".psi"))
        with whole_file(path) as partial, h5py.File(partial, "w") as file:
            file["truth"], file["readings"] = scene.light_field, shots.readings
            file["usable"], file["noise_sigma"] = shots.usable, shots.noise_sigma
            if scene.disparity_px is not None:
                file["disparity_px"] = scene.disparity_px
    return path, digest


def read_frames(path: Path) -> tuple[ImagingMatrix, Frames]:
    """Read what a method gets: Psi and the frames, all their readings of one typical deviation."""
    psi = ImagingMatrix.load(path.with_suffix(".psi"))
    with stored_arrays(path, AppError, "delete it, and it is made again") as stored:
        readings, usable, sigma = map(stored.array, ("readings", "usable", "noise_sigma"))
    return psi, Frames(readings, np.full(readings.shape, sigma), usable.astype(bool))


def read_truth(path: Path) -> tuple[Array, Array | None]:
    """Read the light field (v, u, y, x, c) and its disparity (y, x), None where not known."""
    with stored_arrays(path, AppError, "delete it, and it is made again") as stored:
        truth = stored.array("truth")
        disparity = stored.array("disparity_px") if "disparity_px" in stored else None
    return truth, disparity

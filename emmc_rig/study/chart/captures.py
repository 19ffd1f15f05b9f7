"""The frames that all methods of a chart get: a scene through a camera, with noise, kept in a file.

They are made with the camera's designed Psi, which also reconstructs them, as in the paper: an
inverse crime, the same for every method, which `emmc-rig demo` avoids.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.scenes import zoomed_scene
from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.files import whole_file
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.study.sweep import digest_of
from simulators.scenes import SCENES

Array = NDArray[np.floating]
SMALLEST_PX = 16


@dataclass(frozen=True)
class Capture:
    """A scene through a camera. camera: a shipped one, or a file.

    size: rows and columns; None takes all of a measured scene. zoom: a built-in scene is rendered
    so many times larger and cut, which makes its disparities as many times larger. shots, views:
    None takes the camera's own.
    """

    scene: str
    camera: str
    size: tuple[int, int] | None = None
    zoom: int = 1
    shots: int | None = None
    views: tuple[int, int] | None = None

    @property
    def scene_name(self) -> str:
        """The scene as charts call it."""
        return Path(self.scene).stem

    @property
    def camera_name(self) -> str:
        """The camera as charts call it."""
        return Path(self.camera).stem

    def described(self) -> Camera:
        """Return the camera; raises what `find_camera` does."""
        camera = find_camera(self.camera)
        if self.shots is not None:
            camera = camera.with_shots(self.shots)
        return camera if self.views is None else camera.model_copy(update={"views": self.views})

    def light_field(self, seed: int) -> tuple[Array, Array | None]:
        """Return the scene (v, u, y, x, c), and its disparity (y, x) where that is known.

        Raises AppError for a picture too small to be judged, and what `open_scene` does.
        """
        if self.size is not None and min(self.size) < SMALLEST_PX:
            raise AppError(
                f"--size {self.size[0]}x{self.size[1]}: needs {SMALLEST_PX}x{SMALLEST_PX} or more"
            )
        scene = zoomed_scene(self.scene, self.size, self.described().views, seed, self.zoom)
        return scene.light_field, scene.disparity_px


def kept_capture(capture: Capture, seed: int, folder: Path) -> tuple[Path, str]:
    """Return the file of a capture's frames and truth, made where missing, and its digest.

    Measured scenes are read again each time, as their files may have changed.
    """
    inputs: dict[str, object] = {
        "camera": capture.described().model_dump(mode="json"),
        "scene": capture.scene_name,
        "size": capture.size,
        "zoom": capture.zoom,
        "seed": seed,
    }
    seen = None
    if capture.scene not in SCENES:
        seen = capture.light_field(seed)
        inputs["sum"] = float(np.sum(seen[0], dtype=np.float64))
        inputs["squares"] = float(np.sum(np.square(seen[0]), dtype=np.float64))
    digest = digest_of(inputs)
    path = folder / f"{digest}.h5"
    if not path.is_file():
        folder.mkdir(exist_ok=True)
        _write(path, capture.described(), *(seen or capture.light_field(seed)), seed)
    return path, digest


def _write(
    path: Path, camera: Camera, light_field: Array, disparity_px: Array | None, seed: int
) -> None:
    psi = build_imaging_matrix(camera, (light_field.shape[2], light_field.shape[3]))
    shots = camera.expose(light_field, seed, psi)
    psi.save(path.with_suffix(".psi"))
    with whole_file(path) as partial, h5py.File(partial, "w") as file:
        file["truth"], file["readings"] = light_field, shots.readings
        file["usable"], file["noise_sigma"] = shots.usable, shots.noise_sigma
        if disparity_px is not None:
            file["disparity_px"] = disparity_px


def read_frames(path: Path) -> tuple[ImagingMatrix, Frames]:
    """Read what a method gets: Psi and the frames, all their readings of one typical deviation."""
    psi = ImagingMatrix.load(path.with_suffix(".psi"))
    with h5py.File(path, "r") as file:
        readings, usable, sigma = (
            np.asarray(file[name]) for name in ("readings", "usable", "noise_sigma")
        )
    return psi, Frames(readings, np.full(readings.shape, sigma), usable.astype(bool))


def read_truth(path: Path) -> tuple[Array, Array | None]:
    """Read the light field (v, u, y, x, c) and its disparity (y, x), None where not known."""
    with h5py.File(path, "r") as file:
        truth = np.asarray(file["truth"])
        disparity = np.asarray(file["disparity_px"]) if "disparity_px" in file else None
    return truth, disparity

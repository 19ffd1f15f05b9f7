"""Cameras found by name: a shipped one, or the YAML file of your own."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from emmc_rig.model.arguments import NAMES, required
from emmc_rig.model.camera import Camera, load_camera, shipped_camera_files
from emmc_rig.model.errors import CameraError, did_you_mean
from emmc_rig.model.settings import validated


def find_camera(spec: str | Path | Mapping[str, Any] | Camera, shots: int | None = None) -> Camera:
    """Return a shipped camera by its name, or the camera described by a YAML file or a dict.

    Args:
        spec: a shipped camera's name, the path of a YAML file, a dict with the keys of such a
            file, or a camera. In a dict, what a file lists may be arrays: a mask's pattern is
            (row, column) or (row, column, 3), transmittances in [0, 1], or booleans.
        shots: number of shots, see `Camera.with_shots` (default: those of the description).

    Raises:
        CameraError: no such camera (the message names the nearest shipped one), a file that cannot
            be read, a wrong description, more shots than the camera has a rule for.
        ArgumentError: a spec of another type, or shots that are no whole number.

    >>> import emmc_rig as emmc
    >>> emmc.camera("rgbw-bayer-1shot")
    Camera('RGBW mask, Bayer sensor, one shot', 1 shot, 5x5 views, rggb, 1 mask)
    >>> len(emmc.camera("rgbw-bayer-3shots", shots=2).shots)
    2
    >>> emmc.camera({"title": "no mask", "sensor": {"cfa": "mono"}})
    Camera('no mask', 1 shot, 5x5 views, mono, 0 masks)
    >>> cells = np.random.default_rng(0).random((64, 80)) < 0.5
    >>> code = {"distance_mm": 1.0, "cell_um": 24, "pattern": cells}
    >>> emmc.camera({"title": "mine", "masks": {"code": code}}).psi((24, 32))
    Psi(1 shot, 5x5 views, 24x32, mono, 0.23 MB)
    """
    if isinstance(spec, Camera):
        camera = spec
    elif isinstance(spec, Mapping):
        camera = validated(Camera, _plain(spec), "the camera", CameraError)
    else:
        takes = "a shipped camera's name, a YAML file's path, a dict as in such a file, or a camera"
        required(spec, NAMES, "camera", takes)
        camera = load_camera(camera_file(os.fspath(spec)))
    if shots is not None:
        required(shots, int, "shots", "a number of shots, such as 3")
    return camera if shots is None else camera.with_shots(shots)


def _plain(described: Any) -> Any:
    """Return a description with lists in place of arrays, 0 and 1 in place of booleans in them."""
    if isinstance(described, np.ndarray):
        return (described * 1 if described.dtype == bool else described).tolist()
    if isinstance(described, np.generic):
        return described.item()
    if isinstance(described, Mapping):
        return {key: _plain(value) for key, value in described.items()}
    if isinstance(described, (list, tuple)):
        return [_plain(value) for value in described]
    return described


def camera_file(spec: str) -> Path:
    """Return the YAML file of a shipped camera by its name, or of one's own by its path.

    Raises CameraError naming the nearest shipped camera when there is none.
    """
    path = Path(spec)
    if path.suffix.lower() in (".yaml", ".yml") or os.sep in spec or "/" in spec:
        return path
    shipped = shipped_camera_files()
    if spec in shipped:
        return shipped[spec]
    raise CameraError(
        f"no camera is called '{spec}': {did_you_mean(spec.lower(), shipped)}a camera of "
        "your own is given by the path of its .yaml file",
        "list-cameras",
    )

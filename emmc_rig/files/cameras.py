"""Cameras found by name: a shipped one, or the YAML file of your own."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from emmc_rig.model.camera import Camera, load_camera, shipped_camera_files
from emmc_rig.model.errors import CameraError


def find_camera(spec: str, shots: int | None = None) -> Camera:
    """Return a shipped camera by its name, or the camera described by a YAML file.

    shots: how many (default: the camera's own). Raises CameraError naming the nearest shipped
    camera when there is none, and for more shots than the camera has a rule for.

    >>> import emmc_rig as emmc
    >>> emmc.camera("rgbw-bayer-1shot")
    Camera('RGBW mask, Bayer sensor, one shot', 1 shot, 5x5 views, rggb, 1 mask)
    >>> len(emmc.camera("rgbw-bayer-3shots", shots=2).shots)
    2
    """
    camera = load_camera(camera_file(spec))
    return camera if shots is None else camera.with_shots(shots)


def camera_file(spec: str) -> Path:
    """Return the YAML file of a shipped camera by its name, or of one's own by its path.

    Raises CameraError naming the nearest shipped camera when there is none.
    """
    path = Path(spec)
    if path.suffix.lower() in (".yaml", ".yml") or os.sep in spec:
        return path
    shipped = shipped_camera_files()
    if spec in shipped:
        return shipped[spec]
    near = difflib.get_close_matches(spec.lower(), shipped, n=1, cutoff=0.5)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise CameraError(
        f"no camera is called '{spec}': {hint}`emmc-rig cameras` lists them; "
        "a camera of your own is given by the path of its .yaml file"
    )

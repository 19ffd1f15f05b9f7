"""The files of a result, written and read here alone.

light_field.h5, maps.h5   the light field; the maps of the method, and its `misfit`
result.zarr               both as one Zarr group, in their place
metrics.json              figures, verdict, and what made them
frames.h5, psi.h5         what the light field was reconstructed from, where it is kept
report.html               the page for people
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, camera_of
from emmc_rig.model.errors import SensingError
from emmc_rig.model.json_text import one_line, parse_json
from emmc_rig.model.lightfield import load_hdf5, load_view_axes, save_hdf5
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.view_axes import ANGLES, ATTRIBUTE, ViewAxes, axes_from, stored_as
from emmc_rig.store.folders import SESSION_RECONSTRUCTION, is_session, refuse_missing
from emmc_rig.store.psi import StoredPsi, holds_frames, psi_places
from emmc_rig.store.results import METRICS
from emmc_rig.store.shards import load_light_field, stored_shards

LIGHT_FIELD, MAPS, RESULT_GROUP, REPORT = (
    "light_field.h5", "maps.h5", "result.zarr", "report.html",
)  # fmt: skip
AGAIN = "copy the folder again, or reconstruct it again"


@dataclass(frozen=True, eq=False)
class SavedResult:
    """What the folder of a result holds; metrics: empty where metrics.json cannot be read."""

    folder: Path
    light_field: NDArray[np.float32]
    maps: Mapping[str, NDArray]
    metrics: Mapping[str, Any]
    view_axes: ViewAxes


def holds_light_field(folder: Path) -> bool:
    """Return whether a folder is that of a result."""
    return (folder / LIGHT_FIELD).is_file() or (folder / RESULT_GROUP).is_dir()


def result_in(folder: Path) -> Path:
    """Return the folder of a result, of a session that in it.

    Raises AppError for a session that is not reconstructed, a folder of frames, and a film.
    """
    place = folder / SESSION_RECONSTRUCTION if is_session(folder) else folder
    if holds_light_field(place):
        return place
    refuse_missing(folder, "name the folder of a result, or a session")
    if (place / "frames").is_dir() and (place / METRICS).is_file():
        raise AppError(f"{place}: a film; open a frame of it, such as {place}/frames/000000")
    if is_session(folder):
        raise AppError(f"{folder}: not reconstructed yet", "reconstruct", folder)
    if holds_frames(folder):
        raise AppError(f"{folder}: holds frames, no light field yet", "reconstruct", folder)
    raise AppError(f"{folder}: holds no light field, neither {LIGHT_FIELD} nor {RESULT_GROUP}")


def read_result(folder: Path) -> SavedResult:
    """Read the light field, maps and figures of a result; raises AppError or SceneError."""
    maps, metrics = {}, {}
    with suppress(AppError):
        metrics = read_metrics(folder)
    if (folder / LIGHT_FIELD).is_file():
        light_field, axes = load_hdf5(folder / LIGHT_FIELD), load_view_axes(folder / LIGHT_FIELD)
        if (folder / MAPS).is_file():
            with stored_arrays(folder / MAPS, AppError, AGAIN) as stored:
                maps = {name: stored.array(name) for name in map(str, stored.file)}
    else:
        group = folder / RESULT_GROUP
        light_field = load_light_field(group)
        with stored_shards(group, AppError, AGAIN) as stored:
            axes = axes_from(stored.attributes.get(ATTRIBUTE), group, AppError)
            maps = {name: stored.array(name) for name in stored.names() if name != "light_field"}
    return SavedResult(folder, light_field, maps, metrics, axes)


def camera_of_result(saved: SavedResult) -> Camera | None:
    """Return the camera of a result's Psi, whose head alone is read; None without that Psi."""
    of_film, sha256 = "segment" in saved.metrics, saved.metrics.get("psi_sha256")
    for place in psi_places(saved.folder, saved.metrics):
        with suppress(SensingError, AppError):
            psi = StoredPsi(place)
            if psi.camera_json and (of_film or sha256 in (None, psi.checksum)):
                return camera_of(psi)
    return None


def read_metrics(folder: Path) -> dict[str, Any]:
    """Return what metrics.json of a folder says; raises AppError where it cannot be read."""
    path = folder / METRICS
    try:
        known = parse_json(path.read_bytes(), METRICS, ValueError)
        if not isinstance(known, dict):
            raise ValueError("no object of JSON")
    except (OSError, ValueError) as fault:
        raise AppError(
            f"{path}: cannot be read ({one_line(fault)}); copy the folder again, or make it again"
        ) from fault
    return known


def write_light_field(
    folder: Path,
    light_field: NDArray,
    maps: Mapping[str, NDArray],
    view_axes: ViewAxes = ANGLES,
    **facts: str | float,
) -> None:
    """Write the light field, with facts of it, and its maps into an existing folder."""
    save_hdf5(folder / LIGHT_FIELD, light_field, {**facts, ATTRIBUTE: stored_as(view_axes)})
    with h5py.File(folder / MAPS, "w") as file:
        file.attrs[ATTRIBUTE] = stored_as(view_axes)
        for name, values in maps.items():
            file.create_dataset(name, data=values)  # their noise does not compress

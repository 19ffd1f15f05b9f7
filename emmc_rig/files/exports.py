"""What is exported: a folder of a result, or a scene by its name, with all maps that it has."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import h5py
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.formats.format import Export
from emmc_rig.files.psi import FRAMES
from emmc_rig.files.results import METRICS
from emmc_rig.files.scenes import fine_scene, open_scene, path_in
from emmc_rig.model.errors import SceneError, nearest_of
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.lightfield import load_hdf5, load_view_axes
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.view_axes import ANGLES, ATTRIBUTE, ViewAxes, stored_as
from emmc_rig.store.folders import SESSION_RECONSTRUCTION, is_session
from simulators.scenes import SCENES

LIGHT_FIELD, MAPS = "light_field.h5", "maps.h5"
"""Of a result's folder."""


def open_export(spec: str, truth: str | None = None, size: tuple[int, int] | None = None) -> Export:
    """Open a result's folder, a session's reconstruction, or a scene, see `open_scene`.

    truth: the scene that was captured, to compare with. size: of a scene, see `open_scene`; results
    keep theirs. Raises AppError or SceneError.
    """
    folder = path_in(spec)
    axes = ANGLES
    if is_session(folder):
        folder = folder / SESSION_RECONSTRUCTION
        if not (folder / LIGHT_FIELD).is_file():
            raise AppError(f"{spec}: not reconstructed yet", "reconstruct", spec)
    if (folder / LIGHT_FIELD).is_file():
        light_field, maps = load_hdf5(folder / LIGHT_FIELD), read_maps(folder)
        axes = load_view_axes(folder / LIGHT_FIELD)
        metrics = _metrics(folder)
        caption = _caption(metrics)
    elif (folder / FRAMES).is_file():
        raise AppError(f"{spec}: holds frames to reconstruct first", "reconstruct", spec)
    elif not folder.exists() and spec not in SCENES:
        near = nearest_of(spec, SCENES)
        raise AppError(f"no folder or file '{spec}', and no built-in scene: {near}")
    else:
        scene = open_scene(spec, size)
        light_field, caption, metrics = scene.light_field, scene.provenance, {}
        maps = {} if scene.disparity_px is None else {"disparity": scene.disparity_px}
    true = None
    if truth is not None:
        true = _true(truth, light_field.shape, metrics)
        if true.shape != light_field.shape:
            raise SceneError(f"{truth}: shape {true.shape}, but {spec} has {light_field.shape}")
    fitting = {name: values for name, values in maps.items() if _fits(values, light_field.shape)}
    return Export(
        folder.resolve().name, caption, light_field, true, metrics=metrics, source=spec, **{
            name: fitting.get(name) for name in ("disparity", "sigma", "misfit")
        }, view_axes=axes,
    )  # fmt: skip


def _true(spec: str, shape: tuple[int, ...], metrics: dict) -> NDArray:
    """Return a scene's light field as a result's capture averaged it: `demo` draws it finer."""
    size, views = (shape[2], shape[3]), (shape[0], shape[1])
    match metrics:
        case {"scene": scene, "finer": [int(a), int(p)], "seed": int(seed)} if scene == spec:
            return fine_scene(spec, a, p, size, views, seed).scene.light_field
    return open_scene(spec, size, views).light_field


def read_maps(folder: Path) -> dict[str, NDArray]:
    """Return the maps of a result's folder by name; empty where it has none."""
    if not (folder / MAPS).is_file():
        return {}
    with stored_arrays(folder / MAPS, AppError, "reconstruct it again") as stored:
        return {name: stored.array(name) for name in map(str, stored.file)}


def save_maps(folder: Path, maps: Mapping[str, NDArray], view_axes: ViewAxes = ANGLES) -> None:
    """Write the maps of a result into its folder."""
    with h5py.File(folder / MAPS, "w") as file:
        file.attrs[ATTRIBUTE] = stored_as(view_axes)
        for name, values in maps.items():
            file.create_dataset(name, data=values)  # their noise does not compress


def _fits(values: NDArray, shape: tuple[int, ...]) -> bool:
    return values.shape in (shape[2:4], shape[:4])


def _metrics(folder: Path) -> dict[str, object]:
    """Return metrics.json of a result; empty where it cannot be read."""
    with suppress(OSError, ValueError):
        known = parse_json((folder / METRICS).read_bytes(), METRICS, ValueError)
        if isinstance(known, dict):
            return known
    return {}


def _caption(metrics: Mapping[str, object]) -> str:
    parts = [f"reconstructed by {metrics.get('method', 'an unknown method')}"]
    if isinstance(psnr := metrics.get("psnr_db"), float):
        parts.append(f"{psnr:.2f} dB against the truth")
    if isinstance(verdict := metrics.get("verdict"), Mapping):
        parts.append(f"verdict: {verdict.get('level')}")
    return "; ".join(parts)

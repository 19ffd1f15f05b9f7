"""Light fields for export: a result's folder, or a scene by its name, with all their maps; films.

A film is a folder of results of `reconstruct`, in their places in time:

OUT/
    metrics.json       "film": frames, their number; rate, Hz; times_s, of every frame
    frames/000007/     the result of frame 7; a frame that could not be made has none
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.formats.format import Export, Film
from emmc_rig.formats.scenes import fine_scene, open_scene, path_in
from emmc_rig.model.errors import SceneError, nearest_of
from emmc_rig.model.json_text import one_line
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.view_axes import ANGLES
from emmc_rig.simulators.scenes import SCENES
from emmc_rig.store.folders import SESSION_RECONSTRUCTION, Listing, is_session
from emmc_rig.store.psi import holds_frames
from emmc_rig.store.result_files import (
    AGAIN,
    LIGHT_FIELD,
    camera_of_result,
    holds_light_field,
    read_metrics,
    read_result,
    result_in,
)
from emmc_rig.store.results import METRICS

FRAMES = "frames"


def open_export(spec: str, truth: str | None = None, size: tuple[int, int] | None = None) -> Export:
    """Open a result's folder, a session's reconstruction, or a scene, see `open_scene`.

    truth: the scene that was captured, to compare with. size: of a scene, see `open_scene`; results
    keep theirs. Raises AppError or SceneError.
    """
    folder = path_in(spec)
    axes, camera = ANGLES, None
    if is_session(folder) or holds_frames(folder) or holds_light_field(folder):
        folder = result_in(folder)
        saved = read_result(folder)
        light_field, maps, axes = saved.light_field, saved.maps, saved.view_axes
        metrics, camera = saved.metrics, camera_of_result(saved)
        caption = _caption(metrics)
    elif not folder.exists() and spec not in SCENES:
        near = nearest_of(spec, SCENES)
        raise AppError(f"no folder or file '{spec}', and no built-in scene: {near}")
    else:
        scene = open_scene(spec, size)
        light_field, caption, maps, metrics = scene.light_field, scene.provenance, scene.maps, {}
    true = None
    if truth is not None:
        true = _true(truth, light_field.shape, metrics)
        if true.shape != light_field.shape:
            raise SceneError(f"{truth}: shape {true.shape}, but {spec} has {light_field.shape}")
    fitting = {name: values for name, values in maps.items() if _fits(values, light_field.shape)}
    return Export(
        folder.resolve().name, caption, light_field, true, metrics=metrics, source=spec, **{
            name: fitting.get(name) for name in ("disparity", "disparity_sigma", "sigma", "misfit")
        }, view_axes=axes, camera=camera,
    )  # fmt: skip


def _true(spec: str, shape: tuple[int, ...], metrics: Mapping[str, Any]) -> NDArray:
    """Return a scene's light field as a result's capture averaged it: `demo` draws it finer."""
    size, views = (shape[2], shape[3]), (shape[0], shape[1])
    match metrics:
        case {"scene": scene, "finer": [int(a), int(p)], "seed": int(seed)} if scene == spec:
            return fine_scene(spec, a, p, size, views, seed).scene.light_field
    return open_scene(spec, size, views).light_field


def _fits(values: NDArray, shape: tuple[int, ...]) -> bool:
    return values.shape in (shape[2:4], shape[:4])


def _caption(metrics: Mapping[str, object]) -> str:
    parts = [f"reconstructed by {metrics.get('method', 'an unknown method')}"]
    if isinstance(psnr := metrics.get("psnr_db"), float):
        parts.append(f"{psnr:.2f} dB against the truth")
    if isinstance(verdict := metrics.get("verdict"), Mapping):
        parts.append(f"verdict: {verdict.get('level')}")
    return "; ".join(parts)


def film_of(spec: str) -> Film | None:
    """Return the film that a result, or that of a session, is; None for a single light field."""
    folder = path_in(spec)
    folder = folder / SESSION_RECONSTRUCTION if is_session(folder) else folder
    holds = (folder / METRICS).is_file() and (folder / FRAMES).is_dir()
    return open_film(folder) if holds else None


def open_film(folder: Path) -> Film:
    """Open a film; raises AppError for no film, or a film with missing files."""
    rate, times_s = _times(folder)
    listing = Listing.read(folder)
    gone = [name for name in listing.files if not (folder / name).is_file()] if listing else []
    if gone:
        raise AppError(f"{folder}: {gone[0]} is missing; {AGAIN}")
    paths = ((place, folder / FRAMES / f"{place:06d}") for place in range(len(times_s)))
    frames = {place: path for place, path in paths if path.is_dir()}
    if not frames:
        raise AppError(f"{folder}: a film without a frame; {AGAIN}")
    with stored_arrays(next(iter(frames.values())) / LIGHT_FIELD, AppError, AGAIN) as stored:
        shape = tuple(stored.dataset("light_field").shape)
    return Film(folder, rate, times_s, frames, shape, open_export)


def _times(folder: Path) -> tuple[float, tuple[float, ...]]:
    """Return the rate, Hz, and the times of all places, s, that metrics.json has."""
    known = read_metrics(folder)
    try:
        about = known["film"]
        count, rate = int(about["frames"]), float(about["rate"])
        times_s = tuple(float(time_s) for time_s in about["times_s"])
        if not (rate > 0 and count == len(times_s)):
            raise ValueError(f"it states {len(times_s)} times for {count} frames at {rate:g} Hz")
    except (ValueError, KeyError, TypeError) as fault:
        what = f"{folder / METRICS}: not that of a film ({one_line(fault)})"
        raise AppError(f"{what}; {AGAIN}") from fault
    return rate, times_s

"""What is exported: a folder of a result, or a scene by its name, with all maps that it has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.formats.format import Export
from emmc_rig.files.psi import holds_frames
from emmc_rig.files.result_files import holds_light_field, read_result, result_in
from emmc_rig.files.scenes import fine_scene, open_scene, path_in
from emmc_rig.model.errors import SceneError, nearest_of
from emmc_rig.model.view_axes import ANGLES
from emmc_rig.store.folders import is_session
from simulators.scenes import SCENES


def open_export(spec: str, truth: str | None = None, size: tuple[int, int] | None = None) -> Export:
    """Open a result's folder, a session's reconstruction, or a scene, see `open_scene`.

    truth: the scene that was captured, to compare with. size: of a scene, see `open_scene`; results
    keep theirs. Raises AppError or SceneError.
    """
    folder = path_in(spec)
    axes = ANGLES
    if is_session(folder) or holds_frames(folder) or holds_light_field(folder):
        folder = result_in(folder)
        saved = read_result(folder)
        light_field, maps, axes = saved.light_field, saved.maps, saved.view_axes
        metrics = saved.metrics
        caption = _caption(metrics)
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

"""Scenes opened by name: a folder of views, an HDF5 file or a built-in name.

A built-in name wins over a folder of that name; write `./dark` for the folder.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from emmc_rig.formats.light_field_array import LightFieldArray
from emmc_rig.formats.registry import FORMATS
from emmc_rig.model.arguments import NAMES, numbers_of, pair_of, required
from emmc_rig.model.errors import SceneError, ViewOrderWarning, did_you_mean
from emmc_rig.model.lightfield import (
    check_light_field,
    load_hdf5,
    load_view_axes,
    load_views,
    shifted,
)
from emmc_rig.model.notebook import figure_html, light_field_pictures
from emmc_rig.model.view_axes import ANGLES, shows_parallax
from emmc_rig.model.view_order import ViewOrder, order_of
from emmc_rig.simulators.raycaster import World
from emmc_rig.simulators.scenes import SCENES, render
from emmc_rig.store import shards

APERTURE_FACTOR, PIXEL_FACTOR = 2, 2
"""How much finer the simulated rig sees a scene than it is reconstructed, along each axis."""
_DEFAULT_VIEWS, _DEFAULT_SIZE_PX = (5, 5), (192, 256)
_HDF5_ENDINGS = (".h5", ".hdf5")
BY_PARALLAX = "@by-parallax"
"""After the name of a folder or file: its views are put into the order that parallax shows."""


@dataclass(frozen=True)
class Scene(LightFieldArray):
    """A light field (v, u, y, x, 3) with its origin, and its disparity if known.

    NumPy takes a scene as its light field: `psi @ scene`, `scene[2, 2]`.

    name: the built-in name, the name of the folder or file without its ending, or "array".
    light_field: (v, u, y, x, 3), linear RGB in [0, 1].
    disparity_px: (y, x), pixels per view step, of the centre view. None for light fields of files
    and arrays, and for the truths of simulated captures.
    provenance: where the light field comes from, in words.
    """

    name: str
    light_field: np.ndarray
    disparity_px: np.ndarray | None
    provenance: str

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of every view."""
        return self.light_field.shape[2], self.light_field.shape[3]

    @property
    def views(self) -> tuple[int, int]:
        """Rows and columns of views."""
        return self.light_field.shape[0], self.light_field.shape[1]

    @property
    def maps(self) -> dict[str, np.ndarray]:
        """The disparity, by that name, if it is known."""
        return {} if self.disparity_px is None else {"disparity": self.disparity_px}

    def _repr_html_(self) -> str:
        return figure_html(repr(self), light_field_pictures(self.light_field, self.disparity_px))

    def __repr__(self) -> str:
        (v, u), (rows, columns) = self.views, self.size
        return f"Scene({self.name!r}, {v}x{u} views of {rows}x{columns})"


@dataclass(frozen=True)
class FineScene:
    """A scene on the grid a capture is simulated on, finer than the one it is reconstructed on.

    `samples` is (v a, u a, y p, x p, 3) for `aperture_factor` a and `pixel_factor` p;
    `scene.light_field` is its box average over a x a views and p x p pixels: the truth. Its
    disparity is not computed.
    """

    scene: Scene
    samples: np.ndarray
    aperture_factor: int
    pixel_factor: int


def open_scene(
    spec: str | Path | ArrayLike,
    size: tuple[int, int] | None = None,
    views: tuple[int, int] | None = None,
    seed: int = 0,
) -> Scene:
    """Return a scene: a built-in one, the light field of a folder or file, or an array.

    Args:
        spec: a built-in name, such as "deep-occlusions"; a folder of `view_ROW_COL.png` (or `.tif`,
            `.exr`); a file or folder with `light_field` (`.h5`, `.hdf5`, `.zarr`), or of another
            readable format (`.mat`, `NAME_VxU_eslf.png`, OME-Zarr); or an array (v, u, y, x, 3)
            of linear RGB in [0, 1]. Views whose parallax contradicts their names stay as named,
            with a ViewOrderWarning; `NAME@by-parallax` reorders them.
        size: (rows, columns) of pixels. A built-in scene is rendered at this size, by default
            (192, 256); of other scenes the middle is cut out, by default all is kept.
        views: (rows, columns) of views, likewise, by default (5, 5) or all.
        seed: random seed of a built-in scene; other scenes ignore it.

    Raises:
        SceneError: no scene of that name (the message lists the built-in ones), a folder or file
            that cannot be read, fewer pixels or views than requested, an array of another shape or
            with values outside [0, 1].
        ArgumentError: an argument of another type.

    >>> import emmc_rig as emmc
    >>> emmc.scene("near-planar", size=(24, 32))
    Scene('near-planar', 5x5 views of 24x32)
    """
    if size is not None:
        size = pair_of(size, "size", "rows and columns, such as (192, 256)")
    if views is not None:
        views = pair_of(views, "views", "rows and columns of views, such as (5, 5)")
    required(seed, int, "seed", "a whole number")
    if not isinstance(spec, NAMES):
        values = numbers_of(
            spec, "scene", "a name, a folder or file, or an array (v, u, y, x, 3) in [0, 1]"
        )
        light_field, cut = _middle(check_light_field(values, "scene"), size, views, "scene")
        return Scene("array", light_field, None, f"an array{cut}")
    spec = os.fspath(spec)
    if spec in SCENES:
        shape = _asked_shape(size, views)
        rendered = render(spec, *shape, seed)
        return Scene(
            spec, rendered.light_field, rendered.disparity_px, _described(spec, *shape, seed)
        )
    light_field, kept = _measured(spec)
    light_field, cut = _middle(light_field, size, views, spec)
    return Scene(path_in(spec).resolve().stem, light_field, None, f"{kept}{cut}")


def path_in(spec: str) -> Path:
    """Return the path that names a measured scene, without BY_PARALLAX."""
    path = Path(spec)
    return path if path.exists() else Path(spec.removesuffix(BY_PARALLAX))


def zoomed_scene(
    spec: str,
    size: tuple[int, int] | None,
    views: tuple[int, int],
    seed: int = 0,
    zoom: int = 1,
    change: Callable[[World], World] | None = None,
) -> Scene:
    """Open the middle of a scene, a built-in one rendered `zoom` times larger before it is cut.

    That makes its disparities as many times larger. size: rows and columns of what is returned;
    None takes all of a measured scene, and no zoom. change: of a built-in scene's world, see
    `simulators.changes`. Raises the errors of `open_scene`, and SceneError for a change of a
    measured scene.
    """
    if spec not in SCENES:
        if change is not None:
            raise SceneError(f"{spec}: only built-in scenes can be changed")
        return open_scene(spec, size, views, seed)
    rows, columns = size or _DEFAULT_SIZE_PX
    zoom = zoom if size is not None else 1
    rendered = render(spec, views, (rows * zoom, columns * zoom), seed, change)
    top, left = rows * (zoom - 1) // 2, columns * (zoom - 1) // 2
    cut = slice(top, top + rows), slice(left, left + columns)
    return Scene(
        spec,
        np.ascontiguousarray(rendered.light_field[:, :, *cut]),
        rendered.disparity_px[cut],
        _described(spec, views, (rows, columns), seed),
    )


def fine_scene(
    spec: str,
    aperture_factor: int,
    pixel_factor: int,
    size: tuple[int, int] | None = None,
    views: tuple[int, int] | None = None,
    seed: int = 0,
    time_s: float = 0.0,
) -> FineScene:
    """Open a scene for simulating a capture.

    A built-in scene is rendered on the finer grid, and its truth is the box average. A measured
    scene has nothing between its views: each is held constant over the aperture cell, so
    `aperture_factor` comes back 1 whatever was asked (one view stands for all a x a of a cell);
    its pixels are interpolated by a cubic whose p x p block means are the measured samples.

    aperture_factor, pixel_factor: fine views per view and fine pixels per pixel, along each axis.
    time_s: in a built-in scene that moves. spec, seed: as for `open_scene`, likewise size and
    views, on the coarse grid. Raises SceneError as `open_scene`, and for a factor below 1.
    """
    if min(aperture_factor, pixel_factor) < 1:
        raise SceneError(
            f"{spec}: cannot refine by {aperture_factor} in the aperture and {pixel_factor} in "
            "the picture; factors are 1 or more"
        )
    if spec not in SCENES:
        scene = open_scene(spec, size, views=views)
        return FineScene(scene, _interpolated(scene.light_field, pixel_factor), 1, pixel_factor)
    (height, width), (n_v, n_u) = _asked_shape(size, views)[::-1]
    fine_views = n_v * aperture_factor, n_u * aperture_factor
    fine_size = height * pixel_factor, width * pixel_factor
    samples = render(spec, fine_views, fine_size, seed, time_s=time_s).light_field
    truth = box_average(samples, aperture_factor, pixel_factor)
    provenance = (
        f"{_described(spec, (n_v, n_u), (height, width), seed)}, the average of "
        f"{aperture_factor}x{aperture_factor} views and {pixel_factor}x{pixel_factor} pixels"
    )
    scene = Scene(spec, truth, None, provenance)
    return FineScene(scene, samples, aperture_factor, pixel_factor)


def box_average(samples: np.ndarray, aperture_factor: int, pixel_factor: int) -> np.ndarray:
    """Average blocks of views and pixels: (v a, u a, y p, x p, c) -> (v, u, y, x, c) float32."""
    a, p = aperture_factor, pixel_factor
    fine_v, fine_u, fine_y, fine_x, colours = samples.shape
    averaged = np.empty((fine_v // a, fine_u // a, fine_y // p, fine_x // p, colours), np.float32)
    for v, u in np.ndindex(averaged.shape[:2]):
        cell = samples[v * a : (v + 1) * a, u * a : (u + 1) * a].mean(axis=(0, 1))
        averaged[v, u] = cell.reshape(fine_y // p, p, fine_x // p, p, colours).mean(axis=(1, 3))
    return averaged


def _asked_shape(
    size: tuple[int, int] | None, views: tuple[int, int] | None
) -> tuple[tuple[int, int], tuple[int, int]]:
    return views or _DEFAULT_VIEWS, size or _DEFAULT_SIZE_PX


def _described(name: str, views: tuple[int, int], size: tuple[int, int], seed: int) -> str:
    return (
        f"built-in scene '{name}', seed {seed}, {views[0]}x{views[1]} views "
        f"of {size[0]}x{size[1]} pixels"
    )


def _measured(spec: str) -> tuple[np.ndarray, str]:
    """The light field in a folder or file, and a sentence about it."""
    path, axes = path_in(spec), ANGLES
    held = next((form for form in FORMATS.values() if form.holds and form.holds(path)), None)
    if held is not None and held.read is not None:
        light_field = check_light_field(held.read(path), spec)
        kind = f"{held.name} {'folder' if path.is_dir() else 'file'}"
    elif path.is_dir() and path.suffix == shards.ENDING:
        light_field, kind = shards.load_light_field(path), "file"
    elif path.is_dir():
        light_field, kind = load_views(path), "folder"
    elif path.suffix.lower() in _HDF5_ENDINGS:
        light_field, kind, axes = load_hdf5(path), "file", load_view_axes(path)
    elif path.exists():
        raise SceneError(
            f"{spec}: a scene file ends in .h5, .hdf5 or .mat, or is an ESLF picture named "
            "NAME_VxU_eslf.png; other pictures come as a folder"
        )
    else:
        raise SceneError(
            f"no scene '{spec}': no such folder or file, and no built-in scene; "
            f"{did_you_mean(spec, SCENES)}built in are {', '.join(SCENES)}"
        )
    n_v, n_u, height, width, _ = light_field.shape
    described = f"{kind} {path.resolve()}, {n_v}x{n_u} views of {height}x{width} pixels"
    order = order_of(light_field) if shows_parallax(axes) else ViewOrder.AS_NAMED
    if order == ViewOrder.AS_NAMED:
        return light_field, described
    described += f": {order.words}, as their parallax shows"
    if path != Path(spec):
        return order.arranged(light_field), f"{described}; put right"
    remedy = f"open it as {spec}{BY_PARALLAX} to put them right"
    warnings.warn(
        f"{spec}: {order.words}, as their parallax shows; {remedy}", ViewOrderWarning, stacklevel=3
    )
    return light_field, described


def _middle(
    light_field: np.ndarray,
    size: tuple[int, int] | None,
    views: tuple[int, int] | None,
    spec: str,
) -> tuple[np.ndarray, str]:
    """Cut the middle views and pixels; the centre view stays the centre view."""
    has_views, has_size = light_field.shape[:2], light_field.shape[2:4]
    wanted = *(views or has_views), *(size or has_size)
    if any(w < 1 or w > has for w, has in zip(wanted, light_field.shape[:4], strict=True)):
        raise SceneError(
            f"{spec}: has {has_views[0]}x{has_views[1]} views of {has_size[0]}x{has_size[1]} "
            f"pixels, fewer than the {wanted[0]}x{wanted[1]} of {wanted[2]}x{wanted[3]} asked for"
        )
    if wanted == light_field.shape[:4]:
        return light_field, ""
    starts = [has // 2 - w // 2 for w, has in zip(wanted, light_field.shape[:4], strict=True)]
    kept = tuple(slice(s, s + w) for s, w in zip(starts, wanted, strict=True))
    cut = f", its middle {wanted[0]}x{wanted[1]} of {wanted[2]}x{wanted[3]}"
    return np.ascontiguousarray(light_field[kept]), cut


def _interpolated(light_field: np.ndarray, pixel_factor: int) -> np.ndarray:
    """Every view on a finer pixel grid: (v, u, y, x, c) -> (v, u, y p, x p, c)."""
    if pixel_factor == 1:
        return light_field
    n_v, n_u, height, width, colours = light_field.shape
    fine = np.empty((n_v, n_u, height * pixel_factor, width * pixel_factor, colours), np.float32)

    def fill(place: tuple[int, ...]) -> None:
        fine[place] = _interpolated_view(light_field[place], pixel_factor)

    with ThreadPoolExecutor() as pool:
        list(pool.map(fill, np.ndindex(n_v, n_u)))
    return fine


def _interpolated_view(view: np.ndarray, pixel_factor: int) -> np.ndarray:
    """Cubic (y p, x p, c) in [0, 1] whose p x p block means are the samples of `view` (y, x, c).

    A cubic's block means miss the samples a little, and it overshoots at edges. Each block is
    therefore reduced to its deviations, which average to zero; where sample + deviation would
    leave [0, 1], the block's deviations shrink together, which keeps the mean where clipping
    would not.
    """
    p = pixel_factor
    offsets = [(i + 0.5) / p - 0.5 for i in range(p)]
    phases = [shifted(view, dy, dx) for dy in offsets for dx in offsets]
    mean = sum(phases) / (p * p)
    below = mean - reduce(np.minimum, phases)
    above = reduce(np.maximum, phases) - mean
    shrink = np.ones_like(view)
    np.divide(view, below, out=shrink, where=below > view)
    room = np.divide(1 - view, above, out=np.ones_like(view), where=above > 1 - view)
    shrink = np.minimum(shrink, room)
    fine = np.empty((view.shape[0] * p, view.shape[1] * p, view.shape[2]), np.float32)
    for (i, j), phase in zip(np.ndindex(p, p), phases, strict=True):
        # What is left to clip is rounding.
        fine[i::p, j::p] = np.clip(view + shrink * (phase - mean), 0, 1)
    return fine

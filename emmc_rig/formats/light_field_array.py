"""What scenes and results have in common: a light field as an array, pictures of it, its depth."""

from __future__ import annotations

from contextlib import suppress
from functools import cached_property
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.formats.format import extra_module
from emmc_rig.model.arguments import refusal
from emmc_rig.model.errors import CameraError, SceneError
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.lightfield import shear
from emmc_rig.model.novel_view import all_in_focus, between, centre_disparity, view_disparities
from emmc_rig.model.optics import optics_of
from emmc_rig.model.srgb import codes_of, srgb_of
from emmc_rig.model.view_axes import ANGLES, picture_name, shows_parallax

if TYPE_CHECKING:
    from emmc_rig.model.camera import Camera

Array = NDArray[np.floating]
UNITS = {"sigma": "1", "disparity": "pixel per view", "disparity_sigma": "pixel per view"}
"""Of the maps that are passed on."""


class Depth(NamedTuple):
    """Depth of the centre view and its standard deviation.

    mm: (y, x), mm from the lens; infinite where the disparity is beyond that of infinity.
    sigma_mm: (y, x), mm, from the standard deviation of the disparity; None where that is unknown.
    Errors of the geometry and of the focus are not included.
    """

    mm: Array
    sigma_mm: Array | None


class LightFieldArray:
    """A light field (v, u, y, x, c), linear RGB, that NumPy takes as an array.

    view_axes: what rows v and columns u of views are, each "angle", "band" or "time".
    maps: arrays by name, where known: `disparity` and its standard deviation `disparity_sigma`,
    (y, x) of the centre view, in pixels per view step; `sigma`, the standard deviation of the light
    field, (v, u, y, x).
    """

    light_field: Any
    view_axes: Any = ANGLES
    maps: Any

    def _seen_by(self) -> Camera | None:
        """Return the camera that took the light field, if it is known."""
        return None

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes (v, u, y, x, c)."""
        return self.light_field.shape

    def __getitem__(self, place: Any) -> Any:
        return self.light_field[place]

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.light_field, dtype=dtype, copy=copy)

    def _refuse_without_parallax(self) -> None:
        if not shows_parallax(self.view_axes):
            named = picture_name(self.view_axes)
            raise SceneError(f"{self!r} has {named}s for views, which show no parallax")

    @cached_property
    def _centre_disparity(self) -> NDArray[np.float32]:
        """The disparity (y, x) of the centre view, estimated where it is not known."""
        self._refuse_without_parallax()
        return centre_disparity(self.light_field, self.maps.get("disparity"))

    @cached_property
    def _disparities(self) -> NDArray[np.float32]:
        return view_disparities(self._centre_disparity, self.light_field.shape[:2])

    def refocus(
        self,
        disparity: float | None = None,
        *,
        depth_mm: float | None = None,
        focus_mm: float | None = None,
        camera: Camera | None = None,
    ) -> NDArray[np.float32]:
        """Return the picture (y, x, c) of the whole lens, sharp at a disparity or at a depth.

        Args:
            disparity: of what shall be sharp, pixels per view step.
            depth_mm: of what shall be sharp, mm from the lens, instead of the disparity.
            focus_mm: see `depth_mm`.
            camera: see `depth_mm`.

        Raises:
            ArgumentError: both or none of disparity and depth_mm; a distance not above 0.
            CameraError: a depth, where the camera or the distance of what is sharp is unknown.
            SceneError: views that are bands or times.
        """
        given = depth_mm if disparity is None else disparity
        if (disparity is not None) + (depth_mm is not None) != 1 or not _is_finite(given):
            raise refusal(given, "refocus", "one number: either disparity or depth_mm")
        if depth_mm is not None:
            disparity = optics_of(camera or self._seen_by(), focus_mm).disparity_of(depth_mm)
        self._refuse_without_parallax()
        return shear(self.light_field, float(disparity or 0)).mean(axis=(0, 1))

    def all_in_focus(self) -> NDArray[np.float32]:
        """Return the centre view (y, x, c) with less noise: the mean of all views at its surfaces.

        Raises SceneError for views that are bands or times.
        """
        return all_in_focus(self.light_field, self._centre_disparity)

    def view(self, v: float, u: float) -> Array:
        """Return the picture (y, x, c) from a position between views, such as view(1.5, 2).

        Args:
            v: position among the rows of views, from 0.
            u: position among the columns of views, from 0.

        Raises:
            ArgumentError: a position outside the views.
            SceneError: a position between views that are bands or times.
        """
        for name, at, count in (("v", v, self.shape[0]), ("u", u, self.shape[1])):
            if not _is_finite(at) or not 0 <= at <= count - 1:
                raise refusal(at, name, f"a place among the views, 0 to {count - 1}")
        if float(v).is_integer() and float(u).is_integer():
            return self.light_field[int(v), int(u)]
        return between(self.light_field, self._disparities, v, u)

    def epipolar(self, row: int | None = None, column: int | None = None) -> Array:
        """Return an epipolar image: one row, or one column, of all views in a line.

        Args:
            row: of the middle row of views, y from 0; returns (u, x, c).
            column: of the middle column of views, x from 0; returns (v, y, c).

        Raises:
            ArgumentError: both or none of row and column; a row or column outside the picture.
        """
        chosen = [(axis, at) for axis, at in ((2, row), (3, column)) if at is not None]
        axis, at = chosen[0] if len(chosen) == 1 else (2, None)
        if not isinstance(at, Integral) or not 0 <= at < self.shape[axis]:
            rows, columns = self.shape[2:4]
            takes = f"one of them, a row from 0 to {rows - 1} or a column to {columns - 1}"
            raise refusal((row, column), "row, column", takes)
        v, u = self.shape[0] // 2, self.shape[1] // 2
        return self.light_field[v, :, at] if axis == 2 else self.light_field[:, u, :, at]

    def depth_mm(self, focus_mm: float | None = None, camera: Camera | None = None) -> Depth:
        """Return the depth of the centre view, (y, x) in mm from the lens, by its disparity.

        An unknown disparity is estimated from the light field; the depth then has no deviation.

        Args:
            focus_mm: distance from the lens to what is sharp, where disparity is 0. None:
                `lens.focus_mm` of the camera.
            camera: the camera, for its lens and sample pitch. None: that of Psi.

        Raises:
            CameraError: the camera or the distance is unknown; the message names what is missing.
            ArgumentError: a distance that is not above 0.
            SceneError: views that are bands or times.
        """
        optics = optics_of(camera or self._seen_by(), focus_mm)
        depth = optics.depth_mm(self._centre_disparity)
        searched = self.maps.get("disparity_sigma")
        if searched is None:
            return Depth(depth, None)
        return Depth(depth, optics.sigma_mm(depth, searched))

    def to_xarray(self) -> Any:
        """Return an xarray.Dataset with the dimensions v, u, y, x and c.

        Variables: `light_field`, and where known `sigma`, `disparity`, `disparity_sigma`, and
        `depth` and `depth_sigma` in mm. A known camera adds the coordinates v_mm and u_mm, places
        on the lens, and y_um and x_um, on the sensor; depth needs its `lens.focus_mm`. Each has the
        attribute `units`. Raises AppError where xarray is not installed.
        """
        xarray = extra_module("xarray", "to_xarray", "xarray")
        dims = "v", "u", "y", "x"
        units = [picture_name(self.view_axes)] * 2 + ["pixel"] * 2
        coords: dict[str, Any] = {"c": ["red", "green", "blue"]} | {
            name: (name, np.arange(count), {"units": unit})
            for name, count, unit in zip(dims, self.shape, units, strict=False)
        }
        camera = self._seen_by()
        if camera is not None and shows_parallax(self.view_axes):
            steps = [camera.lens.aperture_cell_mm] * 2 + [camera.sensor.sample_pitch_um] * 2
            names = "v_mm", "u_mm", "y_um", "x_um"
            for name, count, step in zip(names, self.shape, steps, strict=False):
                coords[name] = name[0], centred_grid(count, step), {"units": name[2:]}
        found = {name: (self.maps.get(name), unit) for name, unit in UNITS.items()}
        with suppress(CameraError, SceneError):  # without optics, without parallax
            depth = self.depth_mm()
            found |= {"depth": (depth.mm, "mm"), "depth_sigma": (depth.sigma_mm, "mm")}
        light = {"light_field": ((*dims, "c"), self.light_field, {"units": "1"})}
        dataset = xarray.Dataset(light, coords, {"title": repr(self)})
        for name, (values, unit) in found.items():
            if values is not None:
                dataset[name] = dims[4 - values.ndim :], values, {"units": unit}
        return dataset

    def to_napari(self) -> list[Any]:
        """Return layers of napari: the views as sRGB, and hidden ones of disparity and deviation.

        `viewer.layers.extend(result.to_napari())` adds them to a viewer. Raises AppError where
        napari is not installed.
        """
        layers = extra_module("napari.layers", "to_napari", "napari")
        shown = codes_of(srgb_of(self.light_field))
        labels = "v", "u", "y", "x"
        made = [layers.Image(shown, name="light field", rgb=True, axis_labels=labels)]
        for name, values in ((name, self.maps[name]) for name in UNITS if name in self.maps):
            look = {"name": name, "visible": False, "colormap": "turbo"}
            made.append(layers.Image(values, axis_labels=labels[4 - values.ndim :], **look))
        return made


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and bool(np.isfinite(float(value)))

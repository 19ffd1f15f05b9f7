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
COLOURS = "red", "green", "blue"
UNITS = {"sigma": "1", "disparity": "pixel per view", "disparity_sigma": "pixel per view"}
"""Of the maps that are passed on."""


class Depth(NamedTuple):
    """Depth (y, x) of the centre view, mm from the lens, and its standard deviation.

    sigma_mm follows from that of the disparity, the geometry being exact; None where that is not
    known.
    """

    mm: Array
    sigma_mm: Array | None


class LightFieldArray:
    """A light field (v, u, y, x, c) that NumPy takes as an array.

    light_field: what it is. view_axes: what its rows and columns of views are. maps: by name, of
    those that are known: `disparity` (y, x), `disparity_sigma` (y, x), `sigma` (v, u, y, x).
    """

    light_field: Any
    view_axes: Any = ANGLES
    maps: Any

    def _seen_by(self) -> Camera | None:
        """Return the camera that took the light field, if it is known."""
        return None

    @property
    def shape(self) -> tuple[int, ...]:
        """(v, u, y, x, c)."""
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
        return view_disparities(self._centre_disparity, (self.shape[0], self.shape[1]))

    def refocus(
        self,
        disparity: float | None = None,
        *,
        depth_mm: float | None = None,
        focus_mm: float | None = None,
        camera: Camera | None = None,
    ) -> NDArray[np.float32]:
        """Return the picture (y, x, c) of the whole lens, focused elsewhere.

        Args:
            disparity: of what is to be sharp, pixels per view step.
            depth_mm: of what is to be sharp, from the lens, instead of a disparity.
            focus_mm, camera: see `depth_mm`.

        Raises:
            ArgumentError: no disparity and no depth, or both.
            CameraError: a depth without the optics.
        """
        takes = "one number: either disparity, in pixels per view step, or depth_mm"
        given = depth_mm if disparity is None else disparity
        if (disparity is not None) + (depth_mm is not None) != 1 or not _is_finite(given):
            raise refusal(given, "refocus", takes)
        if depth_mm is not None:
            if depth_mm <= 0:
                raise refusal(depth_mm, "depth_mm", "a distance from the lens above 0")
            disparity = optics_of(camera or self._seen_by(), focus_mm).disparity_of(depth_mm)
        self._refuse_without_parallax()
        return shear(self.light_field, float(disparity or 0)).mean(axis=(0, 1))

    def all_in_focus(self) -> NDArray[np.float32]:
        """Return the centre view (y, x, c), its noise averaged over all views along the disparity.

        Where no disparity is known it is estimated.
        """
        return all_in_focus(self.light_field, self._centre_disparity)

    def view(self, v: float, u: float) -> Array:
        """Return the picture (y, x, c) from a place between the views, such as (1.5, 2).

        Raises ArgumentError for a place beyond the views.
        """
        for name, at, count in (("v", v, self.shape[0]), ("u", u, self.shape[1])):
            if not _is_finite(at) or not 0 <= at <= count - 1:
                raise refusal(at, name, f"a place among the views, 0 to {count - 1}")
        if float(v).is_integer() and float(u).is_integer():
            return self.light_field[int(v), int(u)]
        return between(self.light_field, self._disparities, v, u)

    def epipolar(self, row: int | None = None, column: int | None = None) -> Array:
        """Return a row (u, x, c) of the middle row of views, or a column (v, y, c) likewise.

        Points are lines there, whose slopes are their disparities. Raises ArgumentError.
        """
        v, u, rows, columns, _ = self.shape
        given, length = (row, rows) if column is None else (column, columns)
        inside = isinstance(given, Integral) and 0 <= given < length
        if (row is not None and column is not None) or not inside:
            takes = f"one of them, a row from 0 to {rows - 1} or a column to {columns - 1}"
            raise refusal((row, column), "row, column", takes)
        if column is None:
            return self.light_field[v // 2, :, row]
        return self.light_field[:, u // 2, :, column]

    def depth_mm(self, focus_mm: float | None = None, camera: Camera | None = None) -> Depth:
        """Return the depth of the centre view by its disparity, and its standard deviation.

        Args:
            focus_mm: distance from the lens to what is sharp, where disparity is 0; by default
                `lens.focus_mm` of the camera's file.
            camera: whose lens and sample pitch count; by default that of the result's Psi.

        Raises:
            CameraError: what of the optics is not known is named.
        """
        optics = optics_of(camera or self._seen_by(), focus_mm)
        depth = optics.depth_mm(self._centre_disparity)
        sigma = self.maps.get("disparity_sigma")
        return Depth(depth, None if sigma is None else optics.sigma_mm(depth, sigma))

    def to_xarray(self) -> Any:
        """Return an xarray.Dataset (v, u, y, x, c): light field, deviations, disparity, depth.

        Views are counted from 0, y and x in pixels; where the camera is known, v_mm and u_mm are
        places on the lens, y_um and x_um on the sensor. Depth, where the camera's file has the
        optics. Each has its unit as an attribute. Raises AppError without xarray.
        """
        xarray = extra_module("xarray", "to_xarray", "xarray")
        dims = "v", "u", "y", "x"
        units = [picture_name(self.view_axes)] * 2 + ["pixel"] * 2
        coords: dict[str, Any] = {"c": list(COLOURS)} | {
            name: (name, np.arange(count), {"units": unit})
            for name, count, unit in zip(dims, self.shape, units, strict=False)
        }
        camera = self._seen_by()
        if camera is not None and shows_parallax(self.view_axes):
            step_mm, pitch_um = camera.lens.aperture_cell_mm, camera.sensor.sample_pitch_um
            steps = {"v_mm": step_mm, "u_mm": step_mm, "y_um": pitch_um, "x_um": pitch_um}
            for (name, step), count in zip(steps.items(), self.shape, strict=False):
                coords[name] = name[0], centred_grid(count, step), {"units": name[2:]}
        found = {name: (self.maps.get(name), unit) for name, unit in UNITS.items()}
        with suppress(CameraError, SceneError):  # without optics, without parallax
            depth = self.depth_mm()
            found |= {"depth": (depth.mm, "mm"), "depth_sigma": (depth.sigma_mm, "mm")}
        variables = {"light_field": ((*dims, "c"), self.light_field, {"units": "1"})} | {
            name: (dims[4 - values.ndim :], values, {"units": unit})
            for name, (values, unit) in found.items()
            if values is not None
        }
        return xarray.Dataset(variables, coords, {"title": repr(self)})

    def to_napari(self) -> list[Any]:
        """Return layers of napari: the views as sRGB, and hidden ones of disparity and deviation.

        `viewer.layers.extend(result.to_napari())` adds them. Raises AppError without napari.
        """
        layers = extra_module("napari.layers", "to_napari", "napari")
        shown = codes_of(srgb_of(self.light_field))
        labels = "v", "u", "y", "x"
        made = [layers.Image(shown, name="light field", rgb=True, axis_labels=labels)]
        for name in UNITS:
            if (values := self.maps.get(name)) is not None:
                look = {"name": name, "visible": False, "colormap": "turbo"}
                made.append(layers.Image(values, axis_labels=labels[4 - values.ndim :], **look))
        return made


def _is_finite(value: object) -> bool:
    return isinstance(value, Real) and bool(np.isfinite(float(value)))

"""Layers for napari of a session, a Psi or a light field; napari itself is not imported.

    light field   views and refocus, both (focus, v, u, y, x, 3), and maps (y, x) or (v, u, y, x)
    Psi           weights (shot, colour, v, u, y, x)
    session       frames (frame, y, x), decoded when they are looked at; and its light field

A layer is (data, options, kind), as plug-ins of napari return it; axes are sliders there.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.raw import decode_raw
from emmc_rig.errors import AppError
from emmc_rig.files.exports import IN_SESSION, LIGHT_FIELD, open_export
from emmc_rig.files.folders import is_session
from emmc_rig.files.formats import Export
from emmc_rig.model.lightfield import focus_disparities, refocus
from emmc_rig.model.reading import holds_array
from emmc_rig.model.sensing import FORMAT, ImagingMatrix
from emmc_rig.model.srgb import srgb_of
from emmc_rig.session.session import Session

Layer = tuple[Any, dict[str, Any], str]
AXES = ("focus", "v", "u", "y", "x")
FOCI = 21
"""Of the refocus slider, from back to front: steps below the depth of field of 5 views."""
MAPS = {
    "disparity": ("viridis", "disparity, px per view"),
    "sigma": ("magma", "standard deviation"),
    "misfit": ("inferno", "readings missed, times their noise"),
}
HDF5 = (".h5", ".hdf5")


def get_reader(path: str | list[str]) -> Callable[[Any], list[Layer]] | None:
    """Return what reads a path, or None for what is not of this project; napari asks this."""
    if isinstance(path, list) or not _readable(Path(path)):
        return None
    return lambda one: layers(Path(one))


def layers(path: Path) -> list[Layer]:
    """Return the layers of a session, a Psi, a result's folder or a light field; raises ERRORS."""
    if is_session(path):
        found = [_frames(Session(path))]
        if (path / IN_SESSION / LIGHT_FIELD).is_file():
            found += light_field_layers(open_export(str(path)))
        return found
    if _is_psi(path):
        return [psi_layer(ImagingMatrix.load(path))]
    return light_field_layers(open_export(str(path)))


def light_field_layers(export: Export) -> list[Layer]:
    """Return views and refocus as pictures (sRGB), and the maps of the centre view, hidden."""
    light_field = export.light_field
    back, _, front = focus_disparities(light_field)
    margin = 0.1 * (front - back) + 0.05
    disparities = np.linspace(back - margin, front + margin, FOCI)
    shape = (FOCI, *light_field.shape)
    focused = np.stack([srgb_of(refocus(light_field, float(one))) for one in disparities])
    pictures = {
        # Every layer has every axis, without a copy: napari draws nothing where a slider stands
        # beyond a layer's own extent.
        "views": np.broadcast_to(srgb_of(light_field), shape),
        "refocus": np.broadcast_to(focused[:, None, None], shape),
    }
    found: list[Layer] = [
        (
            data,
            {
                "name": f"{export.title}: {name}", "rgb": True, "visible": name == "views",
                "contrast_limits": (0, 1),  # napari stretches colours from least to most, else
                "axis_labels": AXES, "metadata": {"disparities_px": disparities.tolist()},
            },
            "image",
        )
        for name, data in pictures.items()
    ]  # fmt: skip
    for name, (colours, label) in MAPS.items():
        values = getattr(export, name)
        if values is not None:
            options = {
                "name": f"{export.title}: {label}", "colormap": colours, "visible": False,
                "opacity": 0.7, "axis_labels": AXES[-values.ndim :],
            }  # fmt: skip
            found.append((np.asarray(values, np.float32), options, "image"))
    return found


def psi_layer(psi: ImagingMatrix) -> Layer:
    """Return the weights of a Psi, one slider each for shot, colour and view."""
    axes = ("shot", "colour", "v", "u", "y", "x")
    return np.moveaxis(psi.weights, 4, 1), {"name": repr(psi), "axis_labels": axes}, "image"


class FrameStack:
    """The frames of a session as an array (frame, y, x) that decodes what is looked at."""

    def __init__(self, session: Session) -> None:
        self.names = [frame.id for frame in session.frames if frame.id in session.stored]
        if not self.names:
            raise AppError(f"{session.folder}: no frame is stored yet; capture it first")
        self._frame = lru_cache(maxsize=8)(lambda name: decode_raw(session.read(name)).mosaic)
        first = self._frame(self.names[0])
        self.shape, self.dtype = (len(self.names), *first.shape), first.dtype
        self.ndim = len(self.shape)

    def __getitem__(self, key: Any) -> NDArray:
        first, *rest = key if isinstance(key, tuple) else (key,)
        if isinstance(first, slice):
            chosen = [self._frame(name)[tuple(rest)] for name in self.names[first]]
            return np.stack(chosen) if chosen else np.empty((0, *self.shape[1:]), self.dtype)
        return self._frame(self.names[int(first)])[tuple(rest)]


def _frames(session: Session) -> Layer:
    stack = FrameStack(session)
    options = {
        "name": f"{session.folder.name}: frames, DN", "colormap": "gray",
        "axis_labels": ("frame", "y", "x"), "metadata": {"frames": stack.names},
        "contrast_limits": (0, int(stack[0].max())),
    }  # fmt: skip
    return stack, options, "image"


def _readable(path: Path) -> bool:
    """Return whether a path is a session, a result, or HDF5 of a light field or a Psi."""
    if path.is_dir():
        return is_session(path) or (path / LIGHT_FIELD).is_file()
    return path.suffix.lower() in HDF5 and (_is_psi(path) or holds_array(path, "light_field"))


def _is_psi(path: Path) -> bool:
    return path.suffix.lower() in HDF5 and holds_array(path, "weights", FORMAT)

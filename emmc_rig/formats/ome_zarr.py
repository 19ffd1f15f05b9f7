"""OME-Zarr, for browsers of large pictures: multiscale (c, z, y, x), of a film (t, c, z, y, x).

Zarr has axes for time, colour and space, and none for views: view (v, u) is plane v U + u along z,
and the attribute `emmc_rig` holds the grid. Time is real, in seconds; a missing frame is not a
number. Up to version 0.4 a view was a time point, (t, c, y, x), which is still read. Extra
`formats`. Source: NGFF 0.4.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.formats.format import Array, Export, Film, Format, extra_module
from emmc_rig.model.json_text import parse_json
from emmc_rig.store.shards import check_fits

NAME, FILM_NAME = "light_field.ome.zarr", "film.ome.zarr"
SCALES = 3
CHUNK_PX, CHUNK_BYTES = 512, 2**26
"""Of what is read at once: pixels a side, and the most bytes, of as many views as fit."""


def _planes(light_field: Array) -> Array:
    """Return views (v, u, y, x, c) as planes (c, z, y, x)."""
    planes = light_field.reshape(-1, *light_field.shape[2:]).transpose(3, 0, 1, 2)
    return np.ascontiguousarray(planes, dtype=np.float32)


def _write(folder: Path, export: Export) -> None:
    _write_image(folder / NAME, _planes(export.light_field), export)


def _write_film(folder: Path, film: Film) -> None:
    """Write frame after frame; memory holds the frames that ngff-zarr works on at once."""
    dask, array = extra_module("dask", "OME-Zarr"), extra_module("dask.array", "OME-Zarr")
    first = film.first
    shape = 1, *_planes(first.light_field).shape

    def frame(place: int) -> Array:
        planes = _planes(film.opened(place).light_field)[None]
        film.watcher.step()
        return planes

    def lazily(place: int) -> Any:
        if place in film.frames:
            return array.from_delayed(dask.delayed(frame)(place), shape, np.float32)
        return array.full(shape, np.nan, np.float32, chunks=shape)

    data = array.concatenate([lazily(place) for place in range(len(film.times_s))])
    _write_image(folder / FILM_NAME, data, first, film)


def _write_image(path: Path, data: Any, export: Export, film: Film | None = None) -> None:
    """Write planes (c, z, y, x), or those of a film (t, c, z, y, x). export: its first frame."""
    ngff = extra_module("ngff_zarr", "OME-Zarr")
    rows, columns, height, width, colours = export.light_field.shape
    axes = "czyx" if film is None else "tczyx"
    image = ngff.to_ngff_image(
        data,
        dims=tuple(axes),
        scale=dict.fromkeys(axes, 1.0) | ({} if film is None else {"t": 1 / film.rate}),
        axes_units={} if film is None else {"t": "second"},
        name=export.title,
    )
    scales = [2**k for k in range(1, SCALES) if min(height, width) >= 2 ** (k + 4)]
    plane = {"c": colours, "y": min(CHUNK_PX, height), "x": min(CHUNK_PX, width)}
    views = max(CHUNK_BYTES // (4 * math.prod(plane.values())), 1)
    sides = {"t": 1, "z": min(views, rows * columns), **plane}
    chunks = {axis: sides[axis] for axis in axes}
    multiscales = ngff.to_multiscales(
        image,
        [{"z": 1, "y": s, "x": s} for s in scales],
        ngff.Methods.ITKWASM_BIN_SHRINK,  # means of what a coarse pixel covers
        chunks=chunks,
        cache=False,  # which writes all of a film to the disk once more
    )
    ngff.to_ngff_zarr(str(path), multiscales, version="0.4")
    attributes = parse_json((path / ".zattrs").read_bytes(), ".zattrs", AppError)
    attributes["emmc_rig"] = {
        "views": [rows, columns],
        "view_axes": list(export.view_axes),
        "colour": "linear RGB, 1 is white",
    }
    if film is not None:
        attributes["emmc_rig"]["film"] = {"times_s": film.times_s, "missing": film.missing}
    (path / ".zattrs").write_text(json.dumps(attributes))
    # Where Zarr keeps its metadata together too, both must agree.
    (path / ".zmetadata").unlink(missing_ok=True)


def _read(path: Path) -> Array:
    try:
        attributes = parse_json((path / ".zattrs").read_bytes(), ".zattrs", ValueError)
        rows, columns = attributes["emmc_rig"]["views"]
        image = extra_module("ngff_zarr", "OME-Zarr").from_ngff_zarr(str(path)).images[0]
        if len(image.dims) == 5:
            raise AppError(f"{path}: holds a film; open a frame of the result that was exported")
        check_fits(image.data.nbytes, path)
        data = np.asarray(image.data, dtype=np.float32)
        data = data if "t" in image.dims else data.swapaxes(0, 1)
        return data.reshape(rows, columns, *data.shape[1:]).transpose(0, 1, 3, 4, 2)
    except (OSError, ValueError, KeyError, TypeError) as fault:
        raise AppError(f"{path}: no light field that emmc-rig wrote as OME-Zarr") from fault


FORMATS = (
    Format(
        "ome-zarr", f"{NAME}, multiscale, a plane along z a view",
        "32-bit floating values, linear", _write,
        lambda path: (path / ".zattrs").is_file(), _read, write_film=_write_film,
    ),
)  # fmt: skip

"""OME-Zarr, for browsers of large pictures: all views as time points of a multiscale (t, c, y, x).

Zarr has axes for time and colour and none for views: view (v, u) is time point v U + u, and the
attribute `emmc_rig` holds the grid. Extra `formats`. Source: NGFF 0.4.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.files.formats.format import Array, Export, Format, extra_module
from emmc_rig.files.shards import check_fits
from emmc_rig.model.json_text import parse_json

NAME = "light_field.ome.zarr"
SCALES = 3


def _write(folder: Path, export: Export) -> None:
    ngff = extra_module("ngff_zarr", "OME-Zarr")
    rows, columns, height, width, colours = export.light_field.shape
    views = export.light_field.reshape(rows * columns, height, width, colours)
    data = np.ascontiguousarray(views.transpose(0, 3, 1, 2), dtype=np.float32)
    image = ngff.to_ngff_image(data, dims=("t", "c", "y", "x"), name=export.title)
    scales = [2**k for k in range(1, SCALES) if min(height, width) >= 2 ** (k + 4)]
    multiscales = ngff.to_multiscales(image, [{"y": s, "x": s} for s in scales])
    ngff.to_ngff_zarr(str(folder / NAME), multiscales, version="0.4")
    path = folder / NAME / ".zattrs"
    attributes = parse_json(path.read_bytes(), path.name, AppError)
    attributes["emmc_rig"] = {
        "views": [rows, columns],
        "view_axes": list(export.view_axes),
        "colour": "linear RGB, 1 is white",
    }
    path.write_text(json.dumps(attributes))
    # Where Zarr keeps its metadata together too, both must agree.
    (folder / NAME / ".zmetadata").unlink(missing_ok=True)


def _holds(path: Path) -> bool:
    return (path / ".zattrs").is_file()


def _read(path: Path) -> Array:
    try:
        attributes = parse_json((path / ".zattrs").read_bytes(), ".zattrs", ValueError)
        rows, columns = attributes["emmc_rig"]["views"]
        stored = extra_module("ngff_zarr", "OME-Zarr").from_ngff_zarr(str(path)).images[0].data
        check_fits(stored.nbytes, path)
        data = np.asarray(stored, dtype=np.float32)
        return data.reshape(rows, columns, *data.shape[1:]).transpose(0, 1, 3, 4, 2)
    except (OSError, ValueError, KeyError, TypeError) as fault:
        raise AppError(f"{path}: no light field that emmc-rig wrote as OME-Zarr") from fault


FORMATS = (
    Format(
        "ome-zarr", f"{NAME}, multiscale, a time point a view", "32-bit floating values, linear",
        _write, _holds, _read,
    ),
)  # fmt: skip

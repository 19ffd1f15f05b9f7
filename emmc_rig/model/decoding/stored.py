"""Content of a file, read in the format that its first bytes state; all readers of files call this.

A TIFF or another picture is read as a viewer shows it: upright, in the colours of its palette, all
pages of the file. Zarr and RAW files, whose packages are above the model, join in
`emmc_rig.formats.own_arrays`.
"""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.decoding.child import only_array, read_in_child
from emmc_rig.model.decoding.pictures import decode_picture
from emmc_rig.model.decoding.regular import file_bytes, not_read
from emmc_rig.model.json_text import one_line, shown_path
from emmc_rig.model.reading import FAULTS, stored_arrays

TIFF_STARTS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_EXR_START = b"\x76\x2f\x31\x01"
_NPY_START = b"\x93NUMPY"
ARRAYS = "NPY, NPZ, MAT, HDF5, Zarr, DNG and other RAW files"
LONGEST_START = 16
TRANSPARENT = "partly transparent; save it without an alpha channel"


@dataclass(frozen=True, eq=False)
class Stored:
    """What a file holds.

    array: of a TIFF (frame, y, x) or (frame, y, x, 3); of another picture (y, x) or (y, x, 3), red
    first; of an array's file as it is there. full_scale: the code of white of whole numbers of a
    picture, else None. opaque: whether no pixel of a picture is transparent. facts: what a TIFF
    states, see `read_tiff`.
    """

    array: NDArray
    full_scale: int | None = None
    opaque: bool = True
    facts: Mapping[str, Any] = field(default_factory=dict)


def read_stored(
    path: Path, error: type[Exception], name: str = "", apart: Collection[Path] = ()
) -> Stored:
    """Return what a regular file holds, but of RAW files; raises `error` in one line.

    name: of the array, in a file that holds several. apart: files of the same series that are
    read for themselves.
    """
    start = file_bytes(path, error, LONGEST_START)
    shown, suffix = shown_path(path), path.suffix.lower()
    try:
        if start.startswith((*TIFF_STARTS, _EXR_START)):
            kind = "exr" if start.startswith(_EXR_START) else "tif"
            array, facts = read_in_child(kind, [path], name, apart)
            return Stored(array, facts["full_scale"], facts["opaque"], facts)
        if h5py.is_hdf5(path):
            return Stored(_of_hdf5(path, error, name))
        if suffix in (".npz", ".mat"):
            return Stored(read_in_child(suffix[1:], [path], name)[0])
        content = file_bytes(path, error)
        if start.startswith(_NPY_START):
            return Stored(_of_npy(content))
        if suffix == ".npy":
            raise error(f"{shown}: {not_read(content, ARRAYS)}")
    except error:
        raise
    except FAULTS as fault:
        raise error(f"{shown}: cannot be read ({one_line(fault)})") from fault
    codes, opaque = decode_picture(content, shown, error)
    white = np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else None
    return Stored(codes, white, opaque)


def read_codes(
    path: Path, error: type[Exception], opaque: bool = False
) -> tuple[NDArray, int | None]:
    """Return the one picture of a file, (y, x) or (y, x, 3) with red first, and its full scale.

    The full scale is None of floating values. opaque: refuse a picture that is partly transparent.
    Raises `error`, also for several pictures.
    """
    stored = read_stored(path, error)
    if opaque and not stored.opaque:
        raise error(f"{shown_path(path)}: {TRANSPARENT}")
    codes = stored.array
    if stored.facts:
        codes = _only_picture(codes, stored.facts, path, error)
    if codes.ndim < 2 or codes.dtype.kind not in "uf" or codes.shape[2:] not in ((), (3,)):
        size = "x".join(map(str, codes.shape))
        raise error(f"{shown_path(path)}: {size} {codes.dtype}, which is no picture")
    return codes, stored.full_scale


def _only_picture(
    pages: NDArray, facts: Mapping[str, Any], path: Path, error: type[Exception], axis: int = 0
) -> NDArray:
    """Return pages as a picture, (..., y, x) or (..., y, x, 3); axis: that of the pages."""
    count = pages.shape[axis]
    if facts.get("stacked") and count == 3:
        return np.moveaxis(pages, axis, -1)
    if count != 1:
        raise error(f"{shown_path(path)}: {count} pages, where one picture is meant")
    return pages.take(0, axis)


def read_views(paths: Sequence[Path], error: type[Exception]) -> NDArray[np.float32]:
    """Return pictures of TIFF or EXR as (view, y, x, 3), 1 for white; all in one child."""
    kind = "exr" if paths[0].suffix.lower() == ".exr" else "tif"
    try:
        array, facts = read_in_child(kind, paths)
    except FAULTS as fault:
        raise error(
            f"{shown_path(paths[0].parent)}: views cannot be read ({one_line(fault)})"
        ) from fault
    if not facts["opaque"]:
        raise error(f"{shown_path(paths[0].parent)}: {TRANSPARENT}")
    array = array if len(paths) > 1 else array[None]
    return light_of(_only_picture(array, facts, paths[0], error, 1), facts["full_scale"], 4)


def light_of(codes: NDArray, full_scale: int | None, axes: int = 3) -> NDArray[np.float32]:
    """Return codes as float32 with three colours, 1 for white; axes: of what is returned."""
    light = np.empty((*codes.shape[: axes - 1], 3), np.float32)
    light[...] = codes if codes.ndim == axes else codes[..., None]
    if full_scale is not None:
        light /= full_scale
    return light


def _of_npy(data: bytes) -> NDArray:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    shape, by_columns, dtype = header[version](stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError("it is cut short, or holds no plain numbers")
    array = np.frombuffer(data, dtype, offset=stream.tell())
    return array.reshape(shape, order="F" if by_columns else "C")


def _of_hdf5(path: Path, error: type[Exception], name: str) -> NDArray:
    """Read a data set; MATLAB's files of version 7.3 have their axes in the other order."""
    with stored_arrays(path, error, "write it again") as stored:
        shapes: dict[str, tuple[int, ...]] = {}
        stored.file.visititems(lambda at, item: shapes.update({at: getattr(item, "shape", ())}))
        array = stored.array(only_array(shapes, name))
    return array.T if path.suffix.lower() == ".mat" else array

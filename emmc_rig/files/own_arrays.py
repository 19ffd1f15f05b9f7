"""Frames that another program wrote, of any usual format, as arrays with what the file states.

A file is named as a path, or as FILE@ARRAY where it holds several arrays.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.errors import RawFrameError
from drivers.raw import RAW_SUFFIXES, RawFrame, decode_raw
from emmc_rig.errors import AppError
from emmc_rig.files.child import only_array, read_in_child
from emmc_rig.files.shards import stored_shards
from emmc_rig.model.json_text import shown_path
from emmc_rig.model.reading import FAULTS, decode_picture, stored_arrays

COLOURS = (3, 4)
"""How many values a pixel of a colour picture has, the fourth being how opaque it is."""
_ZARR_FILES = (".zgroup", ".zattrs", "zarr.json")
_HDF5_START = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True, eq=False)
class OwnFrames:
    """What a file holds.

    frames: (frame, y, x), or (frame, y, x, 3) of a colour picture, red first; of the file's own
    type. data: the file's bytes, b"" of a folder. exposures_s, times_s: (frame,), NaN where not
    stated. raw: the frame of a RAW file, with its levels and colours.
    """

    frames: NDArray
    data: bytes
    exposures_s: NDArray[np.float64]
    times_s: NDArray[np.float64]
    raw: RawFrame | None = None


def read_own(path: Path, name: str = "") -> OwnFrames:
    """Return the frames in a file: NPY, NPZ, TIFF, MAT, HDF5, Zarr, a picture, DNG or other RAW.

    name: of the array, in a file that holds several. Raises AppError.
    """
    shown, suffix = shown_path(path), path.suffix.lower()
    try:
        data = b"" if path.is_dir() else path.read_bytes()
    except FileNotFoundError as fault:
        raise AppError(f"{shown}: no such file") from fault
    except OSError as fault:
        raise AppError(f"{shown}: cannot be read ({fault.strerror})") from fault
    if path.is_dir() and not any((path / name).is_file() for name in _ZARR_FILES):
        raise AppError(f"{shown}: a folder, and no Zarr group: name a file, or the group itself")
    times = None
    try:
        if suffix in RAW_SUFFIXES:
            raw = decode_raw(data)
            exposure_s = np.array([raw.exposure_s or np.nan])
            return OwnFrames(raw.mosaic[None], data, exposure_s, np.array([np.nan]), raw)
        if path.is_dir() or data.startswith(_HDF5_START):
            read = _of_zarr if path.is_dir() else _of_hdf5
            array = read(path, name)
        elif suffix in _ARRAYS:
            array = _ARRAYS[suffix](path, data, name)
            if suffix in (".tif", ".tiff"):
                times = read_in_child("tif times", [path])
        else:
            array = decode_picture(data, shown, AppError)
            if array.ndim == 3:
                array = array[..., [2, 1, 0]]
    except RawFrameError as fault:
        raise AppError(f"{shown}: {fault}") from fault
    except FAULTS as fault:
        raise AppError(f"{shown}: cannot be read ({fault})") from fault
    frames = _stacked(array, shown)
    if times is None or len(times) != len(frames):
        times = np.full((len(frames), 2), np.nan)
    return OwnFrames(frames, data, times[:, 0], times[:, 1])


def _stacked(array: NDArray, shown: str) -> NDArray:
    """Return frames, first axis, of what a file holds; raises AppError."""
    if array.dtype.kind not in "uif":
        raise AppError(f"{shown}: holds no real numbers ({array.dtype})")
    if array.ndim == 3 and array.shape[-1] in COLOURS:
        return array[None, ..., :3]
    if array.ndim == 4 and array.shape[-1] in COLOURS:
        return array[..., :3]
    if array.ndim not in (2, 3) or not array.size:
        size = "x".join(map(str, array.shape))
        raise AppError(f"{shown}: holds an array of {size}, not frames (y, x) or (frame, y, x)")
    return array.reshape(-1, *array.shape[-2:])


def _of_npy(path: Path, data: bytes, name: str) -> NDArray:
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


def _in_child(kind: str) -> Callable[[Path, bytes, str], NDArray]:
    return lambda path, data, name: read_in_child(kind, [path], name)


def _of_hdf5(path: Path, name: str) -> NDArray:
    """Read a data set; MATLAB's files of version 7.3 have their axes in the other order."""
    with stored_arrays(path, AppError, "write it again") as stored:
        shapes: dict[str, tuple[int, ...]] = {}
        stored.file.visititems(lambda one, item: shapes.update({one: getattr(item, "shape", ())}))
        array = stored.array(only_array(shapes, name))
    return array.T if path.suffix.lower() == ".mat" else array


def _of_zarr(path: Path, name: str) -> NDArray:
    with stored_shards(path, AppError, "write it again as a group with an array") as stored:
        names = {one: array.shape for one, array in stored.arrays()}
        return stored.array(only_array(names, name))


_ARRAYS: dict[str, Callable[[Path, bytes, str], NDArray]] = {
    ".npy": _of_npy,
    ".npz": _in_child("npz"),
    ".mat": _in_child("mat"),
    ".tif": _in_child("tif"),
    ".tiff": _in_child("tif"),
}

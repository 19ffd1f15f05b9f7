"""Frames that another program wrote, of any usual format, as arrays with what the file states.

A file is named as a path, or as FILE@ARRAY where it holds several arrays. What
`emmc_rig.model.decoding` reads, and also Zarr and RAW files.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.drivers.errors import RawFrameError
from emmc_rig.drivers.raw import RAW_SUFFIXES, RawFrame, decode_raw
from emmc_rig.errors import AppError
from emmc_rig.model.decoding.regular import file_bytes
from emmc_rig.model.decoding.stored import Stored, read_stored
from emmc_rig.model.json_text import shown_path
from emmc_rig.store.shards import is_zarr, read_array

COLOURS = (3, 4)
"""How many values a pixel of a colour picture has, the fourth being how opaque it is."""


@dataclass(frozen=True, eq=False)
class OwnFrames:
    """What a file holds.

    frames: (frame, y, x), or (frame, y, x, 3) of a colour picture, red first; of the file's own
    type. data: the file's bytes, b"" of a folder. exposures_s, times_s: (frame,), NaN where not
    stated. raw: the frame of a RAW file, with its levels and colours. members: the files that the
    frames are in, more than one of a series. notes: sentences on what was left out by right.
    """

    frames: NDArray
    data: bytes
    exposures_s: NDArray[np.float64]
    times_s: NDArray[np.float64]
    raw: RawFrame | None = None
    members: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()


def read_own(path: Path, name: str = "", apart: Collection[Path] = ()) -> OwnFrames:
    """Return the frames in a file: NPY, NPZ, TIFF, MAT, HDF5, Zarr, a picture, DNG or other RAW.

    name: of the array, in a file that holds several. apart: files of the same series that are read
    for themselves. Raises AppError.
    """
    shown = shown_path(path)
    if path.is_dir():
        if not is_zarr(path):
            raise AppError(
                f"{shown}: a folder without a Zarr group: name a file, or the group itself"
            )
        data, stored = b"", Stored(read_array(path, name))
    else:
        data = file_bytes(path, AppError)
        if path.suffix.lower() in RAW_SUFFIXES:
            try:
                raw = decode_raw(data)
            except RawFrameError as fault:
                raise AppError(f"{shown}: {fault}") from fault
            exposures_s = np.array([raw.exposure_s or np.nan])
            return OwnFrames(raw.mosaic[None], data, exposures_s, np.array([np.nan]), raw)
        stored = read_stored(path, AppError, name, apart)
    frames, facts = _stacked(stored.array, shown), stored.facts
    unknown = [None] * len(frames)
    return OwnFrames(
        frames,
        data,
        np.array(facts.get("exposures_s", unknown), dtype=np.float64),
        np.array(facts.get("times_s", unknown), dtype=np.float64),
        members=tuple(map(Path, facts.get("members", ()))),
        notes=tuple(f"{shown}: {note}" for note in facts.get("notes", ())),
    )


def _stacked(array: NDArray, shown: str) -> NDArray:
    """Return frames, first axis, of what a file holds, without further axes of length 1."""
    if array.dtype.kind not in "uif":
        raise AppError(f"{shown}: holds {array.dtype}, not real numbers: save it as numbers")
    size = "x".join(map(str, array.shape))
    if array.ndim > 2:
        sides = [side for side in array.shape if side != 1]
        array = array.reshape(sides if len(sides) > 1 else array.shape[-2:])
    if array.ndim in (3, 4) and array.shape[-1] in COLOURS:
        return array.reshape(-1, *array.shape[-3:])[..., :3]
    if array.ndim not in (2, 3) or not array.size:
        raise AppError(f"{shown}: holds an array of {size}, not frames (y, x) or (frame, y, x)")
    return array.reshape(-1, *array.shape[-2:])

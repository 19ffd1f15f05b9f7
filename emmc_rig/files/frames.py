"""Folders of frames, as `simulate` and `demo` write them: frames.h5 or frames.zarr, and Psi."""

from __future__ import annotations

from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.folders import refuse_missing
from emmc_rig.files.shards import stored_shards, whole
from emmc_rig.model.frames import Frames
from emmc_rig.model.reading import stored_arrays

FRAMES, PSI = "frames.h5", "psi.h5"
FRAMES_GROUP = "frames.zarr"
AGAIN = "make the frames again"
WRITTEN_BY = "name one that `emmc-rig demo`, `simulate` or `capture` wrote"


def read_frames(folder: Path) -> Frames:
    """Read the frames of a folder; raises AppError when they are missing, damaged or incomplete."""
    refuse_missing(folder, WRITTEN_BY)
    path = folder / FRAMES
    sharded = (folder / FRAMES_GROUP).is_dir()
    if sharded:
        path = folder / FRAMES_GROUP
    elif not path.is_file():
        raise AppError(f"{folder}: holds no {FRAMES}; {WRITTEN_BY}")
    with (stored_shards if sharded else stored_arrays)(path, AppError, AGAIN) as stored:
        names = ("readings", "deviation", "usable")
        arrays = [stored.array(name) for name in names]
    if sharded:
        arrays = [whole(values, path, AppError, AGAIN) for values in arrays]
    readings, deviation, usable = arrays
    usable = usable.astype(bool)
    return Frames(readings, deviation, usable)

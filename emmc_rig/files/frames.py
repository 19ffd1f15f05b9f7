"""Folders of frames, as `emmc-rig simulate` and `demo` write them: frames.h5, beside it psi.h5."""

from __future__ import annotations

from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.model.frames import Frames
from emmc_rig.model.reading import stored_arrays

FRAMES, PSI = "frames.h5", "psi.h5"


def read_frames(folder: Path) -> Frames:
    """Read frames.h5 of a folder; raises AppError when it is missing, damaged or incomplete."""
    path = folder / FRAMES
    if not path.is_file():
        raise AppError(
            f"{folder}: holds no {FRAMES}; name a folder that `emmc-rig demo`, `simulate` or "
            "`capture` wrote"
        )
    with stored_arrays(path, AppError, "make the frames again") as stored:
        names = ("readings", "deviation", "usable")
        readings, deviation, usable = (stored.array(name) for name in names)
    usable = usable.astype(bool)
    if readings.ndim != 3 or not readings.shape == deviation.shape == usable.shape:
        raise AppError(f"{path}: readings, deviation and usable differ in shape")
    return Frames(readings, deviation, usable)

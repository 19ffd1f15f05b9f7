"""Folders of frames as `simulate` writes them, and Psi read window by window: HDF5 or Zarr."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.folders import refuse_missing
from emmc_rig.files.shards import (
    CHUNK,
    SHARD,
    StoredGroup,
    created_group,
    missing_value,
    stored_shards,
    whole,
)
from emmc_rig.model.errors import SensingError
from emmc_rig.model.frames import Frames
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.sensing import FORMAT, NO_COLOUR_MAP, ImagingMatrix, PsiSizes, checksum_of
from emmc_rig.model.view_axes import ATTRIBUTE, axes_from, stored_as

PSI_GROUP = "psi.zarr"
AGAIN = "measure Psi again"
FRAMES, PSI = "frames.h5", "psi.h5"
FRAMES_GROUP = "frames.zarr"
FRAMES_AGAIN = "make the frames again"
WRITTEN_BY = "name one that `emmc-rig demo`, `simulate` or `capture` wrote"


class SavedPsi(PsiSizes):
    """The imaging matrix in a file, read window by window.

    The file's checksum is not verified, which would need all of it: `verify` does. Raises
    SensingError when the file is no imaging matrix.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._opened() as stored:
            weights = stored.dataset("weights")
            self.shape = weights.shape
            self.binning = int(np.asarray(stored.attributes["binning"]))
            self.checksum = str(stored.attributes["sha256"])
            self.view_axes = axes_from(stored.attributes.get(ATTRIBUTE), path, SensingError)
            if len(self.shape) != 6 or self.binning < 1:
                raise SensingError(f"{path}: damaged (no shape of an imaging matrix); {AGAIN}")

    @property
    def weights_shape(self) -> tuple[int, ...]:
        """Shape of the weights."""
        return self.shape

    def verify(self) -> None:
        """Raise SensingError when the file is damaged; reads all of it, a plane at a time."""
        with self._opened() as stored:
            camera, weights = str(stored.attributes["camera"]), stored.dataset("weights")
            planes = (self._whole(weights[place]) for place in np.ndindex(self.weights_shape[:3]))
            colour = stored.array("colour") if "colour" in stored else NO_COLOUR_MAP
            colour = self._whole(colour)
            checksum = checksum_of(self.binning, camera, planes, colour, self.view_axes)
        if checksum != self.checksum:
            raise SensingError(f"{self._path}: damaged (its checksum differs); {AGAIN}")

    def load(self) -> ImagingMatrix:
        """Return all of it, verified."""
        return ImagingMatrix.load(self._path)

    def window(self, rows: slice, columns: slice) -> ImagingMatrix:
        """Return the imaging matrix of some samples; the slices are multiples of k."""
        with self._opened() as stored:
            weights = stored.dataset("weights")[:, :, :, rows, :, columns]
            colour = None
            if "colour" in stored:
                colour = self._whole(stored.dataset("colour")[:, rows, columns])
            camera = str(stored.attributes["camera"])
            weights = self._whole(weights)
            return ImagingMatrix(weights, colour, self.binning, camera, self.view_axes)

    def _whole(self, values: NDArray) -> NDArray:
        """Return values that were read, after a check that none is missing."""
        return values

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        with self._file() as stored:
            if stored.attributes.get("format") != FORMAT or "weights" not in stored:
                raise SensingError(f"{self._path}: not an imaging matrix of this program")
            yield stored

    def _file(self) -> AbstractContextManager[Any]:
        return stored_arrays(self._path, SensingError, AGAIN)


class ShardedPsi(SavedPsi):
    """The imaging matrix in a Zarr group; a shard holds all views of SHARD x SHARD samples."""

    def load(self) -> ImagingMatrix:
        """Return all of it, verified."""
        self.verify()
        return self.window(*(slice(0, length) for length in self.size))

    def _whole(self, values: NDArray) -> NDArray:
        return whole(values, self._path, SensingError, AGAIN)

    def _file(self) -> AbstractContextManager[StoredGroup]:
        return stored_shards(self._path, SensingError, AGAIN)


def open_psi(path: Path) -> SavedPsi:
    """Return a saved imaging matrix, not read; raises SensingError when there is none."""
    return ShardedPsi(path) if path.is_dir() else SavedPsi(path)


def psi_beside(folder: Path) -> Path:
    """Return where a folder of frames has its imaging matrix."""
    return folder / (PSI_GROUP if (folder / PSI_GROUP).is_dir() else PSI)


def save_shards(psi: ImagingMatrix, folder: Path) -> None:
    """Write Psi as a Zarr group into a folder that must not exist; raises AppError without Zarr."""
    group = created_group(folder)
    shots, v, u, _, stored, _ = psi.weights.shape
    arrays = {
        "weights": (psi.weights, (1, 1, 1, CHUNK, stored, CHUNK),
                    (shots, v, u, SHARD, stored, SHARD)),
        "colour": (psi.colour, (1, CHUNK, CHUNK), (shots, SHARD, SHARD)),
    }  # fmt: skip
    for name, (values, chunks, shards) in arrays.items():
        if values is not None:
            made = group.create_array(
                name, shape=values.shape, dtype=values.dtype, chunks=chunks, shards=shards,
                fill_value=missing_value(values.dtype),
            )  # fmt: skip
            made[...] = values
    group.attrs.update(
        format=FORMAT, binning=psi.binning, camera=psi.camera_json, sha256=psi.checksum(),
        view_axes=stored_as(psi.view_axes),
    )  # fmt: skip


def read_frames(folder: Path) -> Frames:
    """Read the frames of a folder; raises AppError when they are missing, damaged or incomplete."""
    refuse_missing(folder, WRITTEN_BY)
    path = folder / FRAMES
    sharded = (folder / FRAMES_GROUP).is_dir()
    if sharded:
        path = folder / FRAMES_GROUP
    elif not path.is_file():
        raise AppError(f"{folder}: holds no {FRAMES}; {WRITTEN_BY}")
    with (stored_shards if sharded else stored_arrays)(path, AppError, FRAMES_AGAIN) as stored:
        names = ("readings", "deviation", "usable")
        arrays = [stored.array(name) for name in names]
    if sharded:
        arrays = [whole(values, path, AppError, FRAMES_AGAIN) for values in arrays]
    readings, deviation, usable = arrays
    usable = usable.astype(bool)
    return Frames(readings, deviation, usable)

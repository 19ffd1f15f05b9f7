"""Folders of frames as `simulate` writes them, and Psi read window by window: HDF5 or Zarr."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emmc_rig.errors import AppError
from emmc_rig.model.errors import SensingError
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import FORMAT, NO_COLOUR_MAP, Psi, PsiLayout, checksum_of
from emmc_rig.model.view_axes import ATTRIBUTE, axes_from, stored_as
from emmc_rig.store.folders import WRITTEN_BY, refuse_missing
from emmc_rig.store.shards import CHUNK, SHARD, created_group, missing_value, stored_in

PSI_GROUP = "psi.zarr"
AGAIN = "measure Psi again"
FRAMES, PSI = "frames.h5", "psi.h5"
FRAMES_GROUP = "frames.zarr"
FRAMES_AGAIN = "make the frames again"


class StoredPsi(PsiLayout):
    """Psi in a file or a Zarr group, of which a window is read at a time.

    In a group a shard holds all views of SHARD x SHARD samples. The colour map is read with a
    window. The checksum is verified by `verify` alone, which reads the whole file. Raises
    SensingError when there is no imaging matrix.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._opened() as stored:
            shape = stored.dataset("weights").shape
            binning = int(np.asarray(stored.attributes["binning"]))
            axes = axes_from(stored.attributes.get(ATTRIBUTE), path, SensingError)
            super().__init__(shape, None, binning, str(stored.attributes["camera"]), axes)
            self.checksum = str(stored.attributes["sha256"])
            if len(shape) != 6 or binning < 1:
                raise SensingError(f"{path}: damaged (no shape of a Psi); {AGAIN}")

    def verify(self) -> None:
        """Raise SensingError when the file is damaged; reads all of it, a plane at a time."""
        with self._opened() as stored:
            places = np.ndindex(self.weights_shape[:3])
            planes = (stored.part("weights", place) for place in places)
            colour = stored.array("colour") if "colour" in stored else NO_COLOUR_MAP
            checksum = checksum_of(self.binning, self.camera_json, planes, colour, self.view_axes)
        if checksum != self.checksum:
            raise SensingError(f"{self._path}: damaged (its checksum differs); {AGAIN}")

    def load(self) -> Psi:
        """Return all of it, verified."""
        if self._path.is_file():
            return Psi.load(self._path)
        self.verify()
        return self.window(*(slice(0, length) for length in self.size))

    def window(self, rows: slice, columns: slice) -> Psi:
        """Return the imaging matrix of some samples; the slices are multiples of k."""
        with self._opened() as stored:
            weights = stored.part("weights", np.s_[:, :, :, rows, :, columns])
            has_colour = "colour" in stored
            colour = stored.part("colour", np.s_[:, rows, columns]) if has_colour else None
        return Psi(weights, colour, self.binning, self.camera_json, self.view_axes)

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        with stored_in(self._path, SensingError, AGAIN) as stored:
            if stored.attributes.get("format") != FORMAT or "weights" not in stored:
                raise SensingError(f"{self._path}: not a Psi of this program")
            yield stored


def psi_beside(folder: Path) -> Path:
    """Return where a folder of frames has its imaging matrix."""
    return folder / (PSI_GROUP if (folder / PSI_GROUP).is_dir() else PSI)


def psi_places(folder: Path, metrics: Mapping[str, Any]) -> tuple[Path, Path]:
    """Return where the Psi of a result may lie: beside it, or a film's; and where it came from."""
    folder = folder.absolute()
    beside = psi_beside(folder.parents[1] if "segment" in metrics else folder)
    return beside, Path(metrics.get("psi_file", beside))


def save_shards(psi: Psi, folder: Path) -> None:
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


def holds_frames(folder: Path) -> bool:
    """Return whether a folder holds frames as `read_frames` reads them."""
    return (folder / FRAMES).is_file() or (folder / FRAMES_GROUP).is_dir()


def read_frames(folder: Path) -> Frames:
    """Read the frames of a folder; raises AppError when they are missing, damaged or incomplete."""
    refuse_missing(folder, WRITTEN_BY)
    if not holds_frames(folder):
        raise AppError(f"{folder}: holds no {FRAMES}; {WRITTEN_BY}")
    path = folder / (FRAMES_GROUP if (folder / FRAMES_GROUP).is_dir() else FRAMES)
    with stored_in(path, AppError, FRAMES_AGAIN) as stored:
        readings, deviation, usable = map(stored.array, ("readings", "deviation", "usable"))
    return Frames(readings, deviation, usable.astype(bool))

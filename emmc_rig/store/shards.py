"""Zarr groups (v3, sharded): arrays that many processes write at once, a shard each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from math import ceil, prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.model.decoding.child import only_array
from emmc_rig.model.errors import AdvisedError, SceneError
from emmc_rig.model.json_text import one_line, shown_path
from emmc_rig.model.lightfield import check_light_field, scaled
from emmc_rig.model.reading import (
    FAULTS,
    FREE_BYTES,
    MOST_COMPRESSED,
    StoredArrays,
    stored_arrays,
)

ENDING = ".zarr"
MISSING_BYTE = 255
CHUNK, SHARD = 128, 512
"""Samples a side of what is read at once, and of one file."""

Place = tuple[slice, slice]


def _zarr() -> Any:
    try:
        import zarr
    except ImportError as fault:
        raise AppError("Zarr is not installed: pip install 'emmc-rig[zarr]'") from fault
    return zarr


def created_group(folder: Path) -> Any:
    """Return a new group in a folder that must not exist; raises AppError without Zarr."""
    return _zarr().create_group(folder, zarr_format=3)


def missing_value(dtype: np.dtype) -> float:
    """Return what is read where the file of a shard is missing: NaN, of bytes MISSING_BYTE."""
    return np.nan if dtype.kind == "f" else MISSING_BYTE if dtype == np.uint8 else 0


def create_array(
    group: Any, name: str, shape: tuple[int, ...], dtype: np.dtype, axes: int
) -> list[Place]:
    """Create an array with `axes` axes before (y, x); return the places of its shards.

    A shard holds all views of SHARD x SHARD samples, a chunk one view of CHUNK x CHUNK. Where the
    file of a shard is missing, values are `missing_value`.
    """
    after = shape[axes + 2 :]
    group.create_array(
        name,
        shape=shape,
        dtype=dtype,
        chunks=(*(1,) * axes, CHUNK, CHUNK, *after),
        shards=(*shape[:axes], SHARD, SHARD, *after),
        fill_value=missing_value(dtype),
    )
    rows, columns = shape[axes : axes + 2]
    return [
        (slice(top, min(top + SHARD, rows)), slice(left, min(left + SHARD, columns)))
        for top in range(0, rows, SHARD)
        for left in range(0, columns, SHARD)
    ]


def save_arrays(folder: Path, arrays: Mapping[str, NDArray]) -> None:
    """Write arrays (shot, y, x) as a group into a folder that must not exist; others as attributes.

    What is true or false is written as bytes. Raises AppError without Zarr.
    """
    group = created_group(folder)
    for name, values in arrays.items():
        if values.ndim == 3:
            values = values.astype(np.uint8) if values.dtype == bool else values
            create_array(group, name, values.shape, values.dtype, 1)
            group[name][...] = values
        else:
            group.attrs[name] = values.tolist()


class MissingShardError(Exception):
    """The file of a shard is missing."""


class StoredGroup:
    """The arrays of a Zarr group, read as `emmc_rig.model.reading.StoredArrays` are.

    Values of a missing shard raise MissingShardError.
    """

    def __init__(self, group: Any, folder: Path) -> None:
        self._group, self._folder, self.attributes = group, folder, group.attrs

    def __contains__(self, name: str) -> bool:
        return name in self._group

    def names(self) -> list[str]:
        """Return the names of the arrays of the group itself."""
        return list(self._group.array_keys())

    def dataset(self, name: str) -> Any:
        """Return an array, not read."""
        return self._group[name]

    def array(self, name: str) -> NDArray:
        """Return an array, all of it; raises ValueError where its files cannot hold so much."""
        check_fits(self._group[name].nbytes, self._folder)
        return self.part(name, ...)

    def part(self, name: str, index: Any) -> NDArray:
        """Return a part of an array of floats or bytes; raises MissingShardError."""
        values = np.asarray(self._group[name][index])
        gone = np.isnan(values) if values.dtype.kind == "f" else values == MISSING_BYTE
        if gone.any():
            raise MissingShardError
        return values


def check_fits(unpacked_bytes: int, folder: Path) -> None:
    """Raise ValueError for an array of more bytes than a folder's files may unpack to."""
    size_bytes = sum(path.stat().st_size for path in folder.rglob("*"))
    if unpacked_bytes > MOST_COMPRESSED * size_bytes + FREE_BYTES:
        raise ValueError(f"an array of {unpacked_bytes:.3g} bytes does not fit into its files")


@contextmanager
def stored_shards(folder: Path, error: type[Exception], remedy: str) -> Iterator[StoredGroup]:
    """Yield the arrays of a group; raises `error` where one is not there, AppError without Zarr."""
    zarr = _zarr()
    try:
        yield StoredGroup(zarr.open_group(folder, mode="r"), folder)
    except (error, AdvisedError):
        raise
    except MissingShardError as fault:
        why = "a file of it is missing; copy the folder again, or"
        raise error(f"{shown_path(folder)}: {why} {remedy}") from fault
    except FAULTS as fault:
        why = f"no Zarr group, or one that cannot be read ({one_line(fault)})"
        raise error(f"{shown_path(folder)}: {why}; {remedy}") from fault


def stored_in(
    path: Path, error: type[Exception], remedy: str
) -> AbstractContextManager[StoredGroup | StoredArrays]:
    """Return the arrays of a Zarr group or an HDF5 file: `stored_shards` or `stored_arrays`."""
    return (stored_shards if path.is_dir() else stored_arrays)(path, error, remedy)


def is_zarr(folder: Path) -> bool:
    """Return whether a folder is a group or an array of Zarr, of version 2 or 3."""
    return any((folder / name).is_file() for name in (".zgroup", ".zarray", ".zattrs", "zarr.json"))


def read_array(folder: Path, name: str = "") -> NDArray:
    """Return an array of a group at any depth, or the array that a folder is; raises AppError.

    name: of the array, where a group holds several that are no smaller copies (OME-Zarr) of one.
    """
    zarr = _zarr()
    try:
        node = zarr.open(folder, mode="r")
        arrays = {"": node}
        if not isinstance(node, zarr.Array):
            members = dict(node.members(max_depth=None))
            copies = {
                path for at, node in {"": node, **members}.items() for path in _copies(at, node)
            }
            arrays = {
                at: node for at, node in members.items()
                if isinstance(node, zarr.Array) and (at not in copies or at == name)
            }  # fmt: skip
        stored = arrays[only_array({at: array.shape for at, array in arrays.items()}, name)]
        return _all_of(stored, folder)
    except FAULTS as fault:
        raise AppError(f"{shown_path(folder)}: cannot be read ({one_line(fault)})") from fault


def _all_of(stored: Any, folder: Path) -> NDArray:
    """Return an array; raises ValueError where Zarr would fill in what is missing."""
    check_fits(stored.nbytes, folder)
    in_a_file = stored.shards or stored.chunks
    files = prod(ceil(n / side) for n, side in zip(stored.shape, in_a_file, strict=True))
    # Zarr counts all chunks of a shard that is there, those beyond the array too.
    missing = files - stored.nchunks_initialized // (prod(in_a_file) // prod(stored.chunks))
    if missing:
        raise ValueError(f"{missing} of its {files} chunks are not there")
    return np.asarray(stored[...])


def _copies(at: str, group: Any) -> list[str]:
    """Return the paths of the smaller copies that a group of OME-Zarr lists."""
    attributes = dict(group.attrs)
    scales = attributes.get("ome", attributes).get("multiscales", [])
    levels = (level for scale in scales for level in scale["datasets"][1:])
    return [f"{at}/{level['path']}".lstrip("/") for level in levels]


def opened_array(folder: Path, name: str, mode: Literal["r", "r+"] = "r") -> Any:
    """Return an array of a group, or the array that a folder is, not read; raises AppError."""
    zarr = _zarr()
    try:
        node = zarr.open(folder, mode=mode)
        array = node if isinstance(node, zarr.Array) else node[name]
    except FAULTS as fault:
        raise AppError(
            f"{shown_path(folder)}: holds no array {name} of Zarr ({one_line(fault)})"
        ) from fault
    return array


def load_light_field(folder: Path) -> NDArray[np.float32]:
    """Return the array `light_field` of a group, or the array that a folder is, all of it.

    Raises AppError or SceneError.
    """
    stored = opened_array(folder, "light_field")
    try:
        light_field = _all_of(stored, folder)
    except FAULTS as fault:
        raise SceneError(f"{shown_path(folder)}: cannot be read ({one_line(fault)})") from fault
    return check_light_field(scaled(light_field), shown_path(folder))

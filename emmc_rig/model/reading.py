"""Files from outside as plain data: YAML and HDF5, bounded in depth and memory.

Whatever is wrong with a file raises the caller's error with one line that names the file. No other
module calls these decoders, nor JSON's beside `json_text`: ruff refuses it (TID251).
Pictures and what other programs wrote: `emmc_rig.model.decoding`.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

from emmc_rig.model.decoding.regular import HEAD_BYTES, check_regular, file_bytes, not_read
from emmc_rig.model.errors import AdvisedError
from emmc_rig.model.json_text import one_line, shown_path

MOST_YAML_BYTES, MOST_VALUES, MOST_NESTED = 1_000_000, 1_000_000, 100
"""Of a file of settings, of the values in it with aliases written out, and of lists within lists: a
plan of a thousand shots has 160 kB, 10,000 values and 6 within one another."""
LONGEST_NUMBER = 4000
"""In characters; the time for one in base 60 grows with the square of its length."""
MOST_COMPRESSED, FREE_BYTES = 100, 2**26
"""How many times its file a data set may be, and the bytes that even a nearly empty file may hold
unpacked: light fields pack to a tenth, even maps by lzf to a ninetieth."""
_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000
_FILTERS = frozenset((_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF))
"""Filters of HDF5 whose memory a chunk's size bounds; others allocate what the file says."""
_BLANK = ("_FillValue", "missing_value")
"""Attributes for the value of invalid samples, in NetCDF and other formats."""
FAULTS = (
    *(OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError),
    MemoryError,
)
"""Whatever decoders run into."""

_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):
    """YAML's safe types; a key given twice is refused instead of overwritten."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        """Return a mapping; raises ConstructorError for a key that is there twice."""
        seen = set()
        for key, _ in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else id(key)
            if name in seen and name != "<<":
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{name}' is there twice", key.start_mark
                )
            seen.add(name)
        return super().construct_mapping(node, deep)


def read_yaml(path: Path, error: type[Exception]) -> object:
    """Return the content of a YAML file; raises `error` when it cannot be read."""
    data = file_bytes(path, error, MOST_YAML_BYTES + 1)
    return parse_yaml(data, shown_path(path), error)


def parse_yaml(
    data: bytes | str, source: str, error: type[Exception], most_bytes: int = MOST_YAML_BYTES
) -> object:
    """Return the content of YAML; raises `error` naming `source`."""
    if len(data) > most_bytes:
        raise error(f"{source}: larger than {most_bytes // 1_000_000} MB: not settings")
    try:
        text = data.decode("utf-8") if isinstance(data, bytes) else data
        _check_nesting(text)
        content = yaml.load(text, _Loader)
    except UnicodeDecodeError as fault:
        raise error(f"{source}: not text in UTF-8 (byte {fault.start})") from fault
    except yaml.YAMLError as fault:
        mark = getattr(fault, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(fault, "problem", None) or "malformed"
        raise error(f"{source}: not valid YAML{where}: {one_line(problem)}") from fault
    except RecursionError as fault:
        raise error(f"{source}: nested too deeply") from fault
    except (ValueError, TypeError, AttributeError, OverflowError) as fault:
        raise error(f"{source}: not valid YAML: {one_line(fault)}") from fault
    if _unfolded(content) > MOST_VALUES:
        raise error(f"{source}: more than {MOST_VALUES} values once its aliases are written out")
    return content


def _check_nesting(text: str) -> None:
    """Raise RecursionError for lists within lists, ValueError for numbers too long to be any.

    libyaml's loader nests on the machine's stack, and would end the program.
    """
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.ScalarEvent):
            plain = event.implicit[0] and len(event.value) > LONGEST_NUMBER
            if plain and event.value.lstrip("+-")[:1].isdigit():
                raise ValueError(f"a number of {len(event.value)} characters")
        if depth > MOST_NESTED:
            raise RecursionError


def _unfolded(content: object) -> float:
    """Return how many values there are when every alias is written out; endless: inf."""
    counted: dict[int, float] = {}
    pending = [(content, False)]
    while pending:
        value, left = pending.pop()
        if not isinstance(value, (dict, list)):
            continue
        children = list(value.values()) if isinstance(value, dict) else value
        if left:
            counted[id(value)] = 1 + sum(counted.get(id(child), 1) for child in children)
        elif id(value) not in counted:
            counted[id(value)] = np.inf  # of a list inside itself
            pending.append((value, True))
            pending.extend((child, False) for child in children)
    return counted.get(id(content), 1)


class StoredArrays:
    """The data sets of an open HDF5 file: in the file itself, and no larger than it can hold."""

    def __init__(self, file: h5py.File, size_bytes: int) -> None:
        self.file = file
        self.attributes = file.attrs
        self._size_bytes = size_bytes
        self._most_bytes = MOST_COMPRESSED * size_bytes + FREE_BYTES

    def __contains__(self, name: str) -> bool:
        return name in self.file

    def dataset(self, name: str) -> h5py.Dataset:
        """Return a data set, not read; raises KeyError or ValueError."""
        if not isinstance(self.file.get(name, getlink=True), h5py.HardLink):
            why = "is a link to elsewhere" if name in self.file.keys() else "is missing"  # noqa: SIM118
            raise KeyError(f"'{name}' {why}")
        found = self.file[name]
        if not isinstance(found, h5py.Dataset):
            raise KeyError(f"'{name}' is no data set")
        if found.is_virtual or found.external:
            raise ValueError(f"'{name}' lies in other files")
        if found.nbytes > self._most_bytes:
            raise ValueError(f"'{name}' of {found.nbytes:.3g} bytes does not fit into its file")
        if found.chunks is not None:
            self._check_chunks(name, found, found.chunks)
        return found

    def _check_chunks(self, name: str, found: h5py.Dataset, shape: tuple[int, ...]) -> None:
        """Raise ValueError where reading a chunk may take more memory than a data set may."""
        chunk_bytes = math.prod(shape) * found.dtype.itemsize
        if chunk_bytes > self._most_bytes:
            raise ValueError(
                f"'{name}' has chunks of {chunk_bytes:.3g} bytes, which do not fit into its file"
            )
        made = found.id.get_create_plist()
        filters = [made.get_filter(i)[0] for i in range(made.get_nfilters())]
        if len(set(filters)) < len(filters) or not _FILTERS.issuperset(filters):
            raise ValueError(f"'{name}' is packed in another way than by gzip or lzf, once")

    def array(self, name: str) -> NDArray:
        """Return a data set of numbers or truths; raises KeyError or ValueError."""
        found = self.dataset(name)
        if found.dtype.kind not in "biuf":
            raise ValueError(f"'{name}' holds no numbers")
        _check_written(name, found)
        values = np.asarray(found[()])
        for key in _BLANK:
            blank = found.attrs.get(key)
            invalid = 0 if blank is None else int(np.count_nonzero(values == blank))
            if invalid:
                raise ValueError(f"'{name}' has values that its {key} calls not valid: {invalid}")
        return values

    def part(self, name: str, index: Any) -> NDArray:
        """Return a part of a data set of numbers; raises KeyError or ValueError."""
        return self.dataset(name)[index]

    def text(self, name: str) -> str:
        """Return a data set that is one text; raises KeyError or ValueError."""
        found = self.dataset(name)
        if found.shape != () or found.dtype.kind not in "OS":
            raise ValueError(f"'{name}' is no text")
        return str(found.asstr()[()])


def _check_written(name: str, found: h5py.Dataset) -> None:
    """Raise ValueError where a part was never written, which HDF5 reads as the fill value."""
    if found.chunks is None:
        parts, there = 1, int(found.id.get_storage_size() > 0 or not found.nbytes)
    else:
        sides = zip(found.shape, found.chunks, strict=True)
        parts, there = math.prod(-(-n // side) for n, side in sides), found.id.get_num_chunks()
    if there < parts:
        raise ValueError(f"{parts - there} of the {parts} parts of '{name}' were never written")


@contextmanager
def stored_arrays(path: Path, error: type[Exception], remedy: str) -> Iterator[StoredArrays]:
    """Yield the data sets of an HDF5 file; whatever fails in reading them raises `error`.

    remedy: advice for a damaged file, or a file with other content.
    """
    size = check_regular(path, error)
    try:
        with h5py.File(path, "r") as file:
            yield StoredArrays(file, size)
    except (error, AdvisedError):
        raise
    except FAULTS as fault:
        if not h5py.is_hdf5(path):
            start = file_bytes(path, error, HEAD_BYTES)
            raise error(f"{shown_path(path)}: {not_read(start, 'HDF5')}; {remedy}") from fault
        why = f"cannot be read ({one_line(fault)})"
        raise error(f"{shown_path(path)}: {why}; {remedy}") from fault


def holds_array(path: Path, name: str) -> bool:
    """Return whether a path is HDF5 with a data set of that name."""
    try:
        with stored_arrays(path, ValueError, "") as stored:
            return stored.dataset(name) is not None
    except ValueError:
        return False

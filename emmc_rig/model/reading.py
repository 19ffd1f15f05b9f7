"""Files from outside as plain data: YAML, JSON, HDF5 and PNG, bounded in depth and memory.

Whatever is wrong with a file raises the caller's error with one line that names the file.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

MOST_YAML_BYTES, MOST_VALUES = 16_000_000, 1_000_000
"""Of a file of settings, and of the values in it with aliases written out: a plan of a thousand
shots has a hundredth of either."""
MOST_PICTURE_PIXELS = 2**28
MOST_COMPRESSED, FREE_BYTES = 1100, 2**26
"""How many times its file a data set may be: deflate packs 1,032 equal bytes into one. And the
bytes that even a nearly empty file may unfold to."""
_PNG_START, _PNG_HEADER = b"\x89PNG\r\n\x1a\n", struct.Struct(">8s4x4sII")
_FAULTS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError)


class _Loader(yaml.SafeLoader):
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
    name = shown_path(path)
    try:
        with open(path, "rb") as file:
            data = file.read(MOST_YAML_BYTES + 1)
    except FileNotFoundError as fault:
        raise error(f"{name}: no such file") from fault
    except (OSError, ValueError) as fault:
        why = getattr(fault, "strerror", None) or fault
        raise error(f"{name}: cannot be read ({why})") from fault
    return parse_yaml(data, name, error)


def shown_path(path: Path) -> str:
    """Return a path on one line: control characters escaped, no longer than a name can be."""
    text = "".join(one if one.isprintable() else repr(one)[1:-1] for one in str(path))
    return text if len(text) <= 300 else f"{text[:300]}..."


def parse_yaml(data: bytes | str, source: str, error: type[Exception]) -> object:
    """Return the content of YAML; raises `error` naming `source`."""
    if len(data) > MOST_YAML_BYTES:
        raise error(f"{source}: larger than {MOST_YAML_BYTES // 1_000_000} MB: not settings")
    try:
        text = data.decode("utf-8") if isinstance(data, bytes) else data
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
            counted[id(value)] = 1 + sum(counted.get(id(one), 1) for one in children)
        elif id(value) not in counted:
            counted[id(value)] = np.inf  # of one inside itself
            pending.append((value, True))
            pending.extend((one, False) for one in children)
    return counted.get(id(content), 1)


def parse_json(data: bytes | str, source: str, error: type[Exception]) -> Any:
    """Return the content of JSON; raises `error` naming `source`."""
    try:
        return json.loads(data)
    except RecursionError as fault:
        raise error(f"{source}: nested too deeply") from fault
    except ValueError as fault:
        raise error(f"{source}: not JSON ({one_line(fault)})") from fault


class StoredArrays:
    """The data sets of an open HDF5 file: in the file itself, and no larger than it can hold."""

    def __init__(self, file: h5py.File, size_bytes: int) -> None:
        self.file = file
        self.attributes = file.attrs
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
        return found

    def array(self, name: str) -> NDArray:
        """Return a data set of numbers or truths; raises KeyError or ValueError."""
        found = self.dataset(name)
        if found.dtype.kind not in "biuf":
            raise ValueError(f"'{name}' holds no numbers")
        return np.asarray(found[()])

    def text(self, name: str) -> str:
        """Return a data set that is one text; raises KeyError or ValueError."""
        found = self.dataset(name)
        if found.shape != () or found.dtype.kind not in "OS":
            raise ValueError(f"'{name}' is no text")
        return str(found.asstr()[()])


@contextmanager
def stored_arrays(path: Path, error: type[Exception], remedy: str) -> Iterator[StoredArrays]:
    """Yield the data sets of an HDF5 file; whatever fails in reading them raises `error`.

    remedy: what to do about a file that is damaged or not what was expected.
    """
    try:
        size = path.stat().st_size
    except FileNotFoundError as fault:
        raise error(f"{shown_path(path)}: no such file") from fault
    except (OSError, ValueError) as fault:
        why = getattr(fault, "strerror", None) or fault
        raise error(f"{shown_path(path)}: cannot be read ({why})") from fault
    try:
        with h5py.File(path, "r") as file:
            yield StoredArrays(file, size)
    except error:
        raise
    except _FAULTS as fault:
        why = f"cannot be read, damaged or incomplete ({one_line(fault)})"
        raise error(f"{shown_path(path)}: {why}; {remedy}") from fault


def check_png_size(content: bytes, source: str, error: type[Exception]) -> None:
    """Raise `error` for a PNG whose header claims more pixels than a picture has."""
    if len(content) < _PNG_HEADER.size:
        return
    start, chunk, columns, rows = _PNG_HEADER.unpack_from(content)
    if start == _PNG_START and chunk == b"IHDR" and columns * rows > MOST_PICTURE_PIXELS:
        raise error(f"{source}: {columns} x {rows} pixels, more than any picture here can have")


def one_line(fault: object) -> str:
    """Return an error's message on one line, cut to a length."""
    text = fault.args[0] if isinstance(fault, KeyError) and fault.args else fault
    return " ".join(str(text).split())[:300]

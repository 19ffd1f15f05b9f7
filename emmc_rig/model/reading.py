"""Files from outside as plain data: YAML, HDF5 and pictures, bounded in depth and memory.

Whatever is wrong with a file raises the caller's error with one line that names the file. No other
module calls these decoders, nor JSON's beside `json_text`: `tests/files/test_decoders.py` says so.
"""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

from emmc_rig.model.json_text import one_line, shown_path

MOST_YAML_BYTES, MOST_VALUES, MOST_NESTED = 1_000_000, 1_000_000, 100
"""Of a file of settings, of the values in it with aliases written out, and of lists within lists: a
plan of a thousand shots has 160 kB, 10,000 values and 6 within one another."""
LONGEST_NUMBER = 4000
"""In characters; the time for one in base 60 grows with the square of its length."""
MOST_PICTURE_PIXELS = 2**28
MOST_DEFLATED = 1032
"""How many equal bytes deflate packs into one (RFC 1951: 258 bytes in 2 bits)."""
MOST_COMPRESSED, FREE_BYTES, FREE_PICTURE_BYTES = 100, 2**26, 2**30
"""How many times its file a data set may be, and the bytes that even a nearly empty file may hold
unpacked: light fields pack to a tenth, even maps by lzf to a ninetieth. A picture, as float32, may
be more, since masks have large even areas: 89 megapixels, or MOST_DEFLATED times its file."""
_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000
_FILTERS = frozenset((_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF))
"""Filters of HDF5 whose memory a chunk's size bounds; others allocate what the file says."""
_PNG_START, _PNG_HEADER = b"\x89PNG\r\n\x1a\n", struct.Struct(">IIBBBBB")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_PNG_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
"""By colour type. Source: PNG 1.2, table 11.1 (the channels, and the depths allowed)."""
_OTHER_PICTURES = ("BMP", "GIF", "JPEG", "JPEG2000", "PPM", "TIFF", "WEBP")
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
            counted[id(value)] = 1 + sum(counted.get(id(one), 1) for one in children)
        elif id(value) not in counted:
            counted[id(value)] = np.inf  # of one inside itself
            pending.append((value, True))
            pending.extend((one, False) for one in children)
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
    except FAULTS as fault:
        why = f"cannot be read, damaged or incomplete ({one_line(fault)})"
        raise error(f"{shown_path(path)}: {why}; {remedy}") from fault


def holds_array(path: Path, name: str, form: str | None = None) -> bool:
    """Return whether a path is HDF5 with a data set of that name, its `format` as given."""
    try:
        with stored_arrays(path, ValueError, "") as stored:
            return stored.dataset(name) is not None and (
                form is None or stored.attributes.get("format") == form
            )
    except ValueError:
        return False


def decode_picture(content: bytes, source: str, error: type[Exception]) -> NDArray:
    """Return the codes of a picture file, (y, x) or (y, x, channel), blue first.

    PNG is checked whole before it is decoded. Raises `error` for what is no picture, is damaged, or
    claims more pixels than its bytes can hold.
    """
    import cv2  # a sixth of a second, which settings need not

    if content.startswith(_PNG_START):
        rows, columns = _png_size(content, source, error)
    else:
        rows, columns = _picture_size(content, source, error)
    if rows * columns > MOST_PICTURE_PIXELS:
        raise error(f"{source}: {columns} x {rows} pixels, more than any picture here can have")
    if 12 * rows * columns > MOST_DEFLATED * len(content) + FREE_PICTURE_BYTES:
        raise error(f"{source}: {columns} x {rows} pixels, more than {len(content)} bytes can hold")
    try:
        codes = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError) as fault:
        raise error(f"{source}: cannot be decoded ({one_line(fault)})") from fault
    if codes is None:
        raise error(f"{source}: a picture cut short or damaged; copy it again")
    return np.asarray(codes)


def _png_size(content: bytes, source: str, error: type[Exception]) -> tuple[int, int]:
    """Return rows and columns; raises `error` unless header, checksums and length are right."""
    damaged = error(f"{source}: a PNG picture cut short or damaged; copy it again")
    place, header, data_bytes, name = len(_PNG_START), b"", 0, b""
    while name != b"IEND":
        length = int.from_bytes(content[place : place + 4], "big")
        name, end = content[place + 4 : place + 8], place + 8 + length
        if end + 4 > len(content):
            raise damaged
        chunk = memoryview(content)[place + 4 : end]
        if zlib.crc32(chunk) != int.from_bytes(content[end : end + 4], "big"):
            raise damaged
        if not header:
            header = bytes(chunk)
        data_bytes += length if name == b"IDAT" else 0
        place = end + 4
    if header[:4] != b"IHDR" or len(header) != 4 + _PNG_HEADER.size:
        raise damaged
    columns, rows, depth, kind, packing, filtering, interlace = _PNG_HEADER.unpack(header[4:])
    if depth not in _PNG_DEPTHS.get(kind, ()):
        raise error(f"{source}: {depth} bits a sample of colour type {kind}, which no PNG has")
    if packing or filtering or interlace > 1 or not columns or not rows:
        raise damaged
    unpacked_bytes = rows * math.ceil(columns * _PNG_CHANNELS[kind] * depth / 8)
    if rows * columns <= MOST_PICTURE_PIXELS and unpacked_bytes > MOST_DEFLATED * data_bytes:
        raise error(f"{source}: {columns} x {rows} pixels, more than {len(content)} bytes can hold")
    return rows, columns


def _picture_size(content: bytes, source: str, error: type[Exception]) -> tuple[int, int]:
    """Return rows and columns of a picture that is no PNG, from its header alone."""
    from PIL import Image

    try:
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(io.BytesIO(content), formats=_OTHER_PICTURES) as picture,
        ):
            columns, rows = picture.size
    except Image.DecompressionBombError as fault:
        raise error(f"{source}: {one_line(fault)}") from fault
    except (SyntaxError, struct.error, *FAULTS) as fault:
        raise error(f"{source}: not a picture, or damaged") from fault
    return rows, columns

"""Bytes of regular files, and the names of formats that are not read, by how their files begin."""

from __future__ import annotations

import re
import stat
from pathlib import Path

from emmc_rig.model.json_text import shown_path

_OTHER_KINDS = (
    (stat.S_ISDIR, "a folder, where a file is meant"),
    (stat.S_ISFIFO, "a pipe, not a file; write what it gives into a file, and name that"),
    (stat.S_ISSOCK, "a socket, not a file"),
    (stat.S_ISCHR, "a device, not a file"),
    (stat.S_ISBLK, "a device, not a file"),
)
_VECTOR = "draw it as a PNG, one pixel a cell"
_FOREIGN = (
    (0, rb"SIMPLE  =", "a FITS file"),
    (4, rb"ftyp(hei|hev|mif1|msf1)", "a HEIC picture"),
    (4, rb"ftypavi[fs]", "an AVIF picture"),
    (4, rb"ftyp", "a video (MP4 or QuickTime)"),
    (0, rb"\s*(999\r?\n.*\r?\n\s*)*0\r?\n\s*SECTION\r?\n", f"a DXF drawing; {_VECTOR}"),
    (0, rb"AutoCAD Binary DXF", f"a DXF drawing; {_VECTOR}"),
    (0, rb"AC10\d\d", f"a DWG drawing; {_VECTOR}"),
    (0, rb"\x00\x06\x00\x02", f"a GDS layout; {_VECTOR}"),
    (0, rb"%SEMI-OASIS", f"an OASIS layout; {_VECTOR}"),
    (0, rb"%PDF", f"a PDF; {_VECTOR}"),
    (0, rb"%!PS", f"PostScript; {_VECTOR}"),
    (0, rb"(\xef\xbb\xbf)?\s*(<\?xml[^>]*>\s*)?(<!--.*?-->\s*|<!DOCTYPE svg[^>]*>\s*)*<svg",
     f"an SVG drawing; {_VECTOR}"),
    (0, rb"(?i)\s*(<!doctype html|<html)", "a web page: was the file itself downloaded?"),
    (0, rb"version https://git-lfs", "a pointer of Git LFS: fetch the file itself by git lfs pull"),
    (0, rb"8BPS", "a Photoshop document"),
    (0, rb"#\?(RADIANCE|RGBE)", "a Radiance HDR picture"),
    (0, rb"P[Ff]\n", "a PFM picture"),
    (0, rb"(\xff\x0a|\x00\x00\x00\x0cJXL )", "a JPEG XL picture"),
    (0, rb"RIFF....AVI ", "a video (AVI)"),
    (0, rb"\x1aE\xdf\xa3", "a video (Matroska or WebM)"),
    (0, rb"ZISRAWFILE", "a CZI file of Zeiss"),
    (0, rb"\xda\xce\xbe\x0a", "an ND2 file of Nikon"),
    (0, rb"\x70\x00\x00\x00", "an LIF file of Leica"),
    (0, rb"\x80[\x02-\x05]", "a Python pickle"),
    (0, rb"PK\x03\x04", "a ZIP archive; unpack it"),
    (0, rb"\x1f\x8b", "a gzip archive; unpack it"),
    (0, rb"\x93NUMPY", "an array of NumPy"),
    (0, rb"\x89HDF\r\n\x1a\n", "an HDF5 file"),
    (0, rb"MATLAB ", "a MAT file"),
)  # fmt: skip
"""A place in a file, the pattern of its bytes there, the format's name; the first match counts."""
HEAD_BYTES = 4096


def check_regular(path: Path, error: type[Exception]) -> int:
    """Return a file's size in bytes; raises `error` unless it is a regular file.

    Nothing is opened: a pipe would wait for its writer, and a device gives bytes without end.
    """
    shown = shown_path(path)
    try:
        found = path.stat()
    except FileNotFoundError as fault:
        raise error(f"{shown}: no such file") from fault
    except (OSError, ValueError) as fault:
        why = getattr(fault, "strerror", None) or fault
        raise error(f"{shown}: cannot be read ({why})") from fault
    for is_kind, words in _OTHER_KINDS:
        if is_kind(found.st_mode):
            raise error(f"{shown}: {words}")
    return found.st_size


def file_bytes(path: Path, error: type[Exception], most_bytes: int = -1) -> bytes:
    """Return the bytes of a regular file, the first ones if `most_bytes` is given."""
    check_regular(path, error)
    try:
        with open(path, "rb") as file:
            return file.read(most_bytes)
    except (OSError, MemoryError) as fault:
        why = getattr(fault, "strerror", None) or "it does not fit into memory"
        raise error(f"{shown_path(path)}: cannot be read ({why})") from fault


def not_read(content: bytes, formats: str) -> str:
    """Return what is said of a file of no format that a door reads, which takes `formats`."""
    head = content[:HEAD_BYTES]
    kinds = (kind for at, begins, kind in _FOREIGN if re.match(begins, head[at:], re.DOTALL))
    kind = next(kinds, "of an unknown format" if content else "empty")
    return f"{kind}; formats read here are {formats}"

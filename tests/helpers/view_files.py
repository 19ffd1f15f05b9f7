"""Light fields as folders of `view_ROW_COL.png`, and PNG files made by hand, for tests."""

import struct
import zlib
from pathlib import Path

import numpy as np

from emmc_rig.formats.format import Export
from emmc_rig.formats.registry import FORMATS


def save_views(folder: Path, light_field: np.ndarray) -> None:
    """Write the views, 8 bits, into a folder that is made where missing."""
    folder.mkdir(parents=True, exist_ok=True)
    FORMATS["png8"].write(folder, Export("", "", light_field))


def png(columns, rows, depth=8, kind=2, data=b"", interlace=0, damage=0):
    """Return a PNG file whose header says what it is told; damage: of the header's checksum."""

    def chunk(name, content):
        body = name + content
        checksum = zlib.crc32(body) ^ (damage if name == b"IHDR" else 0)
        return struct.pack(">I", len(content)) + body + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", columns, rows, depth, kind, 0, 0, interlace)
    palette = chunk(b"PLTE", bytes(6)) if kind == 3 else b""
    parts = chunk(b"IHDR", header) + palette + chunk(b"IDAT", zlib.compress(data))
    return b"\x89PNG\r\n\x1a\n" + parts + chunk(b"IEND", b"")

"""Every view as a picture of its own: PNG of 8 or 16 bits, TIFF and EXR of floating values.

Values are linear. PNG files have the chunk gAMA = 1, by which viewers show the scene in its own
brightness; EXR files are linear by definition. Source: PNG 1.2, section 4.2.2.1.
"""

from __future__ import annotations

import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np

from emmc_rig.formats.format import Export, Format, extra_module, write_picture
from emmc_rig.model.srgb import codes_of

IHDR_END = 33
"""Of every PNG: signature 8, length 4, type 4, data 13, checksum 4."""


def _write_png(folder: Path, export: Export, bits: int) -> None:
    for v, u in np.ndindex(export.light_field.shape[:2]):
        path = folder / f"view_{v}_{u}.png"
        write_picture(path, codes_of(export.light_field[v, u], bits))
        path.write_bytes(_tagged_linear(path.read_bytes()))


def _tagged_linear(png: bytes) -> bytes:
    """Return a PNG with the chunk that says gamma 1, in hundred thousandths."""
    chunk = b"gAMA" + struct.pack(">I", 100_000)
    whole = struct.pack(">I", 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return png[:IHDR_END] + whole + png[IHDR_END:]


def _write_tiff(folder: Path, export: Export) -> None:
    import tifffile  # loads for a sixth of a second

    for v, u in np.ndindex(export.light_field.shape[:2]):
        view = np.ascontiguousarray(export.light_field[v, u], np.float32)
        tifffile.imwrite(
            folder / f"view_{v}_{u}.tif", view, photometric="rgb", compression="zlib",
            description="linear RGB, 1 is white",
        )  # fmt: skip


def _write_exr(folder: Path, export: Export) -> None:
    openexr = extra_module("OpenEXR", "EXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    for v, u in np.ndindex(export.light_field.shape[:2]):
        view = np.ascontiguousarray(export.light_field[v, u], np.float32)
        with openexr.File(header, {"RGB": view}) as file:
            file.write(str(folder / f"view_{v}_{u}.exr"))


FORMATS = (
    Format("png8", "view_ROW_COL.png", "8 bits, linear, tagged so", partial(_write_png, bits=8)),
    Format("png16", "view_ROW_COL.png", "16 bits, linear, tagged so", partial(_write_png, bits=16)),
    Format(
        "tiff", "view_ROW_COL.tif", "32-bit floating values, linear", _write_tiff,
    ),
    Format(
        "exr", "view_ROW_COL.exr", "32-bit floating values, linear", _write_exr,
    ),
)  # fmt: skip

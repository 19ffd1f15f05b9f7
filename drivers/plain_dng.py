"""Uncompressed DNG: the mosaic where it lies in the file, without a decoder and without a copy.

Only for what needs no decision: one image of whole 16-bit samples behind one another, a Bayer
tile, and no tag whose meaning is not known here to leave the samples alone. Everything else is
LibRaw's, which must agree wherever both can read. Source: Adobe Digital Negative specification
1.4.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import tifffile

Array = np.ndarray

PHASES = {(0, 1, 1, 2): "rggb", (1, 0, 2, 1): "grbg", (1, 2, 0, 1): "gbrg", (2, 1, 1, 0): "bggr"}
PLACES = (256, 257, 273, 279)
WHOLE = (tifffile.DATATYPE.SHORT, tifffile.DATATYPE.LONG)
"""What size, strip offsets and strip lengths may be written as; tifffile reads bytes too."""

SMALLEST_SIDE_PX = 22
"""LibRaw takes anything smaller for a thumbnail."""

PRIVATE_DATA_TAG, PRIVATE_DATA_OWNER = 50740, b"emmc-rig: camera's bytes\0"
"""DNGPrivateData, which begins with the name of the program that can read it: this one."""

FIXED = {
    254: (None, 0),
    259: (1,),
    262: (32803,),
    266: (None, 1),
    274: (None, 1),
    277: (1,),
    284: (None, 1),
    317: (None, 1),
    339: (None, 1),
    258: (16,),
    33421: ((2, 2),),
    50710: (None, b"\x00\x01\x02", (0, 1, 2)),
    50711: (None, 1),
}
"""By tag, the values with which the samples are what they seem; None: it may be absent."""

HARMLESS = frozenset(
    (
        *(256, 257, 270, 271, 272, 273, 278, 279, 282, 283, 296, 305, 306, 315, 33432),
        *(33422, 33434, 33437, 34665, 34855, 42033),
        *(50706, 50707, 50708, 50713, 50714, 50717),
        *range(50721, 50733),
        *(50735, 50778, 50779, 50827, 51041, PRIVATE_DATA_TAG),
    )
)
"""Size, place, texts, colour, noise and private data; black and white levels are read below."""


def read_in_place(data: bytes, tiff: tifffile.TiffFile) -> tuple[Array, Array, int, str] | None:
    """Return mosaic, black levels `(2, 2)`, white level and phase; None: leave it to LibRaw.

    The mosaic is uint16 `(y, x)`, read-only, and keeps `data` alive. Raises what `tifffile`
    raises for damaged tags.
    """
    page: Any = tiff.pages.first
    tags = page.tags
    if tiff.byteorder != "<" or len(tiff.pages) != 1 or 50706 not in tags:
        return None
    entries = int.from_bytes(data[page.offset : page.offset + 2], "little")
    if len({tag.code for tag in tags}) != entries:
        return None  # one that tifffile could not read and passed over, or one twice
    if any(tags[code].dtype not in WHOLE for code in PLACES if code in tags):
        return None
    if any(tag.code not in FIXED and tag.code not in HARMLESS for tag in tags):
        return None
    if any(tags.valueof(code) not in allowed for code, allowed in FIXED.items()):
        return None
    private = tags.valueof(PRIVATE_DATA_TAG, PRIVATE_DATA_OWNER)
    if not (isinstance(private, bytes) and private.startswith(PRIVATE_DATA_OWNER)):
        return None
    rows, columns = page.imagelength, page.imagewidth
    phase = PHASES.get(tuple(tags.valueof(33422, ())))
    white = tags.valueof(50717)
    black = _black_levels(tags)
    offset = _start(page, 2 * rows * columns)
    if phase is None or black is None or offset is None or min(rows, columns) < SMALLEST_SIDE_PX:
        return None
    if not isinstance(white, int) or not black.max() < white <= 0xFFFF:
        return None
    mosaic = np.frombuffer(data, "<u2", rows * columns, offset).reshape(rows, columns)
    return mosaic, black, white, phase


def _black_levels(tags: Any) -> Array | None:
    levels = tags.valueof(50714)
    levels = (levels,) if isinstance(levels, int) else levels
    repeat = tuple(tags.valueof(50713, (1, 1)))
    if not isinstance(levels, tuple) or len(levels) != repeat[0] * repeat[-1]:
        return None
    if repeat not in ((1, 1), (2, 2)) or not all(isinstance(n, int) and n >= 0 for n in levels):
        return None
    return np.broadcast_to(np.array(levels, np.float64).reshape(repeat), (2, 2)).copy()


def _start(page: Any, size: int) -> int | None:
    """Return where samples of that size in bytes begin that lie behind one another, even."""
    offsets, counts = list(page.dataoffsets), list(page.databytecounts)
    follows = all(
        offset + count == following
        for offset, count, following in zip(offsets[:-1], counts[:-1], offsets[1:], strict=True)
    )
    if not offsets or not follows or sum(counts) != size or offsets[0] % 2:
        return None
    return offsets[0]

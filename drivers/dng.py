"""DNG files: a mosaic in, bytes out that LibRaw decodes exactly.

Source: Adobe Digital Negative specification 1.4 (tags 50706 to 50829) and TIFF/EP (CFA tags).
"""

import io
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from typing import Any

import numpy as np
import tifffile

from emmc_rig.drivers.camera import CameraIdentity
from emmc_rig.drivers.errors import RawFrameError
from emmc_rig.drivers.raw import (
    BLACK_COLUMNS_TAG,
    BLACK_REPEAT_TAG,
    BLACK_ROWS_TAG,
    BLACK_TAG,
    CFA_TILE_PREFIX,
    EXIF_TIME,
    RawFrame,
    hashed,
)

Array = np.ndarray

BAYER_PATTERNS = {
    "rggb": (0, 1, 1, 2),
    "grbg": (1, 0, 2, 1),
    "gbrg": (1, 2, 0, 1),
    "bggr": (2, 1, 1, 0),
}
SMALLEST_SIDE_PX = 22
"""LibRaw takes anything smaller for a thumbnail."""
PRIVATE_DATA_TAG, PRIVATE_DATA_OWNER = 50740, b"emmc-rig: camera's bytes\0"
"""DNGPrivateData, and this program's name, with which our private data begin."""
MONO = "mono"
STAND_IN_PHASE = "rggb"
"""Written for a colour tile that is not Bayer; the tile's name goes into ImageDescription."""
LARGEST_TILE = 4096
"""Of black levels: LibRaw takes no larger ones."""
BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
PHOTOMETRIC_TAG, PHOTOMETRIC_CFA, PHOTOMETRIC_LINEAR_RAW = 262, 32803, 34892
D65 = 21
IDENTITY_MATRIX = tuple(
    n for row in np.eye(3, dtype=int).tolist() for value in row for n in (value, 1)
)
EXIF_POINTER_TAG, EXIF_VERSION = 34665, b"0232"
STAND_IN_TAG = EXIF_POINTER_TAG + 1
"""tifffile writes no pointer to EXIF, but a tag of the next number, in the same place."""
LARGEST_ISO = 65535
SIMULATED = CameraIdentity("EMMC", "EMMC simulated camera")


@dataclass(frozen=True)
class Facts:
    """Further facts on a frame for its DNG; None or "" for unknown facts.

    captured: with the time zone, if known. document: a name. unique_id: 32 hexadecimal digits,
    different for every picture.
    """

    iso: int | None = None
    captured: datetime | None = None
    document: str = ""
    unique_id: str = ""
    software: str = ""


def encode_dng(
    mosaic: Array,
    cfa: str,
    black_level_dn: float | Array,
    white_level_dn: int,
    exposure_s: float | None,
    identity: CameraIdentity = SIMULATED,
    private: bytes | None = None,
    facts: Facts | None = None,
) -> bytes:
    """Return a DNG with the uint16 `(y, x)` mosaic in it, uncompressed.

    `cfa` is a Bayer phase, "mono", or the name of another tile, which is stored in a tag of ours
    while the file claims rggb, for LibRaw. `black_level_dn` is a number, or a tile of them as
    in `RawFrame`. `exposure_s`: None if unknown.
    `private`: bytes to store in the file; `private_data` returns them. `facts`: go into its EXIF
    directory, with exposure and the camera's serial number. Raises `ValueError`.
    """
    black = np.atleast_2d(np.asarray(black_level_dn, np.float64))
    _check(mosaic, cfa, black, exposure_s)
    tags = _file_tags(identity, int(white_level_dn), exposure_s, private, facts)
    tags += _level_tags(black, cfa) + ([] if cfa == MONO else _colour_tags(cfa))
    named = cfa == MONO or cfa in BAYER_PATTERNS
    file = io.BytesIO()
    tifffile.imwrite(
        file,
        np.ascontiguousarray(mosaic),
        photometric=PHOTOMETRIC_CFA,
        planarconfig=1,
        description=None if named else CFA_TILE_PREFIX + cfa,
        metadata=None,
        byteorder="<",
        software=False,
        extratags=tags,
    )
    if cfa == MONO:
        # One linear sample per pixel is what a monochrome DNG is; tifffile writes it but would
        # not label it so.
        file.seek(0)
        with tifffile.TiffFile(file) as tiff:
            tiff.pages.first.tags[PHOTOMETRIC_TAG].overwrite(PHOTOMETRIC_LINEAR_RAW)
    if facts is not None:
        exif = _exif(facts, identity.serial, exposure_s)
        _append_exif(file, exif)
    return file.getvalue()


Tag = tuple[int, int, int, Any, bool]
"""As tifffile takes it: code, type, count (0: of a text), value, whether it is written once."""


def _file_tags(
    identity: CameraIdentity,
    white_level_dn: int,
    exposure_s: float | None,
    private: bytes | None,
    facts: Facts | None,
) -> list[Tag]:
    """Return the tags of camera, file and exposure; with `facts`, exposure goes into EXIF."""
    tags: list[Tag] = [
        (271, ASCII, 0, identity.maker, True),
        (272, ASCII, 0, identity.model, True),
        (274, SHORT, 1, 1, True),
        (50706, BYTE, 4, (1, 4, 0, 0), True),
        (50707, BYTE, 4, (1, 1, 0, 0), True),
        (50708, ASCII, 0, identity.model, True),
        (50717, LONG, 1, white_level_dn, True),
    ]
    if exposure_s is not None and facts is None:
        exposure = Fraction(exposure_s).limit_denominator(1_000_000)
        tags.append((33434, RATIONAL, 1, (exposure.numerator, exposure.denominator), True))
    if facts is not None:
        tags += [
            (269, ASCII, 0, facts.document, True),
            (305, ASCII, 0, facts.software, True),
            (50735, ASCII, 0, identity.serial, True),
        ]
        if facts.captured is not None:
            tags.append((306, ASCII, 0, facts.captured.strftime(EXIF_TIME), True))
        tags = [tag for tag in tags if tag[3] != ""]
        tags.append((STAND_IN_TAG, LONG, 1, 0, True))
    if private is not None:
        kept = PRIVATE_DATA_OWNER + private
        tags.append((PRIVATE_DATA_TAG, UNDEFINED, len(kept), kept, True))
    return tags


def _colour_tags(cfa: str) -> list[Tag]:
    """Return the tags of a Bayer phase; `STAND_IN_PHASE` for a tile that is not Bayer."""
    pattern = BAYER_PATTERNS.get(cfa, BAYER_PATTERNS[STAND_IN_PHASE])
    return [
        (33421, SHORT, 2, (2, 2), True),
        (33422, BYTE, 4, pattern, True),
        (50710, BYTE, 3, (0, 1, 2), True),
        (50711, SHORT, 1, 1, True),
        (50721, SRATIONAL, 9, IDENTITY_MATRIX, True),
        (50728, RATIONAL, 3, (1, 1) * 3, True),
        (50778, SHORT, 1, D65, True),
    ]


def _level_tags(black: Array, cfa: str) -> list[Tag]:
    """Return the tags of black levels: a tile, to which rows and columns add where it is large.

    Raises `ValueError` for levels that are neither.
    """
    tile, added = black, []
    if black.size == 1 and cfa != MONO:
        tile = np.tile(black, (2, 2))
    if black.size > LARGEST_TILE:
        tile = black[:2, :2]
        rows, columns = (np.arange(length) % 2 for length in black.shape)
        of_rows, of_columns = black[:, 0] - tile[rows, 0], black[0] - tile[0, columns]
        if not np.allclose(black, tile[np.ix_(rows, columns)] + of_rows[:, None] + of_columns):
            raise ValueError("its black levels are neither a small tile nor by row and column")
        for tag, values in ((BLACK_ROWS_TAG, of_rows), (BLACK_COLUMNS_TAG, of_columns)):
            if values.any():
                added.append((tag, SRATIONAL, values.size, _rationals(values), True))
    if cfa == MONO and np.ptp(tile) == 0:
        tile = tile[:1, :1]
    whole = np.array_equal(tile, np.round(tile))
    values = tuple(map(int, tile.flat)) if whole else _rationals(tile)
    kind = LONG if whole else RATIONAL
    tags = [(BLACK_TAG, kind, tile.size, values if tile.size > 1 or not whole else values[0], True)]
    if tile.size > 1:
        tags.insert(0, (BLACK_REPEAT_TAG, SHORT, 2, tile.shape, True))
    return tags + added


def _rationals(values: Array) -> tuple[int, ...]:
    fractions = (Fraction(value).limit_denominator(10_000) for value in values.flat)
    return tuple(n for value in fractions for n in (value.numerator, value.denominator))


def _exif(facts: Facts, serial: str, exposure_s: float | None) -> dict[int, tuple[int, bytes]]:
    """Return type and little-endian value by tag; source: EXIF 2.32, section 4.6.5."""

    def text(value: str) -> tuple[int, bytes]:
        return ASCII, value.encode("ascii", "replace") + b"\0"

    found = {36864: (UNDEFINED, EXIF_VERSION)}
    if exposure_s is not None:
        exposure = Fraction(exposure_s).limit_denominator(1_000_000)
        found[33434] = RATIONAL, struct.pack("<II", exposure.numerator, exposure.denominator)
    if facts.iso is not None:
        found[34855] = SHORT, struct.pack("<H", min(facts.iso, LARGEST_ISO))
    if (at := facts.captured) is not None:
        found[36867] = text(at.strftime(EXIF_TIME))
        found[37520] = found[37521] = text(f"{at.microsecond // 1000:03d}")
        if at.tzinfo is not None:
            found[36880] = found[36881] = text(at.isoformat()[-6:])
    if facts.unique_id:
        found[42016] = text(facts.unique_id)
    if serial:
        found[42033] = text(serial)
    return found


def _append_exif(file: io.BytesIO, exif: Mapping[int, tuple[int, bytes]]) -> None:
    """Append an EXIF directory to a little-endian TIFF, and let its stand-in tag point there."""
    start = file.seek(0, io.SEEK_END)
    start += file.write(b"\0" * (start % 2))
    entries, data = b"", b""
    beyond = start + 2 + 12 * len(exif) + 4
    for tag, (kind, value) in sorted(exif.items()):
        size = {SHORT: 2, RATIONAL: 8}.get(kind, 1)
        held = value.ljust(4, b"\0")
        if len(value) > 4:
            held = struct.pack("<I", beyond + len(data))
            data += value + b"\0" * (len(value) % 2)
        entries += struct.pack("<HHI", tag, kind, len(value) // size) + held
    file.write(struct.pack("<H", len(exif)) + entries + struct.pack("<I", 0) + data)
    file.seek(0)
    with tifffile.TiffFile(file) as tiff:
        pointer = tiff.pages.first.tags[STAND_IN_TAG].offset
    file.seek(pointer)
    file.write(struct.pack("<HHII", EXIF_POINTER_TAG, LONG, 1, start))


def private_data(dng: bytes) -> bytes:
    """Return what `encode_dng` kept as `private`; raises `RawFrameError` where there is nothing."""
    try:
        with tifffile.TiffFile(io.BytesIO(dng)) as tiff:
            kept = tiff.pages.first.tags.valueof(PRIVATE_DATA_TAG)
    except (tifffile.TiffFileError, ValueError, TypeError) as error:
        raise RawFrameError(f"its table of contents is damaged ({error})") from error
    if not (isinstance(kept, bytes) and kept.startswith(PRIVATE_DATA_OWNER)):
        raise RawFrameError("it does not hold the camera's own bytes")
    return kept[len(PRIVATE_DATA_OWNER) :]


def frame_of_array(
    mosaic: Array,
    cfa: str,
    black_level_dn: float,
    white_level_dn: int,
    exposure_s: float | None,
    identity: CameraIdentity,
    host_time_s: float,
    metadata: Mapping[str, str],
    captured: datetime | None = None,
    camera_time_s: float | None = None,
) -> RawFrame:
    """Return the frame of a camera that gives arrays, kept as the DNG that it decodes from.

    captured: time of day, with a time zone; None: now. camera_time_s: see `RawFrame`.
    """
    facts = Facts(captured=captured or datetime.now().astimezone())
    original = encode_dng(
        mosaic, cfa, black_level_dn, white_level_dn, exposure_s, identity, facts=facts
    )
    own, black = mosaic.copy(), np.full((2, 2), float(black_level_dn))
    own.flags.writeable = black.flags.writeable = False
    with hashed(original) as digest:
        described = {"maker": identity.maker, "model": identity.model}
    return RawFrame(
        own,
        black,
        white_level_dn,
        cfa,
        exposure_s,
        original,
        digest.hexdigest(),
        camera_time_s=camera_time_s,
        host_time_s=host_time_s,
        metadata={**described, **metadata},
    )


def _check(mosaic: Array, cfa: str, black: Array, exposure_s: float | None) -> None:
    if mosaic.ndim != 2 or mosaic.dtype != np.uint16:
        raise ValueError(f"a mosaic is uint16 (y, x), not {mosaic.dtype} {mosaic.shape}")
    if min(mosaic.shape) < SMALLEST_SIDE_PX:
        raise ValueError(
            f"a DNG of {mosaic.shape[0]}x{mosaic.shape[1]} pixels is too small for LibRaw: "
            f"use at least {SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX}"
        )
    if not cfa.isascii() or not cfa:
        raise ValueError(f"the tile name {cfa!r} is not plain text")
    if not np.all(black >= 0):
        raise ValueError(f"a black level of {black.min():g} DN is below 0")
    if exposure_s is not None and not exposure_s > 0:
        raise ValueError(f"an exposure of {exposure_s:g} s is not positive")

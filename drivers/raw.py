"""RAW files: from a camera's bytes to the sensor's mosaic, with what is needed to read it."""

import hashlib
import io
import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rawpy
import tifffile

from drivers.errors import RawFrameError

Array = np.ndarray

TIFF_MAGICS = {
    b"II*\x00": b"II*\x00",
    b"MM\x00*": b"MM\x00*",
    b"IIRO": b"II*\x00",
    b"IIRS": b"II*\x00",
    b"MMOR": b"MM\x00*",
    b"IIU\x00": b"II*\x00",
}
"""First bytes of files that are laid out as TIFF, with TIFF's own: Olympus and Panasonic differ."""
PANASONIC = b"IIU\x00"
EXPOSURE_TIME_TAG = 33434
EXIF_TAG = 34665
IMAGE_DESCRIPTION_TAG = 270
CFA_TILE_PREFIX = "cfa_tile="
"""An ImageDescription that begins so names a colour tile larger than LibRaw's 2x2 phase."""

RAW_SUFFIXES = frozenset(
    (
        *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc"),
        *(".mef", ".mos", ".mrw", ".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl"),
        *(".sr2", ".srf", ".srw", ".x3f"),
    )
)
"""What makers call the RAW files that LibRaw knows."""

TAG_CODES = {"maker": 271, "model": 272, "captured": 306, "serial": 42033}
EXIF_NAMES = {
    "iso": "ISOSpeedRatings",
    "aperture": "FNumber",
    "captured": "DateTimeOriginal",
    "serial": "BodySerialNumber",
}
"""What a frame's metadata take from the file, where it has it."""

HASH_BESIDE_BYTES = 1 << 20
"""From here on a file is hashed in a thread of its own, while LibRaw decodes it."""

FEWEST_BITS_PER_PIXEL = 0.25
"""Of a whole file: lossless coding takes at least one, the lossy ones of cameras 1.5 and more."""
PENTAX_PEF = 65535
BITS_PER_SAMPLE_AT_LEAST = {
    tifffile.COMPRESSION.JPEG: 1.0,
    PENTAX_PEF: 1.0,
    tifffile.COMPRESSION.NIKON_NEF: 1.0,
    tifffile.COMPRESSION.SONY_ARW: 1.0,
}
"""By compression of a TIFF-based RAW image: a Huffman code has at least one bit."""
MOSAIC_PHOTOMETRICS = (tifffile.PHOTOMETRIC.CFA, tifffile.PHOTOMETRIC.LINEAR_RAW)
RW2_PIXELS_PER_BLOCK = {
    (4, 12): 14,
    (5, 12): 10,
    (5, 14): 9,
    (6, 12): 14,
    (6, 14): 11,
    (7, 12): 10,
    (7, 14): 9,
}
"""By raw format (0x2D) and bits (0x0A) of a Panasonic: pixels in a block of 16 bytes (LibRaw,
panasonic_load_raw, panasonicC6_load_raw, panasonicC7_load_raw)."""


@dataclass(frozen=True, eq=False)
class RawFrame:
    """One frame as the sensor gave it.

    `mosaic`: uint16 `(y, x)` in DN, read-only, black level still in it.
    `black_level_dn`: float64 `(2, 2)`, of the pixels `mosaic[i::2, j::2]`.
    `cfa`: "rggb", "grbg", "gbrg", "bggr", "mono", or the name of a tile that is not Bayer.
    `exposure_s`: None where neither the file nor the camera says.
    `original`: the camera's own bytes, `sha256` their digest in hexadecimal.
    `gain`: linear, 1 at the camera's base sensitivity; None where it is unknown.
    `camera_time_s`: the camera's own timestamp, from an origin of its own.
    `host_time_s`: when the frame had arrived, on the clock that the camera was given.
    `metadata`: what else the camera said of the frame.
    """

    mosaic: Array
    black_level_dn: Array
    white_level_dn: int
    cfa: str
    exposure_s: float | None
    original: bytes
    sha256: str
    gain: float | None = None
    camera_time_s: float | None = None
    host_time_s: float | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)


def decode_raw(data: bytes, expected_shape: tuple[int, int] | None = None) -> RawFrame:
    """Return the frame in the bytes of a RAW file: DNG, or any other that LibRaw knows.

    Raises `RawFrameError` for bytes that are no RAW file, that are torn, or too few for their
    picture, or a mosaic whose `(y, x)` is not `expected_shape`. LibRaw reports most damage, but
    fills what is missing of a plain DNG, of an empty tile or of a Panasonic's RW2 with zeros: the
    table of contents of a TIFF-based file (DNG, NEF, CR2, RW2, ORF, ...) is checked first. A
    flipped bit that still decodes cannot be distinguished from light: keep `sha256`.
    """
    if not data:
        raise RawFrameError("it is empty")
    tags = _read_tiff(data) if data[:4] in TIFF_MAGICS else _TiffTags()
    with hashed(data) as digest:
        mosaic, black_level_dn, white_level_dn, cfa = _decoded(data)
    if mosaic.dtype != np.uint16:
        raise RawFrameError("it holds floating-point pixels, not one mosaic of 16 bits")
    if expected_shape is not None and mosaic.shape != tuple(expected_shape):
        raise RawFrameError(
            f"it has {_size(mosaic.shape)} pixels (y x) instead of {_size(expected_shape)}"
        )
    mosaic.flags.writeable = False
    black_level_dn.flags.writeable = False
    return RawFrame(
        mosaic=mosaic,
        black_level_dn=black_level_dn,
        white_level_dn=white_level_dn,
        cfa=tags.tile or cfa,
        exposure_s=tags.exposure_s,
        original=data,
        sha256=digest.hexdigest(),
        metadata=tags.metadata,
    )


@dataclass(frozen=True)
class _TiffTags:
    """What the file says besides its pixels."""

    exposure_s: float | None = None
    tile: str | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)


def exposure_and_time(data: bytes) -> tuple[float | None, str]:
    """Return exposure in s and time of capture as a RAW file states them, None and "" where not.

    The picture is not decoded; only files laid out as TIFF are read. Raises `RawFrameError`.
    """
    tags = _read_tiff(data) if data[:4] in TIFF_MAGICS else _TiffTags()
    return tags.exposure_s, tags.metadata.get("captured", "")


def _decoded(data: bytes) -> tuple[Array, Array, int, str]:
    """Return mosaic, black levels `(2, 2)`, white level and phase; raises `RawFrameError`."""
    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            # Opened, not unpacked: LibRaw takes memory for what the file claims.
            claimed = raw.sizes.raw_height, raw.sizes.raw_width
            if 8 * len(data) < FEWEST_BITS_PER_PIXEL * math.prod(claimed):
                raise RawFrameError(
                    f"its {len(data)} bytes cannot hold {_size(claimed)} pixels (y x)"
                )
            mosaic = raw.raw_image_visible.copy()
            if mosaic.ndim != 2:
                raise RawFrameError("it holds colour pixels, not one mosaic")
            black_level_dn, cfa = _read_levels_and_phase(raw)
            white_level_dn = int(raw.white_level)
    except RawFrameError:
        raise
    except Exception as error:  # rawpy raises bare RuntimeErrors too, and what NumPy does
        raise RawFrameError(f"LibRaw cannot decode it ({_text(error)})") from error
    return mosaic, black_level_dn, white_level_dn, cfa


@contextmanager
def hashed(data: bytes) -> Iterator[Any]:
    """Yield the data's SHA-256, complete when the block ends."""
    digest = hashlib.sha256()
    if len(data) < HASH_BESIDE_BYTES:
        digest.update(data)
        yield digest
        return
    thread = threading.Thread(target=digest.update, args=(data,), name="sha256")
    thread.start()
    try:
        yield digest
    finally:
        thread.join()


def _read_levels_and_phase(raw: rawpy.RawPy) -> tuple[Array, str]:
    """Return the black levels `(2, 2)` in mosaic order, and the CFA phase.

    LibRaw lists black levels by colour, the second green last; the colour of a pixel leads back
    to its place.
    """
    by_colour = np.asarray(raw.black_level_per_channel, dtype=np.float64)
    if raw.num_colors == 1:
        return np.full((2, 2), by_colour[0]), "mono"
    sizes = raw.sizes
    colours = [
        [raw.raw_color(sizes.top_margin + row, sizes.left_margin + column) for column in (0, 1)]
        for row in (0, 1)
    ]
    if raw.raw_pattern is not None and raw.raw_pattern.shape == (6, 6):
        return by_colour[np.array(colours)], "xtrans"
    letters = raw.color_desc.decode("ascii").lower()
    return by_colour[np.array(colours)], "".join(letters[c] for pair in colours for c in pair)


def _read_tiff(data: bytes) -> _TiffTags:
    """Return what the tags say, having checked that every strip lies inside the file."""
    try:
        magic = data[:4]
        stream = io.BytesIO(TIFF_MAGICS[magic] + data[4:])
        with tifffile.TiffFile(stream) as tiff:
            pages = list(tiff.pages)
            for page in pages:
                pages.extend(page.pages or ())
            if magic == PANASONIC:
                missing = _rw2_bytes_missing(tiff.pages.first.tags, len(data))
            else:
                missing = max(_bytes_missing(page, len(data)) for page in pages)
            tags = tiff.pages.first.tags
            exif = tags.valueof(EXIF_TAG)
            exif = exif if isinstance(exif, dict) else {}
            exposure_s = _exposure_s(tags, exif)
            description = str(tags.valueof(IMAGE_DESCRIPTION_TAG, ""))
            metadata = {name: tags.valueof(tag) for name, tag in TAG_CODES.items()}
            metadata |= {name: exif.get(key) for name, key in EXIF_NAMES.items() if key in exif}
    except Exception as error:  # tifffile raises whatever it runs into in damaged tags
        raise RawFrameError(f"its table of contents is damaged ({_text(error)})") from error
    if missing > 0:
        raise RawFrameError(f"it is torn, at least {missing} bytes of pixels are missing")
    tile = description.removeprefix(CFA_TILE_PREFIX)
    return _TiffTags(
        exposure_s,
        tile if tile != description else None,
        {name: _shown(value) for name, value in metadata.items() if value is not None},
    )


def _shown(value: object) -> str:
    """Return a tag's value as text: a fraction as a number."""
    if isinstance(value, tuple) and len(value) == 2 and value[1]:
        return f"{value[0] / value[1]:g}"
    return str(value).strip()


def _bytes_missing(page: Any, file_size: int) -> int:
    """Return how many bytes of the page's pixels cannot be in a file of that size.

    Either its strips end beyond the file, or they are too short for the image.
    """
    beyond = [
        offset + count - file_size
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)
    ]
    bits = 0.0
    if page.compression == tifffile.COMPRESSION.NONE:
        bits = page.bitspersample
    elif page.photometric in MOSAIC_PHOTOMETRICS:
        bits = BITS_PER_SAMPLE_AT_LEAST.get(page.compression, 0.0)
    samples = page.imagewidth * page.imagelength * page.samplesperpixel
    short = math.ceil(samples * bits / 8) - sum(page.databytecounts)
    return max([short, *beyond])


def _rw2_bytes_missing(tags: Any, file_size: int) -> int:
    """Return how many bytes of a Panasonic's pixels cannot be in a file of that size.

    Their place is tag 0x118; the strip's own offset and length stand for nothing there. An
    unknown coding has at least one bit for each pixel.
    """
    width, height = tags.valueof(0x02), tags.valueof(0x03)
    offset = tags.valueof(0x118) or max(tags.valueof(0x111))
    per_block = RW2_PIXELS_PER_BLOCK.get((tags.valueof(0x2D), tags.valueof(0x0A)))
    needed = height * (width // per_block) * 16 if per_block else height * width // 8
    return offset + needed - file_size


def _exposure_s(tags: Any, exif: Mapping[str, Any]) -> float | None:
    """Return the exposure time from the first directory or from its EXIF directory."""
    rational = tags.valueof(EXPOSURE_TIME_TAG)
    if rational is None:
        rational = exif.get("ExposureTime")
    if rational is None:
        return None
    numerator, denominator = rational
    return numerator / denominator


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(str(n) for n in shape)


def _text(error: Exception) -> str:
    """Return an error's message on one line; LibRaw's come as bytes."""
    message = error.args[0] if error.args else type(error).__name__
    if isinstance(message, bytes):
        message = message.decode("utf-8", "replace")
    return str(message).splitlines()[0] if str(message) else type(error).__name__

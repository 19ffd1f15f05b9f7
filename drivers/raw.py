"""RAW files: from a camera's bytes to the sensor's mosaic, with what is needed to read it."""

import hashlib
import io
import math
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, timezone
from pathlib import PurePath
from typing import Any, BinaryIO

import numpy as np
import rawpy
import tifffile

from emmc_rig.drivers.errors import RawFrameError

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
EXPOSURE_TIME_TAG, ISO_TAG = 33434, 34855
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


def has_raw_suffix(name: str) -> bool:
    """Return whether a file's name is that of a RAW file."""
    return PurePath(name.lower()).suffix in RAW_SUFFIXES


TEXT_TAGS = {"maker": (271, "Make"), "model": (272, "Model"), "serial": (42033, "BodySerialNumber")}
NUMBER_TAGS = {"iso": (ISO_TAG, "ISOSpeedRatings"), "aperture": (33437, "FNumber")}
TIME_TAGS = (
    ((36867, "DateTimeOriginal"), (37521, "SubsecTimeOriginal"), (36881, "OffsetTimeOriginal")),
    ((306, "DateTime"), (37520, "SubsecTime"), (36880, "OffsetTime")),
)
"""Code and tifffile's name of the tags that a frame's metadata copy from the file."""
EXIF_TIME = "%Y:%m:%d %H:%M:%S"

DNG_VERSION_TAG, ACTIVE_AREA_TAG = 50706, 50829
BLACK_REPEAT_TAG, BLACK_TAG, BLACK_COLUMNS_TAG, BLACK_ROWS_TAG = 50713, 50714, 50715, 50716
"""DNG 1.4: BlackLevelRepeatDim, BlackLevel, BlackLevelDeltaH (by column), BlackLevelDeltaV."""
LONGEST_PERIOD = 64
"""Of rows or columns whose black levels repeat; others are kept for every row or column."""

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
    `black_level_dn`: float64 tile `(h, w)` that repeats over the mosaic: `(2, 2)`, the levels of
    the pixels `mosaic[i::2, j::2]`, unless the file's levels have another period, or none.
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

    @property
    def black_dn(self) -> float:
        """Mean black level."""
        return float(self.black_level_dn.mean())

    @property
    def span_dn(self) -> float:
        """From black to white, at least 1."""
        return max(1.0, self.white_level_dn - self.black_dn)

    def black_by_place(self) -> Array:
        """Return the black level of every pixel, `(y, x)` in DN, read-only."""
        levels = self.black_level_dn
        if np.ptp(levels) == 0:
            return np.broadcast_to(levels[0, 0], self.mosaic.shape)
        (rows, columns), (height, width) = self.mosaic.shape, levels.shape
        return np.tile(levels, (-(-rows // height), -(-columns // width)))[:rows, :columns]

    def with_one_black(self) -> "RawFrame":
        """Return the frame as it would be with one black level, the mean in whole DN.

        Pixels at the white level, and at 0, stay there: for figures and pictures.
        """
        if np.ptp(self.black_level_dn) == 0:
            return self
        mean = np.rint(self.black_level_dn.mean())
        shift = np.rint(mean - self.black_by_place()).astype(np.int32)
        moved = np.clip(self.mosaic + shift, 1, max(self.white_level_dn - 1, 1))
        kept = (self.mosaic == 0) | (self.mosaic >= self.white_level_dn)
        mosaic = np.where(kept, self.mosaic, moved).astype(np.uint16)
        return replace(self, mosaic=mosaic, black_level_dn=np.full((2, 2), mean))


def decode_raw(data: bytes, expected_shape: tuple[int, int] | None = None) -> RawFrame:
    """Return the frame in the bytes of a RAW file: DNG, or another format of LibRaw's.

    Raises `RawFrameError` for bytes that are no RAW file, for torn files and files too short for
    their picture, and for a mosaic `(y, x)` of another shape than `expected_shape`. LibRaw reports
    most damage, but fills missing pixels of a plain DNG, of an empty tile or of a Panasonic's RW2
    with zeros: the table of contents of a TIFF-based file (DNG, NEF, CR2, RW2, ORF, ...) is checked
    first. A flipped bit that still decodes cannot be distinguished from light: keep `sha256`.
    """
    if not data:
        raise RawFrameError("it is empty")
    magic = data[:4]
    tags = _read_tiff(_as_tiff(data), magic) if magic in TIFF_MAGICS else _TiffTags()
    with hashed(data) as digest:
        mosaic, black_level_dn, white_level_dn, cfa, margins = _decoded(data)
    if tags.levels is not None:
        black_level_dn = tags.levels.tile_at(margins, mosaic.shape)
    if mosaic.dtype != np.uint16:
        raise RawFrameError(
            "it holds floating-point pixels, not one mosaic of 16 bits", "use the camera's own file"
        )
    if expected_shape is not None and mosaic.shape != tuple(expected_shape):
        raise RawFrameError(
            f"it has {_size(mosaic.shape)} pixels (y x) instead of {_size(expected_shape)}",
            "use one size for all frames",
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


@dataclass(frozen=True, eq=False)
class _DngLevels:
    """Black levels as a DNG states them.

    tile: (h, w), repeated from `origin`, the first row and column of the active area. rows,
    columns: what is added to each row and column of the active area, (1,) where nothing is.
    """

    tile: Array
    rows: Array
    columns: Array
    origin: tuple[int, int]

    def tile_at(self, margins: tuple[int, int], shape: tuple[int, int]) -> Array:
        """Return the levels, as `RawFrame` has them, of a mosaic cut out at these margins."""
        places, added = [], []
        deltas = self.rows, self.columns
        for axis, delta in enumerate(deltas):
            start, period = margins[axis] - self.origin[axis], self.tile.shape[axis]
            own = np.arange(shape[axis]) + start
            values = delta[np.clip(own, 0, delta.size - 1)]
            count = min(shape[axis], max(2, math.lcm(period, _period(values))))
            places.append(own[:count] % period)
            added.append(values[:count])
        return self.tile[np.ix_(*places)] + added[0][:, None] + added[1]


def _period(values: Array) -> int:
    """Return the number of places after which values repeat; their count where none is short."""
    for period in range(1, min(LONGEST_PERIOD, values.size - 1) + 1):
        if np.array_equal(values[period:], values[:-period]):
            return period
    return values.size


@dataclass(frozen=True)
class _TiffTags:
    """Tags of the file; levels: black levels of a DNG, None where no DNG states them."""

    exposure_s: float | None = None
    tile: str | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    levels: _DngLevels | None = None


def exposure_and_time(file: BinaryIO) -> tuple[float | None, datetime | None]:
    """Return exposure in s and time of capture as a RAW file states them, None where it does not.

    The picture is not decoded; only files laid out as TIFF are read. Raises `RawFrameError`.
    """
    magic = file.read(4)
    file.seek(0)
    if magic not in TIFF_MAGICS:
        return None, None
    tags = _read_tiff(file if TIFF_MAGICS[magic] == magic else _as_tiff(file.read()), magic)
    return tags.exposure_s, captured_at(tags.metadata)


def captured_at(metadata: Mapping[str, str]) -> datetime | None:
    """Return when a frame was captured by its camera's clock, with a time zone if that is stated.

    metadata: a frame's; `captured` as EXIF writes times, `captured_fraction` the digits of a
    second, `captured_offset` +HH:MM. None where no time is stated.
    """
    try:
        at = datetime.strptime(metadata.get("captured", ""), EXIF_TIME)
    except ValueError:
        return None
    digits = metadata.get("captured_fraction", "")
    if digits.isdecimal():
        at += timedelta(seconds=int(digits) / 10 ** len(digits))
    match = re.fullmatch(r"([+-])(\d\d):([0-5]\d)", metadata.get("captured_offset", ""))
    if match and int(match[2]) < 24:
        offset = timedelta(hours=int(match[2]), minutes=int(match[3]))
        at = at.replace(tzinfo=timezone(-offset if match[1] == "-" else offset))
    return at


def _decoded(data: bytes) -> tuple[Array, Array, int, str, tuple[int, int]]:
    """Return mosaic, black levels, white level, phase, and rows and columns cut off before it.

    Raises `RawFrameError`.
    """
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
                raise RawFrameError(
                    "it holds colour pixels, not one mosaic", "use the camera's own file"
                )
            black_level_dn, cfa = _read_levels_and_phase(raw)
            white_level_dn = int(raw.white_level)
            margins = raw.sizes.top_margin, raw.sizes.left_margin
    except RawFrameError:
        raise
    except Exception as error:  # rawpy raises bare RuntimeErrors too, and what NumPy does
        raise RawFrameError(f"LibRaw cannot decode it ({_text(error)})") from error
    return mosaic, black_level_dn, white_level_dn, cfa, margins


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
    """Return the black levels in mosaic order, and the CFA phase.

    LibRaw lists black levels by colour, the second green last; the colour of a pixel leads back
    to its place.
    """
    by_colour = np.asarray(raw.black_level_per_channel, dtype=np.float64)
    if raw.num_colors == 1:
        return np.full((2, 2), by_colour[0]), "mono"
    is_xtrans = raw.raw_pattern is not None and raw.raw_pattern.shape == (6, 6)
    sizes, side = raw.sizes, range(6 if is_xtrans else 2)
    colours = np.array(
        [
            [raw.raw_color(sizes.top_margin + row, sizes.left_margin + column) for column in side]
            for row in side
        ]
    )
    levels = by_colour[colours]
    if is_xtrans:
        return (levels if np.ptp(levels) else levels[:2, :2]), "xtrans"
    letters = raw.color_desc.decode("ascii").lower()
    return levels, "".join(letters[colour] for colour in colours.flat)


def _as_tiff(data: bytes) -> BinaryIO:
    """Return the bytes of a file laid out as TIFF with TIFF's own beginning."""
    return io.BytesIO(TIFF_MAGICS[data[:4]] + data[4:])


def _read_tiff(file: BinaryIO, magic: bytes) -> _TiffTags:
    """Return what the tags say, having checked that every strip lies inside the file.

    A tag with a value that it cannot have states nothing. Raises `RawFrameError`.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    try:
        with tifffile.TiffFile(file) as tiff:
            pages = list(tiff.pages)
            for page in pages:
                pages.extend(page.pages or ())
            if magic == PANASONIC:
                missing = _rw2_bytes_missing(tiff.pages.first.tags, size)
            else:
                missing = max(_bytes_missing(page, size) for page in pages)
            tags = tiff.pages.first.tags
            exif = tags.valueof(EXIF_TAG)
            exif = exif if isinstance(exif, dict) else {}
            levels = _dng_levels(pages) if DNG_VERSION_TAG in tags else None
            description = tags.valueof(IMAGE_DESCRIPTION_TAG)
            names_tile = isinstance(description, str) and description.startswith(CFA_TILE_PREFIX)
            found = _TiffTags(
                _number(tags, exif, EXPOSURE_TIME_TAG, "ExposureTime"),
                description.removeprefix(CFA_TILE_PREFIX) if names_tile else None,
                _metadata(tags, exif),
                levels,
            )
    except Exception as error:  # tifffile raises whatever it runs into in damaged tags
        raise RawFrameError(f"its table of contents is damaged ({_text(error)})") from error
    if missing > 0:
        raise RawFrameError(f"it is torn, at least {missing} bytes of pixels are missing")
    return found


def _metadata(tags: Any, exif: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts, numbers and time of capture that the tags state."""
    found = {name: _text_of(tags, exif, *at) for name, at in TEXT_TAGS.items()}
    for name, at in NUMBER_TAGS.items():
        number = _number(tags, exif, *at)
        found[name] = "" if number is None else f"{number:g}"
    for time, fraction, offset in TIME_TAGS:
        digits = re.findall(r"\d+", _text_of(tags, exif, *time))
        found["captured"] = "{}:{}:{} {}:{}:{}".format(*digits) if len(digits) == 6 else ""
        if captured_at(found) is not None:
            found["captured_fraction"] = _text_of(tags, exif, *fraction)
            found["captured_offset"] = _text_of(tags, exif, *offset)
            break
        found["captured"] = ""
    return {name: text for name, text in found.items() if text}


def _text_of(tags: Any, exif: Mapping[str, Any], code: int, name: str) -> str:
    """Return a text from the EXIF directory, else from the first; "" where neither states it."""
    values = exif.get(name), tags.valueof(code)
    texts = (value.strip() for value in values if isinstance(value, str))
    return next(filter(None, texts), "")


def _number(tags: Any, exif: Mapping[str, Any], code: int, name: str) -> float | None:
    """Return a positive number from the first directory, else from EXIF; None where not stated.

    A rational with a zero in it is how EXIF says that a value is not known.
    """
    for value in (tags.valueof(code), exif.get(name)):
        numbers = value if isinstance(value, tuple) else (value,)
        if code == ISO_TAG:  # some write several, the first that of the picture
            numbers = numbers[:1]
        plain = [number for number in numbers if isinstance(number, int | float)]
        if len(plain) != len(numbers) or len(plain) not in (1, 2):
            continue
        number = float(plain[0])
        if len(plain) == 2:
            number = number / plain[1] if plain[1] else math.nan
        if math.isfinite(number) and number > 0:
            return number
    return None


def _dng_levels(pages: Sequence[Any]) -> _DngLevels | None:
    """Return the black levels that the largest mosaic states; None where it states none.

    Source: DNG 1.4, BlackLevel and what follows; the active area is where its tile begins.
    """
    mosaics = [page for page in pages if page.photometric in MOSAIC_PHOTOMETRICS]
    page = max(mosaics, key=lambda page: page.imagewidth * page.imagelength, default=None)
    if page is None or page.samplesperpixel != 1:
        return None
    codes = BLACK_TAG, BLACK_REPEAT_TAG, BLACK_ROWS_TAG, BLACK_COLUMNS_TAG, ACTIVE_AREA_TAG
    stated = [_numbers(page.tags.get(code)) for code in codes]
    level, repeat, rows, columns, area = stated
    odd = any(
        value is None and code in page.tags for code, value in zip(codes, stated, strict=True)
    )
    if odd or (level is None and rows is None and columns is None):
        return None
    none = np.zeros(1)
    tile, rows, columns = (none if value is None else value for value in (level, rows, columns))
    size = (1, 1) if repeat is None else tuple(repeat.astype(int).tolist())
    top, left, bottom, right = (0, 0, page.imagelength, page.imagewidth)
    if area is not None and area.size == 4:
        top, left, bottom, right = area.astype(int).tolist()
    counts = rows.size in (1, bottom - top) and columns.size in (1, right - left)
    if not counts or len(size) not in (1, 2) or tile.size != math.prod(size):
        return None
    return _DngLevels(tile.reshape(size[0], -1), rows, columns, (top, left))


def _numbers(tag: Any) -> Array | None:
    """Return the numbers in a tag, float64; None for a missing tag or numbers not finite."""
    if tag is None or isinstance(tag.value, str | bytes):
        return None
    found = np.atleast_1d(np.asarray(tag.value, np.float64))
    if tag.dtype in (tifffile.DATATYPE.RATIONAL, tifffile.DATATYPE.SRATIONAL):
        with np.errstate(divide="ignore", invalid="ignore"):
            found = found[0::2] / found[1::2]
    return found if np.isfinite(found).all() else None


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


def _size(shape: tuple[int, ...]) -> str:
    return "x".join(str(n) for n in shape)


def _text(error: Exception) -> str:
    """Return an error's message on one line; LibRaw's come as bytes."""
    message = error.args[0] if error.args else type(error).__name__
    if isinstance(message, bytes):
        message = message.decode("utf-8", "replace")
    return str(message).splitlines()[0] if str(message) else type(error).__name__

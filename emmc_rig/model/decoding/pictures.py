"""Pictures but TIFF and EXR, decoded as a viewer shows them: upright, a palette as its colours."""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.decoding.regular import not_read
from emmc_rig.model.json_text import one_line
from emmc_rig.model.reading import FAULTS

MOST_PICTURE_PIXELS = 2**28
MOST_DEFLATED = 1032
"""How many equal bytes deflate packs into one (RFC 1951: 258 bytes in 2 bits)."""
FREE_PICTURE_BYTES = 2**30
"""What even a nearly empty picture may hold as float32, since masks have large even areas: 89
megapixels; a larger file may hold MOST_DEFLATED times its bytes."""
_PNG_START, _PNG_HEADER = b"\x89PNG\r\n\x1a\n", struct.Struct(">IIBBBBB")
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_PNG_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
"""By colour type. Source: PNG 1.2, table 11.1 (the channels, and the depths allowed)."""
_OTHER_PICTURES = ("BMP", "GIF", "JPEG", "JPEG2000", "PPM", "WEBP")
_ORIENTATION = 274
PICTURES = "PNG, TIFF, EXR, JPEG, JPEG 2000, WEBP, BMP, GIF and PPM"


class _Header(NamedTuple):
    rows: int
    columns: int
    orientation: int
    pictures: int


def upright(codes: NDArray, orientation: int, axes: tuple[int, int] = (0, 1)) -> NDArray:
    """Return a picture as its tag Orientation wants it shown, 1 to 8; any other changes nothing.

    axes: of rows and columns. Source: TIFF 6.0, section 8.
    """
    if orientation in (2, 4, 5, 7):
        codes = np.flip(codes, axes[1] if orientation in (2, 5) else axes[0])
    turns = {3: 2, 5: 1, 6: 3, 7: 1, 8: 1}.get(orientation, 0)
    return np.rot90(codes, turns, axes)


def orientation_in(tiff: bytes) -> int:
    """Return the Orientation of bytes that are laid out as TIFF, such as EXIF and many RAW files.

    1 where there is none.
    """
    from PIL import Image

    exif = Image.Exif()
    try:
        exif.load(tiff)
        return int(exif.get(_ORIENTATION, 1))
    except (SyntaxError, struct.error, *FAULTS):
        return 1


def without_alpha(codes: NDArray, full_scale: float) -> tuple[NDArray, bool]:
    """Return a picture (..., values a pixel) without the last value, and whether all is opaque."""
    opaque = bool(np.all(codes[..., -1] == full_scale))
    codes = codes[..., :-1]
    return codes[..., 0] if codes.shape[-1] == 1 else codes, opaque


def decode_picture(content: bytes, source: str, error: type[Exception]) -> tuple[NDArray, bool]:
    """Return the codes of a picture, (y, x) or (y, x, 3) with red first, and whether it is opaque.

    PNG is checked whole before it is decoded. Raises `error` for what is no picture, several, cut
    short, or claims more pixels than its bytes can hold.
    """
    import cv2  # a sixth of a second, which settings need not

    is_png = content.startswith(_PNG_START)
    header = (_png_header if is_png else _other_header)(content, source, error)
    rows, columns = header.rows, header.columns
    if rows * columns > MOST_PICTURE_PIXELS:
        raise error(f"{source}: {columns} x {rows} pixels, more than any picture here can have")
    if 12 * rows * columns > MOST_DEFLATED * len(content) + FREE_PICTURE_BYTES:
        raise error(f"{source}: {columns} x {rows} pixels, more than {len(content)} bytes can hold")
    if header.pictures > 1:
        raise error(f"{source}: an animation of {header.pictures} pictures; save each as a file")
    opaque = True
    try:
        if content.startswith(b"\xff\xd8\xff"):
            codes = _jpeg(content)
        else:
            flags = cv2.IMREAD_UNCHANGED
            decoded = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
            if decoded is None:
                raise error(f"{source}: a picture cut short or damaged; copy it again")
            codes = np.asarray(decoded)
            if codes.ndim == 3:
                codes = codes[..., [2, 1, 0, *range(3, codes.shape[2])]]
        if codes.ndim == 3 and codes.shape[2] in (2, 4):
            white = 2 ** (8 * codes.dtype.itemsize) - 1 if codes.dtype.kind == "u" else 1
            codes, opaque = without_alpha(codes, white)
    except error:
        raise
    except (cv2.error, *FAULTS) as fault:
        raise error(f"{source}: cannot be decoded ({one_line(fault)})") from fault
    return np.ascontiguousarray(upright(codes, header.orientation)), opaque


def _jpeg(content: bytes) -> NDArray:
    """Decode by Pillow, which refuses a file cut short; OpenCV fills what is missing with grey."""
    from PIL import Image

    with Image.open(io.BytesIO(content), formats=["JPEG"]) as picture:
        return np.asarray(picture if picture.mode in ("L", "RGB") else picture.convert("RGB"))


def _png_header(content: bytes, source: str, error: type[Exception]) -> _Header:
    """Raise `error` unless header, checksums and length are right."""
    damaged = error(f"{source}: a PNG picture cut short or damaged; copy it again")
    place, header, data_bytes, name = len(_PNG_START), b"", 0, b""
    orientation, pictures = 1, 1
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
        if name == b"eXIf":
            orientation = orientation_in(bytes(chunk[4:]))
        elif name == b"acTL":
            pictures = int.from_bytes(chunk[4:8], "big")
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
    return _Header(rows, columns, orientation, pictures)


def _other_header(content: bytes, source: str, error: type[Exception]) -> _Header:
    """Read the header of a picture that is no PNG, nothing else of it."""
    from PIL import Image, UnidentifiedImageError

    try:
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(io.BytesIO(content), formats=_OTHER_PICTURES) as picture,
        ):
            columns, rows = picture.size
            orientation = int(picture.getexif().get(_ORIENTATION, 1))
            # A phone's JPEG holds smaller copies, and maps of brightness, behind the picture.
            pictures = 1 if picture.format == "MPO" else getattr(picture, "n_frames", 1)
    except Image.DecompressionBombError as fault:
        raise error(f"{source}: {one_line(fault)}") from fault
    except UnidentifiedImageError as fault:
        raise error(f"{source}: {not_read(content, PICTURES)}") from fault
    except (SyntaxError, struct.error, *FAULTS) as fault:
        raise error(f"{source}: its header cannot be read ({one_line(fault)})") from fault
    return _Header(rows, columns, orientation, pictures)

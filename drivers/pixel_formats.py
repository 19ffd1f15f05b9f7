"""Pixel formats of machine-vision cameras: their codes, and unpacking to a uint16 mosaic.

Source: EMVA Pixel Format Naming Convention 2.4: a code's bits 16 to 23 are the bits that a pixel
takes up; "p" formats fill bytes from the lowest bit on, the older "Packed" ones (GigE Vision 1.2)
keep the high bits of two pixels in whole bytes, with their low bits in the byte between.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

Array = np.ndarray
Kernel = Callable[[Array, Array], None]

CFA = {"Mono": "mono", "BayerRG": "rggb", "BayerGR": "grbg", "BayerGB": "gbrg", "BayerBG": "bggr"}

DEPTHS = ("16", "12p", "12Packed", "12", "10p", "10Packed", "10", "8")
"""Depth and packing: deepest first, and the smaller of two equally deep."""
CODES = {
    "Mono": (0x01100007, 0x010C0047, 0x010C0006, 0x01100005, 0x010A0046, 0x010C0004, 0x01100003,
             0x01080001),
    "BayerGR": (0x0110002E, 0x010C0057, 0x010C002A, 0x01100010, 0x010A0056, 0x010C0026, 0x0110000C,
                0x01080008),
    "BayerRG": (0x0110002F, 0x010C0059, 0x010C002B, 0x01100011, 0x010A0058, 0x010C0027, 0x0110000D,
                0x01080009),
    "BayerGB": (0x01100030, 0x010C0055, 0x010C002C, 0x01100012, 0x010A0054, 0x010C0028, 0x0110000E,
                0x0108000A),
    "BayerBG": (0x01100031, 0x010C0053, 0x010C002D, 0x01100013, 0x010A0052, 0x010C0029, 0x0110000F,
                0x0108000B),
}  # fmt: skip
"""By colours, in the order of DEPTHS."""


@dataclass(frozen=True)
class PixelFormat:
    """How pixels are stored: `cfa` as in `RawFrame`, `bits` that carry light, and the packing."""

    name: str
    code: int
    cfa: str
    bits: int
    packing: str

    @property
    def stored_bits(self) -> int:
        """How many bits a pixel takes up."""
        return self.code >> 16 & 0xFF

    @property
    def white_dn(self) -> int:
        """Largest value that a pixel can hold."""
        return (1 << self.bits) - 1

    def row_bytes(self, width: int) -> int:
        """How many bytes `width` pixels take up."""
        return (width * self.stored_bits + 7) // 8


FORMATS = tuple(
    PixelFormat(colours + depth, codes[place], CFA[colours], int(bits), depth.removeprefix(bits))
    for place, depth in enumerate(DEPTHS)
    for bits in (depth.rstrip("Packedp"),)
    for colours, codes in CODES.items()
)
"""Every format that can be unpacked; the deepest come first."""
BY_NAME = {form.name: form for form in FORMATS}
BY_CODE = {form.code: form for form in FORMATS}


def image_bytes(form: PixelFormat, shape: tuple[int, int], padding: int = 0) -> int:
    """Return how many bytes an image of `(y, x)` pixels takes, each row padded by so many bytes.

    Without padding a row begins at the very next bit.
    """
    rows, columns = shape
    if padding:
        return rows * (form.row_bytes(columns) + padding)
    return form.row_bytes(rows * columns)


def unpack(
    data: bytes | bytearray | memoryview,
    form: PixelFormat,
    shape: tuple[int, int],
    padding: int = 0,
) -> Array:
    """Return the uint16 `(y, x)` pixels in the first bytes of `data`; see `image_bytes`.

    Raises `ValueError` where `data` is too short.
    """
    needed = image_bytes(form, shape, padding)
    if len(data) < needed:
        raise ValueError(f"{len(data)} bytes are fewer than the {needed} of the image")
    packed = np.frombuffer(data, np.uint8, needed)
    pixels = np.empty(shape, np.uint16)
    if not padding:
        _unpack_flat(packed, form, pixels.reshape(-1))
        return pixels
    row_bytes = form.row_bytes(shape[1])
    for line, row in zip(packed.reshape(shape[0], row_bytes + padding), pixels, strict=True):
        _unpack_flat(line[:row_bytes], form, row)
    return pixels


def _unpack_flat(packed: Array, form: PixelFormat, pixels: Array) -> None:
    group_bytes, group_pixels, kernel = KERNELS[form.stored_bits, form.bits, form.packing]
    groups = len(pixels) // group_pixels
    kernel(packed, pixels[: groups * group_pixels])
    rest = len(pixels) - groups * group_pixels
    if rest:
        last = np.zeros(group_bytes, np.uint8)
        tail = packed[groups * group_bytes :]
        last[: len(tail)] = tail
        group = np.empty(group_pixels, np.uint16)
        kernel(last, group)
        pixels[-rest:] = group[:rest]


def compiled(plain: Callable[..., None]) -> Kernel:
    """Return a kernel as machine code, kept on the disk where Numba has a folder to write to."""
    try:
        return njit(cache=True, nogil=True)(plain)
    except RuntimeError:  # neither this folder nor the user's home can be written to
        return njit(nogil=True)(plain)


@compiled
def widen(packed: Any, pixels: Any) -> None:
    """Set pixels from one byte each."""
    for i in range(pixels.size):
        pixels[i] = packed[i]


@compiled
def join_bytes(packed: Any, pixels: Any) -> None:
    """Set pixels from two bytes each, the low one first."""
    for i in range(pixels.size):
        pixels[i] = np.uint16(packed[2 * i]) | (np.uint16(packed[2 * i + 1]) << np.uint16(8))


def low_first(bits: int) -> Kernel:
    """Return what sets four pixels from every 5 or 6 bytes, lowest bits first."""
    mask = np.uint16((1 << bits) - 1)

    @compiled
    def unpack_p(packed: Any, pixels: Any) -> None:
        for i in range(pixels.size // 4):
            for k in range(4):
                at = i * bits // 2 + (k * bits >> 3)
                both = np.uint16(packed[at]) | (np.uint16(packed[at + 1]) << np.uint16(8))
                pixels[4 * i + k] = (both >> np.uint16(k * bits & 7)) & mask

    return unpack_p


def high_and_low(bits: int) -> Kernel:
    """Return what sets two pixels from every three bytes: high, the low bits of both, high."""
    below, mask = np.uint16(bits - 8), np.uint16((1 << (bits - 8)) - 1)

    @compiled
    def unpack_packed(packed: Any, pixels: Any) -> None:
        for i in range(pixels.size // 2):
            both = np.uint16(packed[3 * i + 1])
            pixels[2 * i] = (np.uint16(packed[3 * i]) << below) | (both & mask)
            second = np.uint16(packed[3 * i + 2]) << below
            pixels[2 * i + 1] = second | ((both >> np.uint16(4)) & mask)

    return unpack_packed


KERNELS: dict[tuple[int, int, str], tuple[int, int, Kernel]] = {
    (8, 8, ""): (1, 1, widen),
    (16, 10, ""): (2, 1, join_bytes),
    (16, 12, ""): (2, 1, join_bytes),
    (16, 16, ""): (2, 1, join_bytes),
    (12, 12, "p"): (6, 4, low_first(12)),
    (12, 12, "Packed"): (3, 2, high_and_low(12)),
    (10, 10, "p"): (5, 4, low_first(10)),
    (12, 10, "Packed"): (3, 2, high_and_low(10)),
}
"""By bits stored, bits of light and packing: bytes and pixels of a group, and its kernel."""

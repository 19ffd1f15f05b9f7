"""Pixel formats: every kernel agrees with a plain twin, on every size and packing."""

import os
import subprocess
import sys

import numpy as np
import pytest

from emmc_rig.drivers.pixel_formats import BY_CODE, BY_NAME, FORMATS, image_bytes, unpack
from emmc_rig.simulators.u3v import pack

RNG = np.random.default_rng(3)


def bits_lsb(data, bits, count):
    """Twin of the p formats: all bits in a row, lowest first, cut into pixels."""
    row = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")[: bits * count]
    return row.reshape(count, bits).astype(np.uint16) @ (1 << np.arange(bits, dtype=np.uint16))


def gige(data, low_bits, count):
    """Twin of the GigE Vision packing: the middle byte holds the low bits of both pixels."""
    whole = np.frombuffer(data.ljust(3 * ((count + 1) // 2), b"\0"), np.uint8)
    high_0, low, high_1 = whole.reshape(-1, 3).astype(np.uint16).T
    mask = (1 << low_bits) - 1
    first = high_0 << low_bits | low & mask
    second = high_1 << low_bits | low >> 4 & mask
    return np.stack([first, second], axis=1).reshape(-1)[:count]


def twin(data, form, count):
    if form.stored_bits == 8:
        return np.frombuffer(data, np.uint8, count).astype(np.uint16)
    if form.stored_bits == 16:
        return np.frombuffer(data, "<u2", count)
    if form.packing == "p":
        return bits_lsb(data, form.bits, count)
    return gige(data, form.bits - 8, count)


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.name)
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (5, 7), (6, 8), (33, 129)])
def test_every_format_unpacks_as_its_plain_twin_does(form, shape):
    data = RNG.bytes(image_bytes(form, shape))
    pixels = unpack(data, form, shape)
    assert pixels.dtype == np.uint16
    np.testing.assert_array_equal(pixels.reshape(-1), twin(data, form, shape[0] * shape[1]))


@pytest.mark.parametrize("name", ["Mono8", "BayerRG12p", "BayerGB10Packed", "BayerBG16"])
def test_padded_rows_are_unpacked_without_their_padding(name):
    form = BY_NAME[name]
    pixels = RNG.integers(0, form.white_dn, (4, 6), dtype=np.uint16, endpoint=True)
    rows = b"".join(pack(row, form) + b"\xff\xff\xff" for row in pixels)
    np.testing.assert_array_equal(unpack(rows, form, (4, 6), padding=3), pixels)


def test_known_bytes_of_both_12_bit_packings():
    # PFNC 2.4, figures of Mono12p and Mono12Packed, for the pixels 0x123 and 0xABC.
    assert unpack(bytes((0x23, 0xC1, 0xAB)), BY_NAME["Mono12p"], (1, 2)).tolist() == [
        [0x123, 0xABC]
    ]
    assert unpack(bytes((0x12, 0xC3, 0xAB)), BY_NAME["Mono12Packed"], (1, 2)).tolist() == [
        [0x123, 0xABC]
    ]


def test_a_code_states_how_many_bits_a_pixel_takes_up():
    for form in FORMATS:
        expected = {"": 8 if form.bits == 8 else 16, "p": form.bits, "Packed": 12}[form.packing]
        assert form.stored_bits == expected
        assert BY_CODE[form.code] is form
    assert len(BY_CODE) == len(FORMATS) == 40


def test_the_deepest_and_smallest_formats_come_first():
    order = [form.name for form in FORMATS if form.cfa == "rggb"]
    assert order[:4] == ["BayerRG16", "BayerRG12p", "BayerRG12Packed", "BayerRG12"]


def test_too_few_bytes_are_refused():
    with pytest.raises(ValueError, match="17 bytes are fewer than the 18"):
        unpack(bytes(17), BY_NAME["Mono12p"], (3, 4))


def test_pixels_are_unpacked_where_no_folder_takes_machine_code():
    # The home is read-only, and another user installed the package.
    program = (
        "from emmc_rig.drivers.pixel_formats import BY_NAME, unpack\n"
        "print(unpack(bytes((0x23, 0xC1, 0xAB)), BY_NAME['Mono12p'], (1, 2)).tolist())\n"
    )
    no_folder = {**os.environ, "NUMBA_CACHE_LOCATOR_CLASSES": "IPythonCacheLocator"}
    command = [sys.executable, "-c", program]
    ran = subprocess.run(command, capture_output=True, text=True, env=no_folder)
    assert (ran.stdout.strip(), ran.stderr) == (str([[0x123, 0xABC]]), "")

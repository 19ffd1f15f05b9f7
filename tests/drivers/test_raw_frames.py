"""RAW files: what the sensor read comes back exactly, and what is damaged is not believed."""

import numpy as np
import pytest

from emmc_rig.drivers.camera import RawFileCamera
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.errors import RawFrameError
from emmc_rig.drivers.raw import decode_raw

BAYER = ("rggb", "grbg", "gbrg", "bggr")
BLACK_DN = np.array([[60, 61], [62, 63]])


def noise(shape=(40, 48), white_level_dn=4095, seed=0):
    generator = np.random.default_rng(seed)
    return generator.integers(0, white_level_dn, shape, dtype=np.uint16, endpoint=True)


@pytest.mark.parametrize("cfa", [*BAYER, "mono"])
@pytest.mark.parametrize("white_level_dn", [255, 4095, 16383, 65535])
@pytest.mark.parametrize("shape", [(22, 22), (40, 48), (41, 33)])
def test_a_mosaic_comes_back_exactly(cfa, white_level_dn, shape):
    mosaic = noise(shape, white_level_dn)
    frame = decode_raw(encode_dng(mosaic, cfa, 0, white_level_dn, 0.01))
    np.testing.assert_array_equal(frame.mosaic, mosaic)
    assert frame.mosaic.dtype == np.uint16
    assert (frame.cfa, frame.white_level_dn) == (cfa, white_level_dn)


@pytest.mark.parametrize("cfa", BAYER)
def test_each_cfa_position_keeps_its_own_black_level(cfa):
    frame = decode_raw(encode_dng(noise(), cfa, BLACK_DN, 4095, 0.01))
    np.testing.assert_array_equal(frame.black_level_dn, BLACK_DN)


def test_a_monochrome_sensor_has_one_black_level_or_some_by_place():
    frame = decode_raw(encode_dng(noise(), "mono", 64, 4095, 0.01))
    np.testing.assert_array_equal(frame.black_level_dn, np.full((2, 2), 64))
    frame = decode_raw(encode_dng(noise(), "mono", BLACK_DN, 4095, 0.01))
    np.testing.assert_array_equal(frame.black_level_dn, BLACK_DN)


@pytest.mark.parametrize("tile", ["quad_bayer", "xtrans", "rgbw"])
def test_a_tile_that_is_not_bayer_keeps_its_pixels_levels_and_name(tile):
    mosaic = noise()
    frame = decode_raw(encode_dng(mosaic, tile, BLACK_DN, 4095, 0.01))
    np.testing.assert_array_equal(frame.mosaic, mosaic)
    np.testing.assert_array_equal(frame.black_level_dn, BLACK_DN)
    assert frame.cfa == tile


@pytest.mark.parametrize("exposure_s", [1 / 8000, 0.0123, 1.0, 30.0])
def test_the_exposure_is_read_back_to_the_microsecond(exposure_s):
    frame = decode_raw(encode_dng(noise(), "rggb", 64, 4095, exposure_s))
    assert frame.exposure_s == pytest.approx(exposure_s, abs=1e-6)


@pytest.mark.parametrize("cfa", ["rggb", "mono"])
@pytest.mark.parametrize("kept", [0, 3, 8, 100, 500, 0.5, 0.999])
def test_a_torn_file_is_refused_wherever_it_tore(cfa, kept):
    data = encode_dng(noise(), cfa, 64, 4095, 0.01)
    size = kept if isinstance(kept, int) else int(kept * len(data))
    assert_refused(data[:size])


def test_a_file_with_one_byte_missing_in_the_middle_is_refused():
    data = encode_dng(noise(), "rggb", 64, 4095, 0.01)
    assert_refused(data[:2000] + data[2001:])


@pytest.mark.parametrize("data", [b"GIF89a" + bytes(1000), b"II*\x00" + bytes(1000), b"hello"])
def test_bytes_that_are_no_raw_file_are_refused(data):
    assert_refused(data)


def test_a_frame_of_the_wrong_size_is_refused_with_both_sizes():
    data = encode_dng(noise((40, 48)), "rggb", 64, 4095, 0.01)
    with pytest.raises(RawFrameError, match=r"40x48 pixels .y x. instead of 48x40"):
        decode_raw(data, (48, 40))


@pytest.mark.parametrize(
    ("mosaic", "arguments", "complaint"),
    [
        (np.zeros((21, 40), np.uint16), {}, "too small for LibRaw"),
        (np.zeros((40, 40), np.float32), {}, "uint16"),
        (np.zeros((40, 40, 3), np.uint16), {}, "uint16"),
        (np.zeros((40, 40), np.uint16), {"black_level_dn": -1}, "below 0"),
        (np.zeros((40, 40), np.uint16), {"exposure_s": 0.0}, "not positive"),
        (np.zeros((40, 40), np.uint16), {"cfa": ""}, "plain text"),
    ],
)
def test_what_a_dng_cannot_hold_is_refused(mosaic, arguments, complaint):
    options = {"cfa": "rggb", "black_level_dn": 64, "white_level_dn": 4095, "exposure_s": 0.01}
    with pytest.raises(ValueError, match=complaint):
        encode_dng(mosaic, **(options | arguments))


def dng(mosaic=None, cfa="rggb", exposure_s=0.25):
    return encode_dng(noise() if mosaic is None else mosaic, cfa, 64, 4095, exposure_s)


class Files:
    """A `drivers.camera.CaptureTransport` that gives these files in turn."""

    def __init__(self, *files):
        self.files, self.asked_s = list(files), []

    def capture(self, exposure_s):
        self.asked_s.append(exposure_s)
        return self.files.pop(0)


@pytest.mark.parametrize(
    ("file", "reason"),
    [
        (dng()[:-1000], "torn"),
        (dng(noise((38, 48))), "38x48 pixels .y x. instead"),
        (dng(cfa="grbg"), "grbg instead of rggb"),
        (dng(exposure_s=0.5), r"exposed for 0\.5 s instead of 0\.25 s"),
    ],
)
def test_a_file_that_is_not_as_described_or_asked_for_is_refused_and_the_next_is_good(file, reason):
    source = Files(file, dng())
    camera = RawFileCamera(source, (40, 48), "rggb")
    camera.set_exposure_s(0.25)
    with pytest.raises(RawFrameError, match=reason):
        camera.snap()
    frame = camera.snap()
    np.testing.assert_array_equal(frame.mosaic, noise())
    assert source.asked_s == [frame.exposure_s] * 2 == [0.25] * 2


def assert_refused(data):
    with pytest.raises(RawFrameError) as caught:
        decode_raw(data)
    assert "\n" not in str(caught.value)

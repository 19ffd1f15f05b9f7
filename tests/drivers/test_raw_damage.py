"""Compressed and vendors' RAW files: whole ones decode exactly, damaged ones never pass.

Small files are made here. The stripped and damaged files of eleven makers, of which one must pass
no more than the other, are read where EMMC_PEER_FILES names the folder above `raw`.
"""

import io
import json
import shutil
import struct
import subprocess

import numpy as np
import pytest
import tifffile
from test_raw_frames import BLACK_DN, noise

from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.errors import RawFrameError
from emmc_rig.drivers.raw import decode_raw

LOSSLESS_JPEG = 7
PANASONIC_BLOCK = 0x4000


def rewritten(data, extratags):
    """The same DNG written anew, with more tags."""
    out = io.BytesIO()
    own = (270, 271, 272, 274, 305, *range(33421, 60000))
    with tifffile.TiffFile(io.BytesIO(data)) as tiff:
        page = tiff.pages.first
        tags = [
            (tag.code, tag.dtype, tag.count, tag.value, True)
            for tag in page.tags
            if tag.code in own
        ]
        with tifffile.TiffWriter(out) as writer:
            writer.write(
                page.asarray(),
                photometric=32803,
                planarconfig=1,
                metadata=None,
                software=False,
                extratags=[*tags, *extratags],
            )
    return out.getvalue()


def lossless_jpeg(mosaic):
    """ITU-T T.81, process 14: one component, predictor 1, a code of five bits for each category."""
    value = mosaic.astype(np.int64)
    predicted = np.empty_like(value)
    predicted[:, 1:] = value[:, :-1]
    predicted[1:, 0] = value[:-1, 0]
    predicted[0, 0] = 1 << 15
    bits = []
    for difference in ((value - predicted + 0x8000) % 0x10000 - 0x8000).ravel().tolist():
        category = 16 if difference == -0x8000 else abs(difference).bit_length()
        bits.append(f"{category:05b}")
        if 0 < category < 16:
            below = difference if difference > 0 else difference + (1 << category) - 1
            bits.append(f"{below:0{category}b}")
    text = "".join(bits)
    text += "1" * (-len(text) % 8)
    coded = int(text, 2).to_bytes(len(text) // 8, "big").replace(b"\xff", b"\xff\x00")
    table = b"\x00" + bytes([0, 0, 0, 0, 17] + 11 * [0]) + bytes(range(17))
    frame = struct.pack(">BHHB", 16, *mosaic.shape, 1) + b"\x01\x11\x00"
    parts = ((0xC4, table), (0xC3, frame), (0xDA, b"\x01\x01\x00\x01\x00\x00"))
    header = b"".join(
        bytes([0xFF, mark]) + struct.pack(">H", len(body) + 2) + body for mark, body in parts
    )
    return b"\xff\xd8" + header + coded + b"\xff\xd9"


def compressed_dng(mosaic, coded):
    """A DNG whose one strip holds `coded`; its table of contents is right whatever that is."""
    stream = io.BytesIO(encode_dng(mosaic, "rggb", 64, 4095, 0.01))
    end = stream.seek(0, io.SEEK_END)
    stream.write(coded)
    stream.seek(0)
    with tifffile.TiffFile(stream, mode="r+") as tiff:
        tags = tiff.pages.first.tags
        tags[259].overwrite(LOSSLESS_JPEG)
        tags[273].overwrite(end)
        tags[279].overwrite(len(coded))
    return stream.getvalue()


def test_a_lossless_jpeg_dng_decodes_exactly():
    mosaic = noise((60, 80))
    frame = decode_raw(compressed_dng(mosaic, lossless_jpeg(mosaic)))
    np.testing.assert_array_equal(frame.mosaic, mosaic)


@pytest.mark.parametrize("kept", [22, 500, 0.3, 0.9, -40])
def test_a_compressed_picture_cut_short_never_passes(kept):
    mosaic = noise((60, 80))
    coded = lossless_jpeg(mosaic)
    size = round(kept * len(coded)) if isinstance(kept, float) else kept
    with pytest.raises(RawFrameError):
        decode_raw(compressed_dng(mosaic, coded[:size]))


def test_bytes_that_cannot_hold_a_compressed_picture_are_refused_as_such():
    mosaic = noise((600, 800))
    with pytest.raises(RawFrameError, match="at least 59978 bytes of pixels are missing"):
        decode_raw(compressed_dng(mosaic, lossless_jpeg(mosaic)[:22]))


def panasonic(width, height, payload):
    """An RW2 of raw format 4, laid out as TIFF under another magic; offsets as cameras write."""
    texts = {0x10F: b"Panasonic\0", 0x110: b"DMC-LX3\0"}
    version = int.from_bytes(b"0300", "little")
    numbers = {1: version, 2: width, 3: height, 4: 0, 5: 0, 6: height, 7: width, 8: 1, 9: 1}
    numbers |= {0xA: 12, 0xB: 34316, 0x2D: 4, 0x111: 0xFFFFFFFF, 0x117: len(payload), 0x118: -1}
    directory, extra = b"", 24 + 2 + 12 * (len(texts) + len(numbers)) + 4
    start = extra + sum(len(text) for text in texts.values())
    blob = b""
    for code in sorted(texts | numbers):
        if code in texts:
            kind, count, value = 2, len(texts[code]), extra + len(blob)
            blob += texts[code]
        else:
            kind, count = (7, 4) if code == 1 else (4 if code > 0x100 else 3, 1)
            value = start if numbers[code] < 0 else numbers[code]
        directory += struct.pack("<HHII", code, kind, count, value)
    count = struct.pack("<H", len(texts) + len(numbers))
    header = b"IIU\0" + struct.pack("<I", 24) + bytes(16)
    return header + count + directory + bytes(4) + blob + payload


def test_a_panasonic_passes_whole_and_never_torn():
    width, height = 280, 200
    needed = width * height // 14 * 16
    whole = panasonic(width, height, bytes(-(-needed // PANASONIC_BLOCK) * PANASONIC_BLOCK))
    frame = decode_raw(whole)
    assert frame.mosaic.shape == (height, width)
    assert frame.metadata["model"] == "DMC-LX3"
    torn = panasonic(width, height, bytes(needed - 16))
    with pytest.raises(RawFrameError, match="at least 16 bytes of pixels are missing"):
        decode_raw(torn)
    for size in (100, len(whole) // 2):
        with pytest.raises(RawFrameError):
            decode_raw(whole[:size])


@pytest.mark.parametrize("magic", [b"IIRO", b"IIRS"])
def test_the_contents_of_an_olympus_are_checked_as_those_of_a_tiff(magic):
    data = encode_dng(noise(), "rggb", 64, 4095, 0.01)
    with pytest.raises(RawFrameError, match="bytes of pixels are missing"):
        decode_raw(magic + data[4:-100])


def test_no_stripped_or_damaged_file_of_any_maker_passes(peer_files):
    passed, refusals = [], {}
    for path in sorted((peer_files / "raw").iterdir()):
        if path.suffix == ".md":
            continue
        try:
            decode_raw(path.read_bytes())
            passed.append(path.name)
        except RawFrameError as refusal:
            refusals[path.name] = str(refusal)
    assert passed == []
    assert len(refusals) >= 13
    assert not any("\n" in text for text in refusals.values())


@pytest.mark.peers
@pytest.mark.skipif(shutil.which("exiftool") is None, reason="needs libimage-exiftool-perl")
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("area", [None, (2, 4, 38, 46)])
def test_exiftool_reads_the_same_levels_area_and_orientation(tmp_path, orientation, area):
    tags = [] if area is None else [(50829, 4, 4, area, True)]
    data = rewritten(encode_dng(noise(), "grbg", BLACK_DN, 4095, 0.0125), extratags=tags)
    stream = io.BytesIO(data)
    with tifffile.TiffFile(stream, mode="r+") as tiff:
        tiff.pages.first.tags[274].overwrite(orientation)
    path = tmp_path / "frame.dng"
    path.write_bytes(stream.getvalue())
    answer = subprocess.run(
        ["exiftool", "-n", "-j", str(path)], capture_output=True, text=True, check=True
    )
    (reported,) = json.loads(answer.stdout)
    frame = decode_raw(path.read_bytes())
    assert reported["Orientation"] == orientation  # pixels stay as the sensor has them
    top, left, bottom, right = area or (0, 0, 40, 48)
    if area is not None:
        assert reported["ActiveArea"].split() == [str(n) for n in area]
    np.testing.assert_array_equal(frame.mosaic, noise()[top:bottom, left:right])
    assert [
        float(n) for n in reported["BlackLevel"].split()
    ] == frame.black_level_dn.ravel().tolist()
    assert reported["WhiteLevel"] == frame.white_level_dn
    assert reported["ExposureTime"] == pytest.approx(frame.exposure_s, abs=1e-6)

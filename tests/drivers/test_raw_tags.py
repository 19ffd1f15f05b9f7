"""What a RAW file's tags say: black levels by place, exposure, time; odd values state nothing."""

import io
from datetime import datetime, timedelta, timezone
from fractions import Fraction

import numpy as np
import pytest
import tifffile

from emmc_rig.drivers.camera import CameraIdentity
from emmc_rig.drivers.dng import Facts, encode_dng
from emmc_rig.drivers.folder import FolderCamera
from emmc_rig.drivers.raw import captured_at, decode_raw
from emmc_rig.session.brightness import figures
from emmc_rig.session.frame_file import decode_frame, dng_of, frame_entry, frame_file
from emmc_rig.session.journal import Figures
from emmc_rig.simulators.clock import ManualClock

ROWS, COLUMNS = 64, 96
LIGHT = np.random.default_rng(0).integers(1000, 3000, (ROWS, COLUMNS)).astype(np.uint16)
SHORT, LONG, RATIONAL, SRATIONAL, FLOAT, DOUBLE = 3, 4, 5, 10, 11, 12


def dng(*tags, mosaic=LIGHT, mono=False):
    """Return a DNG that another writer made: tags as tifffile takes them, without `once`."""
    more = [(50706, 1, 4, bytes([1, 4, 0, 0])), (50708, 2, 0, "Test"), (50717, SHORT, 1, 4095)]
    if not mono:
        more += [
            (33421, SHORT, 2, (2, 2)),
            (33422, 1, 4, bytes([0, 1, 1, 2])),
            (50721, SRATIONAL, 9, [1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1]),
            (50728, RATIONAL, 3, [1] * 6),
            (50778, SHORT, 1, 21),
        ]
    file = io.BytesIO()
    extra = [(*tag, True) for tag in (*more, *tags)]
    tifffile.imwrite(
        file, mosaic, photometric=1 if mono else 32803, extratags=extra, metadata=None,
        software=False,
    )  # fmt: skip
    if mono:
        file.seek(0)
        with tifffile.TiffFile(file) as tiff:
            tiff.pages.first.tags[262].overwrite(34892)
    return file.getvalue()


def rationals(values):
    return [n for value in values for n in Fraction(value).as_integer_ratio()]


def tile(rows, columns, values):
    return (50713, SHORT, 2, (rows, columns)), (50714, SHORT, rows * columns, values)


def by_place(shape, level):
    """Return the levels that a function of row and column gives."""
    return np.array([[level(y, x) for x in range(shape[1])] for y in range(shape[0])], float)


BY_ROW = (50716, SRATIONAL, ROWS, rationals(40 * (y % 2) for y in range(ROWS)))
BY_COLUMN = (50715, SRATIONAL, COLUMNS, rationals(-40 * (x % 2) for x in range(COLUMNS)))
SLOPING = (50716, SRATIONAL, ROWS, rationals(Fraction(y, 2) for y in range(ROWS)))
WAVY = (50715, SRATIONAL, COLUMNS, rationals(x * x % 97 for x in range(COLUMNS)))
LEVELS = {
    "one": (tile(1, 1, 64), lambda y, x: 64),
    "fraction": (((50714, RATIONAL, 1, (641, 10)),), lambda y, x: 64.1),
    "2x2": (tile(2, 2, (60, 61, 62, 63)), lambda y, x: 60 + 2 * (y % 2) + x % 2),
    "4x4": (tile(4, 4, tuple(range(60, 76))), lambda y, x: 60 + 4 * (y % 4) + x % 4),
    "3x5": (tile(3, 5, tuple(range(60, 75))), lambda y, x: 60 + 5 * (y % 3) + x % 5),
    "rows": ((*tile(1, 1, 64), BY_ROW), lambda y, x: 64 + 40 * (y % 2)),
    "columns": ((*tile(1, 1, 64), BY_COLUMN), lambda y, x: 64 - 40 * (x % 2)),
    "rows alone": ((BY_ROW,), lambda y, x: 40 * (y % 2)),
    "all": (
        (*tile(2, 2, (60, 61, 62, 63)), SLOPING, WAVY),
        lambda y, x: 60 + 2 * (y % 2) + x % 2 + y / 2 + x * x % 97,
    ),
}


@pytest.mark.parametrize("mono", [False, True])
@pytest.mark.parametrize("name", LEVELS)
def test_black_levels_are_those_of_each_place(name, mono):
    tags, level = LEVELS[name]
    frame = decode_raw(dng(*tags, mono=mono))
    np.testing.assert_allclose(frame.black_by_place(), by_place((ROWS, COLUMNS), level), atol=1e-9)
    assert frame.black_level_dn.size <= 16 or name in ("3x5", "all")


def test_the_tile_of_levels_begins_at_the_active_area():
    area = (50829, SHORT, 4, (3, 5, 63, 95))
    frame = decode_raw(dng(*tile(4, 4, tuple(range(60, 76))), area))
    # LibRaw begins at an even place: one row and one column into the active area.
    np.testing.assert_array_equal(frame.mosaic, LIGHT[4:63, 6:95])
    expected = by_place(frame.mosaic.shape, lambda y, x: 60 + 4 * ((y + 1) % 4) + (x + 1) % 4)
    np.testing.assert_array_equal(frame.black_by_place(), expected)


@pytest.mark.parametrize(
    "tags",
    [
        ((50714, RATIONAL, 1, (64, 0)),),
        (*tile(1, 1, 64), (50716, SRATIONAL, 3, rationals([1, 2, 3]))),
        (*tile(1, 1, 64), (50713, SHORT, 2, (4, 4))),
    ],
)
def test_levels_that_contradict_themselves_leave_the_frame_good(tags):
    assert decode_raw(dng(*tags)).mosaic.shape == (ROWS, COLUMNS)


@pytest.mark.parametrize("name", LEVELS)
def test_levels_by_place_are_kept_in_a_session_and_in_its_dngs(name):
    frame = decode_raw(dng(*LEVELS[name][0]))
    file = frame_file(frame)
    entry = frame_entry(frame, 0.02, 1.0, figures=Figures(0, 0, 0))
    entry = entry.model_copy(update={"file": f"frame{file.suffix}"})
    back = decode_frame(file.data, type(entry).model_validate_json(entry.model_dump_json()))
    np.testing.assert_array_equal(back.black_level_dn, frame.black_level_dn)
    assert entry.black_dn == pytest.approx(frame.black_by_place().mean(), rel=3e-3)
    again = decode_raw(dng_of(frame, CameraIdentity("", "Test")))
    np.testing.assert_allclose(again.black_by_place(), frame.black_by_place(), atol=1e-4)


def test_a_dng_refuses_levels_that_no_tag_can_say():
    levels = np.random.default_rng(0).integers(0, 99, (70, 80))
    with pytest.raises(ValueError, match="neither a small tile nor by row and column"):
        encode_dng(np.zeros((70, 80), np.uint16), "mono", levels, 4095, 0.01)


@pytest.mark.parametrize("name", ["rows", "columns", "4x4", "all"])
def test_figures_do_not_see_stripes_of_the_black_level(name):
    tags, level = LEVELS[name]
    black = by_place((ROWS, COLUMNS), level)
    flat = decode_raw(dng(*tags, mosaic=np.rint(black + 500).astype(np.uint16)))
    found = figures(flat)
    assert found.mean_dn == pytest.approx(500, abs=1)
    assert found.bright_dn == pytest.approx(500, abs=1.5)
    assert found.saturated == 0
    white = figures(decode_raw(dng(*tags, mosaic=np.full((ROWS, COLUMNS), 4095, np.uint16))))
    assert white.saturated == 1


EXPOSURES = {
    "0/0": ((33434, RATIONAL, 1, (0, 0)), None),
    "0/1": ((33434, RATIONAL, 1, (0, 1)), None),
    "1/0": ((33434, RATIONAL, 1, (1, 0)), None),
    "float": ((33434, FLOAT, 1, 0.02), 0.02),
    "double": ((33434, DOUBLE, 1, 0.02), 0.02),
    "not a number": ((33434, FLOAT, 1, float("nan")), None),
    "infinite": ((33434, DOUBLE, 1, float("inf")), None),
    "negative": ((33434, SRATIONAL, 1, (-1, 50)), None),
    "negative float": ((33434, FLOAT, 1, -0.02), None),
    "text": ((33434, 2, 0, "soon"), None),
    "several": ((33434, RATIONAL, 2, (1, 50, 1, 25)), None),
    "1/50": ((33434, RATIONAL, 1, (1, 50)), 0.02),
}


@pytest.mark.parametrize("name", EXPOSURES)
def test_an_odd_exposure_is_not_stated_and_the_frame_is_good(name, tmp_path):
    tag, exposure_s = EXPOSURES[name]
    frame = decode_raw(dng(tag))
    np.testing.assert_array_equal(frame.mosaic, LIGHT)
    assert frame.exposure_s == (exposure_s and pytest.approx(exposure_s, rel=1e-6))
    (tmp_path / "frame.dng").write_bytes(dng(tag))
    camera = FolderCamera(tmp_path, ManualClock())
    camera.set_exposure_s(0.02)
    np.testing.assert_array_equal(camera.snap().mosaic, LIGHT)


def test_other_odd_tags_state_nothing():
    odd = [
        (34855, SHORT, 1, 0),
        (33437, RATIONAL, 1, (0, 0)),
        (306, 2, 0, "0000:00:00 00:00:00"),
        (271, SHORT, 1, 7),
    ]
    assert decode_raw(dng(*odd)).metadata == {}
    frame = decode_raw(dng((34855, SHORT, 1, 200), (33437, RATIONAL, 1, (28, 10))))
    assert frame.metadata == {"iso": "200", "aperture": "2.8"}


def test_the_time_of_capture_has_its_fraction_and_zone():
    zone = timezone(timedelta(hours=-3, minutes=-30))
    at = datetime(2026, 10, 25, 2, 59, 58, 250_000, zone)
    data = encode_dng(LIGHT, "rggb", 64, 4095, 0.01, facts=Facts(captured=at))
    assert captured_at(decode_raw(data).metadata) == at
    local = decode_raw(dng((306, 2, 0, "2026:10:25 02:59:58"))).metadata
    assert captured_at(local) == datetime(2026, 10, 25, 2, 59, 58)
    assert captured_at({}) is None


def test_the_facts_of_a_frame_are_in_its_file_and_unknown_ones_are_not():
    def written(exposure_s, identity, facts):
        data = encode_dng(LIGHT, "rggb", 64, 4095, exposure_s, identity, facts=facts)
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            tags = tiff.pages.first.tags
            found = {code: tags.valueof(code) for code in (269, 305, 50735) if code in tags}
            return found, tags.valueof(34665)

    facts = Facts(70_000, document="frame.dng", unique_id="ab" * 16, software="emmc-rig")
    found, exif = written(0.01, CameraIdentity("", "Test", "S7"), facts)
    assert found == {269: "frame.dng", 305: "emmc-rig", 50735: "S7"}
    assert (exif["ISOSpeedRatings"], exif["ExposureTime"]) == (65_535, (1, 100))
    assert (exif["ImageUniqueID"], exif["BodySerialNumber"]) == ("ab" * 16, "S7")
    found, exif = written(None, CameraIdentity("", "Test"), Facts())
    assert (found, list(exif)) == ({}, ["ExifVersion"])


def test_a_folder_gives_its_files_in_the_order_that_it_lists_them(tmp_path, caplog):
    names = ("IMG_9998.dng", "IMG_9999.dng", "IMG_0001.dng", "IMG_0002.dng")
    for second, name in enumerate(names):
        (tmp_path / name).write_bytes(dng((306, 2, 0, f"2026:11:27 10:00:{second:02}")))
    camera = FolderCamera(tmp_path, ManualClock())
    assert [file.name for file in camera.files()] == list(names)
    assert [camera.snap().metadata["name"] for _ in names] == list(names)
    assert "ordered by time, not by name" in caplog.text

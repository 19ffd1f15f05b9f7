"""Frames that leave a session as DNG files: exiftool reads the facts, LibRaw the mosaic."""

import io
import json
import shutil
import subprocess
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
import tifffile
from capture_rigs import begun, still_rig

from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.errors import AppError
from emmc_rig.model.files import SYSTEM_DISK
from emmc_rig.session.export import export_dng
from emmc_rig.session.frame_file import decode_frame, frame_file
from emmc_rig.session.session import Session

needs_exiftool = pytest.mark.skipif(shutil.which("exiftool") is None, reason="no exiftool")


def told(path):
    """Return what exiftool says of a file, by group and tag."""
    done = subprocess.run(
        ["exiftool", "-j", "-n", "-G1", path], capture_output=True, check=True, text=True
    )
    return json.loads(done.stdout)[0]


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    rig = still_rig()
    session, plan = begun(tmp_path_factory.mktemp("dng"), SYSTEM_DISK, rig)
    clock = (f"2026-11-25T23:59:{n // 10:02d}.{n % 10}07+01:00" for n in range(10_000))
    Sequencer(session, plan, rig, wall=lambda: next(clock)).run()
    return Session(session.folder)


def exported(session, folder):
    """Return by frame the DNG files of a session, written into a folder."""
    export_dng(session, folder)
    return {item.id: folder / session.stored[item.id].file for item in session.needed}


def test_every_frame_is_a_dng_of_the_same_mosaic_and_levels(session, tmp_path):
    files = exported(session, tmp_path / "out")
    assert len(list((tmp_path / "out").glob("*.dng"))) == len(session.stored)
    for name, path in files.items():
        entry = session.stored[name]
        frame, kept = decode_raw(path.read_bytes()), decode_frame(session.read(name), entry)
        np.testing.assert_array_equal(frame.mosaic, kept.mosaic)
        assert frame.white_level_dn == entry.white_level_dn
        np.testing.assert_array_equal(frame.black_level_dn, entry.black_level_dn)
        assert frame.exposure_s == pytest.approx(entry.exposure_s, rel=1e-5)
        assert frame.metadata["serial"] == "7"


@needs_exiftool
def test_exiftool_reads_exposure_time_serial_and_session(session, tmp_path):
    files = exported(session, tmp_path / "out")
    ids = set()
    for name, path in files.items():
        entry, facts = session.stored[name], told(path)
        assert facts["ExifIFD:ExposureTime"] == pytest.approx(entry.exposure_s, rel=1e-5)
        assert "ExifIFD:ISO" not in facts  # the camera states a gain, but no ISO
        at = datetime.fromisoformat(entry.wall)
        assert facts["ExifIFD:DateTimeOriginal"] == at.strftime("%Y:%m:%d %H:%M:%S")
        assert int(facts["ExifIFD:SubSecTimeOriginal"]) == at.microsecond // 1000
        assert facts["ExifIFD:OffsetTimeOriginal"] == "+01:00"
        assert str(facts["ExifIFD:SerialNumber"]) == str(facts["IFD0:CameraSerialNumber"]) == "7"
        assert facts["ExifIFD:ImageUniqueID"].startswith(session.id)
        assert facts["IFD0:DocumentName"] == f"session {session.id}, frame {name}"
        assert facts["IFD0:Software"].startswith("emmc-rig ")
        ids.add(facts["ExifIFD:ImageUniqueID"])
    assert len(ids) == len(files)


@needs_exiftool
def test_exiftool_finds_nothing_wrong_with_the_file(session, tmp_path):
    path = next(iter(exported(session, tmp_path / "out").values()))
    done = subprocess.run(
        ["exiftool", "-validate", "-warning", "-error", "-a", path],
        capture_output=True, check=True, text=True,
    )  # fmt: skip
    serious = [
        line
        for line in done.stdout.splitlines()
        if "Error" in line or ("Warning" in line and "minor" not in line.lower())
    ]
    assert not serious


def test_a_dng_in_a_session_states_time_serial_and_iso():
    mosaic = np.full((32, 40), 500, np.uint16)
    metadata = {"maker": "EMMC", "model": "plug-in", "iso": "400"}
    of_plugin = replace(
        decode_raw(encode_dng(mosaic, "rggb", 64, 1023, 0.01)),
        original=b"a plug-in's bytes",
        metadata=metadata,
    )
    data = frame_file(of_plugin, "2026-11-25T23:59:01.207+01:00", "S7").data
    with tifffile.TiffFile(io.BytesIO(data)) as tiff:
        tags = tiff.pages.first.tags
        exif = tags.valueof(34665)
        assert tags.valueof(306) == exif["DateTimeOriginal"] == "2026:11:25 23:59:01"
        assert tags.valueof(50735) == exif["BodySerialNumber"] == "S7"
    assert exif["SubsecTime"] == exif["SubsecTimeOriginal"] == "207"
    assert exif["OffsetTime"] == exif["OffsetTimeOriginal"] == "+01:00"
    assert (exif["ISOSpeedRatings"], exif["ExposureTime"]) == (400, (1, 100))
    unknown = replace(of_plugin, metadata={})
    with tifffile.TiffFile(io.BytesIO(frame_file(unknown).data)) as tiff:
        assert set(tiff.pages.first.tags.valueof(34665)) == {"ExifVersion", "ExposureTime"}


def test_frames_are_not_written_where_something_else_lies(session, tmp_path):
    (tmp_path / "note.txt").write_text("mine")
    with pytest.raises(AppError, match="holds something other"):
        export_dng(session, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["note.txt"]
    with pytest.raises(AppError, match="session"):
        export_dng(session, session.folder / "dng")

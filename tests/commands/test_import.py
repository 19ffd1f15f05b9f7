"""Files of another program become a session equal to the sequencer's."""

import csv
import hashlib
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
import yaml
from programs import done, one_line, program, refused

from emmc_rig.captures.import_session import _Import as importing
from emmc_rig.drivers.dng import Facts, encode_dng
from emmc_rig.formats.cameras import shipped_camera_files
from emmc_rig.process.reconstructing import open_frames
from emmc_rig.session.board_sets import decoded
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import ImportedEntry, of_kind
from emmc_rig.session.session import Session
from emmc_rig.session.verify import verify

RIG = ("--rig", "simulated", "--scene", "near-planar", "--size", "24x32")
PLAN = {
    "camera": "rgbw-bayer-2shots",
    "shots": [{"exposure_s": [0.02, 0.08]}, {"exposure_s": 0.03, "repeats": 2}],
    "whiteboards": {
        "repeats": 1,
        "references": 2,
        "views": [[2, 2], [0, 0], [4, 4], [0, 4], [4, 0]],
        "lamp_checks": 2,
        "turned": 2,
        "open": [{"validation": True}, {"mask_um": [0, 0]}, {"mask_um": [24, 0]}],
    },
    "darks": {"repeats": 2, "of_shots": 2},
}
LIT = np.random.default_rng(3).integers(300, 40_000, (4, 24, 32), np.uint16)
DARK = np.random.default_rng(4).integers(250, 262, (2, 24, 32), np.uint16)
COLOURS, GREY = np.moveaxis(LIT[:3], 0, -1), np.repeat(LIT[1][..., None], 3, -1)
CAMERA = "rgbw-bayer-2shots"


def exported(session, folder, write):
    """Write a session's frames as files of another program, with the table that names them."""
    folder.mkdir()
    frames = [f for f in session.frames if f.kind != "metering" and f.id in session.stored]
    rows = []
    for frame, raw in zip(frames, decoded(session, frames), strict=True):
        bench, um = frame.bench, frame.bench.offsets_um
        kind, turned = frame.kind, {}
        if kind == "turned":
            kind = "open" if bench.masks_in else "reference"
            turned = {"turn_deg": bench.board_turn_deg}
        elif kind == "check" and not bench.masks_in:
            kind = "reference-check"
        row = {"file": write(folder / frame.id, raw.mosaic), "kind": kind, **turned}
        row |= {"exposure_s": repr(raw.exposure_s), "lamp": bench.lamp}
        if frame.kind != "dark" or frame.is_dark_of_shots:
            row["shot"] = bench.shot
        for axis in ("mask_x", "mask_y") if bench.masks_in else ():
            row[f"{axis}_um"] = um.get(axis, "")
        for axis in ("aperture_x", "aperture_y") if frame.view else ():
            row[f"{axis}_um"] = um[axis]
        row["time"] = session.stored[frame.id].host_time_s
        rows.append(row)
    return table_of(folder, rows)


def table_of(folder, rows):
    path = folder / "table.csv"
    with path.open("w", newline="") as file:
        names = list(dict.fromkeys(name for row in rows for name in row))
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    return path


def npy(path, mosaic):
    np.save(path.with_suffix(".npy"), mosaic)
    return f"{path.name}.npy"


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """A session that the sequencer captured, and the same frames imported."""
    folder = tmp_path_factory.mktemp("captured")
    (folder / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    done(program("capture", folder / "plan.yaml", *RIG, "--out", folder / "session"))
    table = exported(Session(folder / "session"), folder / "files", npy)
    done(program("import", table, "--camera", CAMERA, "--out", folder / "imported"))
    return folder


def test_an_imported_session_is_complete_and_says_that_it_was_imported(tmp_path, run):
    table = table_of(tmp_path, world(tmp_path))
    session, _ = imported(run, tmp_path, table, "--camera", CAMERA)
    assert session.is_complete
    assert verify(session).is_complete
    (entry,) = of_kind(session.journal.entries, ImportedEntry)
    assert len(entry.files) == len(session.stored) == 4
    first = session.frames[0].id
    frame = decode_frame(session.read(first), session.stored[first])
    file = tmp_path / "d0.npy"
    assert session.stored[first].metadata["imported"] == str(file)
    assert frame.original == file.read_bytes()
    assert entry.files[str(file)] == hashlib.sha256(file.read_bytes()).hexdigest()


@pytest.mark.slow
def test_calibration_and_readings_are_those_of_the_captured_session_bit_for_bit(captured):
    (psi, frames), (own_psi, own_frames) = (
        open_frames(captured / name) for name in ("session", "imported")
    )
    assert np.array_equal(psi.weights, own_psi.weights)
    assert np.array_equal(frames.readings, own_frames.readings)
    assert np.array_equal(frames.deviation, own_frames.deviation)
    assert np.array_equal(frames.usable, own_frames.usable)


@pytest.fixture(scope="module")
def shots_only(tmp_path_factory):
    """A session without whiteboards, and its camera with the brightness of white in its file."""
    folder = tmp_path_factory.mktemp("shots")
    camera = yaml.safe_load(shipped_camera_files()[CAMERA].read_text())
    camera.setdefault("sensor", {})["noise"] = {"electrons_per_s": 310_000.0}
    (folder / "mine.yaml").write_text(yaml.safe_dump(camera))
    plan = {**PLAN, "camera": "mine.yaml", "whiteboards": None}
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    done(program("capture", folder / "plan.yaml", *RIG, "--out", folder / "session"))
    return folder


FORMATS = {
    "npy": npy,
    "tif": lambda path, mosaic: tifffile.imwrite(f"{path}.tif", mosaic) or f"{path.name}.tif",
    "png": lambda path, mosaic: cv2.imwrite(f"{path}.png", mosaic) and f"{path.name}.png",
    "dng": lambda path, mosaic: (
        Path(f"{path}.dng").write_bytes(encode_dng(mosaic, "rggb", 256, 65_535, None))
        and f"{path.name}.dng"
    ),
    "mat": lambda path, mosaic: (
        scipy.io.savemat(f"{path}.mat", {"other": [[1.0]], "meas": mosaic.astype(float)})
        or f"{path.name}.mat"
    ),
    "npz": lambda path, mosaic: (
        np.savez(f"{path}.npz", meas=mosaic, psi=mosaic) or f"{path.name}.npz@meas"
    ),
    "h5": lambda path, mosaic: hdf5(path, mosaic),
}


def hdf5(path, mosaic):
    with h5py.File(f"{path}.h5", "w") as file:
        file["entry/data"] = mosaic.astype(np.float32)
    return f"{path.name}.h5"


@pytest.mark.parametrize(
    "form", [pytest.param(form, marks=[] if form == "npy" else pytest.mark.slow)
             for form in FORMATS]
)  # fmt: skip
def test_shots_of_every_format_read_as_those_of_the_captured_session(shots_only, tmp_path, form):
    table = exported(Session(shots_only / "session"), tmp_path / "files", FORMATS[form])
    out = tmp_path / "imported"
    done(program("import", table, "--camera", shots_only / "mine.yaml", "--out", out))
    (psi, frames), (own_psi, own_frames) = map(open_frames, (shots_only / "session", out))
    assert np.array_equal(psi.weights, own_psi.weights)
    assert np.array_equal(frames.readings, own_frames.readings)
    assert np.array_equal(frames.deviation, own_frames.deviation)


NAMES = ("s0.npy", "s1.npy", "d0.npy", "d1.npy")
KINDS = ("shot", "shot", "dark", "dark")


def good_rows():
    rows: list[dict[str, Any]] = [
        {"file": name, "kind": kind} for name, kind in zip(NAMES, KINDS, strict=True)
    ]
    for shot, row in enumerate(rows[:2]):
        row |= {"shot": shot, "exposure_s": 0.02}
    for row in rows[2:]:
        row["exposure_s"] = 0.02
    return rows


def world(folder):
    """Write two shots and two darks, and return the rows that name them."""
    for name, mosaic in zip(NAMES, (*LIT[:2], *DARK), strict=True):
        np.save(folder / name, mosaic)
    return good_rows()


def changed(row, **cells):
    """Return what changes cells of a row."""
    return lambda folder, rows: rows[row].update(cells)


def written(row, array):
    """Return what writes another array into a row's file."""
    return lambda folder, rows: np.save(folder / rows[row]["file"], array)


def renamed(name, **rows_too):
    """Return what calls a column otherwise in the row of shot 0."""
    return lambda folder, rows: rows[0].update({name: 1.0}, **rows_too)


def nan_pixel(folder, rows):
    for row in rows:
        array = np.load(folder / row["file"]).astype(np.float32)
        np.save(folder / row["file"], array)
    array[3, 4] = np.nan
    np.save(folder / rows[-1]["file"], array)


def file_written(row, name, content):
    """Return what writes a file of any bytes and names it in a row."""

    def change(folder, rows):
        (folder / name).write_bytes(content)
        rows[row]["file"] = name

    return change


def picture(shape, dtype: type = np.uint16, name="c.png"):
    """Return what names a picture of noise in the row of shot 1."""

    def change(folder, rows):
        top = min(np.iinfo(dtype).max, 40_000)
        codes = np.random.default_rng(8).integers(0, top, shape).astype(dtype)
        assert cv2.imwrite(str(folder / name), codes)
        rows[1]["file"] = name

    return change


def raw_file(row, cfa="rggb", exposure_s=0.02, size=(24, 32), white=65_535):
    def change(folder, rows):
        mosaic = np.resize(LIT[3], size)
        (folder / "raw.dng").write_bytes(encode_dng(mosaic, cfa, 256, white, exposure_s))
        rows[row]["file"] = "raw.dng"

    return change


def ome(folder, rows):
    metadata = {"axes": "YX", "Plane": {"ExposureTime": [20.0], "ExposureTimeUnit": ["ms"]}}
    tifffile.imwrite(folder / "s.ome.tif", LIT[3], metadata=metadata)
    rows[0] |= {"file": "s.ome.tif", "exposure_s": 20}


def all_rows(**cells):
    return lambda folder, rows: [row.update(cells) for row in rows]


LIT_BENCH = {"electrons_per_s": 5_000_000.0}
TABLE = "file,kind,shot,exposure_s\n" + "".join(
    f"{name},{kind},{shot},0.02\n" for name, kind, shot in zip(NAMES, KINDS, "01  ", strict=True)
)


def each(rows):
    return list(enumerate(rows))


def third_shot(folder, rows):
    np.save(folder / "s2.npy", LIT[2])
    rows.append({"file": "s2.npy", "kind": "shot", "shot": 2, "exposure_s": 0.02})


def described(folder, change):
    """Write the camera with changes to its description as `mine.yaml`."""
    camera = yaml.safe_load(shipped_camera_files()[CAMERA].read_text())
    change(camera)
    (folder / "mine.yaml").write_text(yaml.safe_dump(camera))


def camera_of(also=lambda folder, rows: None, **noise):
    """Return what describes the camera with its noise, after another change."""

    def change(folder, rows):
        also(folder, rows)
        described(folder, lambda camera: camera.setdefault("sensor", {}).update(noise=noise))

    return change


def mask_of(cells):
    """Return what gives the camera a picture of so many cells a side; None: one that is missing."""

    def change(folder, rows):
        if cells is not None:
            codes = np.random.default_rng(0).integers(0, 2, (cells, cells)).astype(np.uint8)
            cv2.imwrite(str(folder / "m.png"), 255 * codes)
        pattern = {"kind": "picture", "path": "m.png"}
        described(folder, lambda camera: camera["masks"]["mask"].update(pattern=pattern))

    return change


def table_bytes(content):
    """Return what writes a table of its own instead of the rows."""
    return lambda folder, rows: (folder / "own.csv").write_bytes(content)


MISTAKES = {
    "a file that is missing": (changed(1, file="s9.npy"), "s9.npy: no such file"),
    "a file named twice": (changed(1, file="s0.npy"), "s0.npy is there twice, also in"),
    "a copy under another name": (written(1, LIT[0]), "the same bytes as in"),
    "a copy of a dark": (written(3, DARK[0]), "the same bytes as in"),
    "another size": (written(1, LIT[1][:, :30]), "24x30 pixels (y x), and"),
    "turned by 90 degrees": (written(1, LIT[1].T), "32x24 pixels (y x), and"),
    "another depth": (written(1, (LIT[1] >> 8).astype(np.uint8)), "8 bits a pixel"),
    "floats beside integers": (written(1, LIT[1].astype(np.float32)), "values of float32, and"),
    "whole numbers with a sign": (written(1, LIT[1].astype(np.int32)), "values of int32, and"),
    "a NaN": (nan_pixel, "pixels that are no numbers (NaN or infinite): 1; correct"),
    "below zero": (written(1, LIT[1].astype(np.int32) - 30_000), "black level still in them"),
    "above white": (written(1, LIT[1].astype(np.uint32) * 2), "above sensor.noise.white_level_dn"),
    "complex values": (written(1, LIT[1] * 1j), "not real numbers: save it as numbers"),
    "truths": (written(1, LIT[1] > 9), "not real numbers: save it as numbers"),
    "a line of values": (written(1, LIT[1].ravel()), "not frames (y, x) or (frame, y, x)"),
    "five axes": (written(1, LIT[:2, None].repeat(2, 1)[None]), "1x2x2x24x32, not frames (y, x)"),
    "nothing in it": (written(1, LIT[1][:0]), "holds an array of 0x32"),
    "a colour picture": (picture((24, 32, 3)), "red, green and blue, as three shots"),
    "a colour array": (written(1, COLOURS), "red, green and blue, as three"),
    "a grey picture in colour": (written(1, GREY), "in three equal colours"),
    "a picture of 8 bits": (picture((24, 32), np.uint8), "8 bits a pixel, which never reach"),
    "a text": (file_written(1, "t.txt", b"words"), "t.txt: "),
    "an empty file": (file_written(1, "e.npy", b""), "e.npy: empty; formats read here"),
    "a torn file": (file_written(1, "e.npy", b"\x93NUMPY\x01\x00v\x00{"), "e.npy: cannot be read"),
    "a torn picture": (file_written(1, "e.png", b"\x89PNG\r\n\x1a\n123"), "cut short or damaged"),
    "a torn DNG": (file_written(1, "e.dng", b"II*\x00123"), "e.dng: unusable RAW frame"),
    "no MAT": (file_written(1, "e.mat", b"MATLAB"), "e.mat: cannot be read"),
    "a folder": (changed(1, file="."), "without a Zarr group"),
    "wrong colours": (raw_file(1, "bggr"), "its colours are bggr, the camera's sensor.cfa is rggb"),
    "another exposure": (raw_file(1, exposure_s=0.05), "exposure_s 0.02, but its file states 0.05"),
    "ms for s of an OME-TIFF": (ome, "exposure_s 20, but its file states 0.02 s: ms for s?"),
    "ms for s of the shots": (
        lambda folder, rows: [row.update(exposure_s=20) for row in rows[:2]],
        "darks of 0.02 s and shots of 20 s: ms for s",
    ),
    "ms for s of the darks": (
        lambda folder, rows: [row.update(exposure_s=20) for row in rows[2:]],
        "darks of 20 s and shots of 0.02 s: ms for s",
    ),
    "hours for s": (changed(0, exposure_s=1e5), "exposure_s: input should be less than or equal"),
    "an exposure of nothing": (changed(0, exposure_s=0), "exposure_s: input should be greater"),
    "an exposure in words": (changed(0, exposure_s="20 ms"), "exposure_s: input should be a"),
    "an exposure that is no number": (changed(0, exposure_s="nan"), "exposure_s: input should"),
    "a decimal comma": (changed(0, exposure_s="0,02"), "exposure_s: input should be a"),
    "milliseconds by the column": (renamed("exposure_ms"), "did you mean 'exposure_s'?"),
    "millimetres by the column": (renamed("mask_x_mm"), "did you mean 'mask_x_um'?"),
    "a misspelt column": (renamed("temprature_c"), "did you mean 'temperature_c'?"),
    "a column of another program": (renamed("qwxz"), "unknown key 'qwxz'"),
    "mm for um of the mask": (changed(1, mask_x_um=0.01), "mm for um? write um"),
    "a mask place that is no number": (changed(1, mask_x_um="nan"), "mask_x_um: input should be"),
    "mm for um of the pinhole": (
        changed(2, kind="whiteboard", aperture_x_um=0.5, aperture_y_um=0.5),
        "mm for um? write um",
    ),
    "a pinhole beside the aperture": (
        changed(2, kind="whiteboard", aperture_x_um=1e6), "from the nearest of the camera's 5x5"
    ),
    "a kind that is none": (changed(0, kind="light"), "kind: input should be 'shot', 'dark'"),
    "no kind": (changed(0, kind=""), "kind: field required"),
    "no file": (changed(0, file=""), "file: field required"),
    "shots from 1": (
        lambda folder, rows: [row.update(shot=row["shot"] + 1) for row in rows[:2]],
        "shot 0 has no file, of shots 0 to 2",
    ),
    "a shot left out": (changed(1, shot=2), "shot 1 has no file, of shots 0 to 2"),
    "a negative shot": (changed(1, shot=-1), "shot: input should be greater than or equal to 0"),
    "half a shot": (changed(1, shot=0.5), "shot: input should be a whole number"),
    "shots without and with a number": (changed(1, shot=""), "kind shot without a shot number"),
    "a dark of no shot": (changed(2, shot=7), "there is no shot 7, only 0 to 1"),
    "no shots": (lambda folder, rows: rows.__delitem__(slice(0, 2)), "no file is a shot"),
    "no rows": (table_bytes(b"file,kind\n"), "no row below the names"),
    "a shot as a dark": (changed(1, kind="dark", shot=""), "a dark that is"),
    "an ISO as a gain": (changed(0, gain=800), "gain: input should be less than or equal to 100"),
    "a gain below 1": (changed(0, gain=0.5), "gain: input should be greater than or equal to 1"),
    "a gain of darks": (changed(2, gain=4), "gain 4; only shots may have another than 1"),
    "a gain that differs in a shot": (
        lambda folder, rows: rows[1].update(shot=0, gain=2), "gain differs within shot 0"
    ),
    "two places in a shot": (
        lambda folder, rows: [
            rows[0].update(mask_x_um=24), rows[1].update(shot=0, mask_x_um=48)
        ],
        "the mask's place differs within a shot",
    ),
    "a lamp of no colour": (changed(0, lamp="amber"), "lamp: input should be 'white', 'red'"),
    "a lit dark": (changed(2, lamp="white"), "kind dark with the lamp white"),
    "a shot with the lamp off": (changed(0, lamp="off"), "kind shot with the lamp off"),
    "colder than cold": (changed(0, temperature_c=-300), "temperature_c: input should be greater"),
    "a time in words": (changed(0, time="noon"), "time: input should be a"),
    "a reference of no exposure": (
        changed(2, kind="reference", exposure_s=""), "its exposure is not known"
    ),
    "an array that is not there": (changed(0, file="s0.npz@a"), "s0.npz: no such file"),
    "more shots than the camera has": (third_shot, "and the camera has 2 shots: write mask_x_um"),
    "nm for um of the mask": (changed(1, mask_x_um=24_000), "mask at 24000, 0 um: nm for um?"),
    "mm for um of a whiteboard's mask": (
        changed(2, kind="open", mask_x_um=0.024), "mm for um? write um"
    ),
    "a shot that is turned": (changed(0, turn_deg=90), "turn_deg with kind shot"),
    "a turned board without its reference": (
        changed(2, kind="open", turn_deg=90), "turned by 90 degrees has kind open alone"
    ),
    "a pinhole before a shot": (changed(0, aperture_x_um=0), "a pinhole's place with kind shot"),
    "a mask in a reference": (
        changed(2, kind="reference", mask_x_um=24), "kind reference, which is without masks"
    ),
    "ms for s": (camera_of(all_rows(exposure_s=20), **LIT_BENCH), "ms for s in exposure_s?"),
    "us for s": (all_rows(exposure_s=20_000), "less than or equal to 3600"),
    "levels swapped": (
        camera_of(black_level_dn=4095, white_level_dn=64), "must be below white_level_dn"
    ),
    "codes moved up to 16 bits": (
        camera_of(white_level_dn=4095), "above sensor.noise.white_level_dn 4095"
    ),
    "a shot all white": (written(0, np.full_like(LIT[0], 65_535)), "100% of its pixels are at"),
    "a cap on the lens": (written(0, DARK[0] + 1), "its brightest readings are 0.0% of white"),
    "frames of one row": (
        lambda folder, rows: [np.save(folder / row["file"], LIT[i, :1]) for i, row in each(rows)],
        "1x32 pixels (y x), fewer than a frame has",
    ),
    "seconds beside dates": (
        lambda folder, rows: [
            rows[0].update(time=12), rows[1].update(time="2026-11-25T14:30:00")
        ],
        "line 3: time is over a year after that of",
    ),
    "a month that is none": (changed(0, time="2026-13-25T14:30:00"), "month must be in 1..12"),
    "a time without a date": (changed(0, time="14:30:00"), "time: input should be a number"),
    "letters of another case": (changed(1, file="S1.npy"), "no such file; did you mean 's1.npy'?"),
    "a name that is nearly right": (changed(1, file="s1.tif"), "did you mean 's1.npy'?"),
    "a plural as a kind": (changed(0, kind="shots"), "kind: input should be 'shot', 'dark'"),
    "a flat": (changed(2, kind="flat"), "kind: input should be 'shot', 'dark', 'reference'"),
    "a mask of fewer cells than the beam": (
        mask_of(12), "it has 12 cells of 36 um, the beam needs 18"
    ),
    "a mask picture that is missing": (mask_of(None), "m.png: no such file"),
    "a workbook": (table_bytes(b"PK\x03\x04\x14\x00"), "save it as CSV UTF-8"),
    "UTF-16": (table_bytes(TABLE.encode("utf-16")), "not text in UTF-8 (byte 0); save it as CSV"),
    "Latin letters": (table_bytes(TABLE.replace("s0", "\xe4").encode("latin-1")), "not text in"),
    "a zero byte": (table_bytes(TABLE.replace("s0", "s\0").encode()), "it holds a zero byte"),
    "no names of columns": (
        table_bytes(TABLE.partition("\n")[2].encode()), "line 1: names no column"
    ),
    "a quote that stays open": (
        table_bytes(TABLE.replace("s1", '"s1').encode()), "not a table in CSV"
    ),
    "a cell too many": (
        table_bytes(TABLE.replace("0.02\n", "0.02,7\n").encode()), "5 cells under 4 columns"
    ),
    "a cell too few": (table_bytes(TABLE.replace(",0.02", "").encode()), "3 cells under 4 columns"),
    "capital letters": (table_bytes(TABLE.replace("exp", "Exp").encode()), "mean 'exposure_s'?"),
    "a column twice": (table_bytes(TABLE.replace("exposure_s", "file").encode()), "is there twice"),
    "an empty table": (table_bytes(b""), "empty; its first line names the columns"),
}  # fmt: skip


IN_CHILDREN = ("no MAT", "ms for s of an OME-TIFF", "a folder")
"""Mistakes in files that a process of its own reads, which takes a second to begin."""


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(mistake, marks=pytest.mark.slow if mistake in IN_CHILDREN else [])
        for mistake in MISTAKES
    ],
)
def test_a_mistake_is_named_in_one_line_and_nothing_is_written(mistake, tmp_path, run):
    change, words = MISTAKES[mistake]
    rows = world(tmp_path)
    change(tmp_path, rows)
    own, mine = tmp_path / "own.csv", tmp_path / "mine.yaml"
    table = own if own.exists() else table_of(tmp_path, rows)
    camera = mine if mine.exists() else CAMERA
    before = sorted(tmp_path.rglob("*"))
    assert words in refused(run("import", table, "--camera", camera, "--out", tmp_path / "out"))
    assert sorted(tmp_path.rglob("*")) == before


def in_a_folder(folder, rows):
    (folder / "from Köln").mkdir()
    for row in rows:
        (folder / row["file"]).rename(folder / "from Köln" / row["file"])
        row["file"] = f"from Köln\\{row['file']}"


WAYS = {
    "as it is": lambda folder, rows: None,
    "with a byte-order mark": table_bytes(TABLE.encode("utf-8-sig")),
    "with semicolons and decimal commas": table_bytes(
        TABLE.replace(",", ";").replace("0.02", "0,02").encode()
    ),
    "with tabs and lines of Windows": table_bytes(
        TABLE.replace(",", "\t").replace("\n", "\r\n").encode()
    ),
    "with backslashes, spaces and umlauts": in_a_folder,
}


@pytest.mark.parametrize("way", WAYS)
def test_the_same_table_without_a_mistake_is_imported(way, tmp_path, run):
    rows = world(tmp_path)
    WAYS[way](tmp_path, rows)
    own = tmp_path / "own.csv"
    table = own if own.exists() else table_of(tmp_path, rows)
    out = done(run("import", table, "--camera", CAMERA, "--out", tmp_path / "out"))
    assert "4 frames of 4 files imported and verified" in out


def imported(run, folder, *arguments):
    """Import into `out` of a folder; returns the session and what the program said."""
    code, _, err = run("import", *arguments, "--out", folder / "out")
    assert code == 0, err
    return Session(folder / "out"), err


def mosaics(session, kind):
    frames = [frame for frame in session.frames if frame.kind == kind]
    return np.stack([raw.mosaic for raw in decoded(session, frames)])


@pytest.mark.slow
def test_pages_of_an_ome_tiff_are_shots_with_its_exposures_and_times(tmp_path, run):
    plane = {"ExposureTime": [20.0, 40.0], "ExposureTimeUnit": ["ms"] * 2, "DeltaT": [0.5, 2.0]}
    tifffile.imwrite(tmp_path / "s.ome.tif", LIT[:2], metadata={"axes": "TYX", "Plane": plane})
    np.save(tmp_path / "d.npy", DARK)
    session, _ = imported(
        run, tmp_path, "--shots", "s.ome.tif", "--darks", "d.npy", "--camera", CAMERA
    )
    assert np.array_equal(mosaics(session, "shot"), LIT[:2])
    assert np.array_equal(mosaics(session, "dark"), DARK)
    shots = [session.stored[frame.id] for frame in session.frames if frame.kind == "shot"]
    assert [(shot.exposure_s, shot.host_time_s) for shot in shots] == [(0.02, 0.5), (0.04, 2.0)]


@pytest.mark.slow
def test_a_zarr_array_is_read(tmp_path, run):
    zarr = pytest.importorskip("zarr")
    zarr.create_group(tmp_path / "s.zarr").create_array("data", data=LIT[:2])
    session, _ = imported(run, tmp_path, "--shots", "s.zarr", "--camera", CAMERA)
    assert np.array_equal(mosaics(session, "shot"), LIT[:2])


def test_planes_of_a_colour_picture_are_three_shots_red_first(tmp_path, run):
    (tmp_path / "mono.yaml").write_text(
        "title: three openings\nsensor: {cfa: mono}\nshots: [{}, {}, {}]\n"
    )
    cv2.imwrite(str(tmp_path / "c.png"), np.moveaxis(LIT[[2, 1, 0]], 0, -1))
    session, _ = imported(run, tmp_path, "--shots", "c.png", "--planes", "--camera", "mono.yaml")
    assert np.array_equal(mosaics(session, "shot"), LIT[:3])


def test_fractions_without_darks_read_as_they_are_to_one_factor(tmp_path, run):
    noise = {"black_level_dn": 0, "white_level_dn": 1}
    camera = {"title": "of fractions", "sensor": {"cfa": "mono", "noise": noise}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(camera))
    values = (LIT[0] / 65_535).astype(np.float32)
    np.save(tmp_path / "s.npy", values)
    session, said = imported(run, tmp_path, "--shots", "s.npy", "--camera", "mine.yaml")
    assert "stored 65535 times as large" in said
    assert "noise is taken as 1%" in said
    readings = open_frames(session.folder)[1].readings[0]
    factor = np.median(readings / values)
    assert np.allclose(readings, factor * values, atol=factor / 65_535)
    assert np.percentile(readings, 99.9) == pytest.approx(0.9, rel=0.01)


def test_without_exposure_the_mask_place_of_the_table_is_that_of_the_camera(tmp_path, run):
    rows = world(tmp_path)
    rows[1] |= {"mask_x_um": 12.0, "mask_y_um": -36.0}
    table = table_of(tmp_path, rows)
    session, _ = imported(run, tmp_path, table, "--camera", CAMERA)
    (offset,) = session.camera["shots"][1]["offset_um"].values()
    assert list(offset) == [12.0, -36.0]


def test_frames_cannot_be_added_to_an_imported_session(tmp_path, run):
    session, _ = imported(run, tmp_path, table_of(tmp_path, world(tmp_path)), "--camera", CAMERA)
    assert "an imported session takes no further frames" in refused(run("capture", session.folder))


def failing(fault):
    def fail(*arguments, **more):
        raise fault

    return fail


@pytest.mark.parametrize("where", ["session", "spool"])
def test_a_disk_that_is_full_leaves_nothing(where, tmp_path, run, monkeypatch):
    table = table_of(tmp_path, world(tmp_path))
    before = sorted(tmp_path.rglob("*"))
    fault = failing(OSError(28, "No space left on device"))
    if where == "session":
        monkeypatch.setattr(Session, "store", fault)
    else:
        monkeypatch.setattr("emmc_rig.captures.import_session._spooled", fault)
    assert "No space left on device; nothing was imported" in refused(
        run("import", table, "--camera", CAMERA, "--out", tmp_path / "out")
    )
    assert sorted(tmp_path.rglob("*")) == before


def test_ctrl_c_leaves_nothing(tmp_path, run, monkeypatch):
    table = table_of(tmp_path, world(tmp_path))
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(Session, "store", failing(KeyboardInterrupt()))
    code, _, err = run("import", table, "--camera", CAMERA, "--out", tmp_path / "out")
    assert code == 130
    assert "nothing was written" in one_line(err)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("then", "words"), [(b"", "s1.npy: changed"), (None, "s1.npy: No such")])
def test_a_file_that_goes_while_it_is_imported_is_named(then, words, tmp_path, run, monkeypatch):
    table = table_of(tmp_path, world(tmp_path))
    file, write = tmp_path / "s1.npy", importing.write

    def later(*arguments):
        file.unlink() if then is None else file.write_bytes(then)
        return write(*arguments)

    monkeypatch.setattr(importing, "write", later)
    assert words in refused(run("import", table, "--camera", CAMERA, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


OUTS = {
    "s0.npy": "a file of that name exists",
    "s0.npy/out": "cannot be made",
    ".": "holds something already",
    "/proc/out": "/proc/out",
}


@pytest.mark.parametrize("out", OUTS)
def test_a_place_that_cannot_be_written_is_named(out, tmp_path, run):
    table = table_of(tmp_path, world(tmp_path))
    before = sorted(tmp_path.rglob("*"))
    assert OUTS[out] in refused(run("import", table, "--camera", CAMERA, "--out", out))
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--shots", "x*.npy"), "x*.npy: no file of that name or pattern (shot)"),
        (("--shots", "*.npy", "--darks", "d*.npy"), "is there twice"),
        (("--shots", "s*.npy", "--planes"), "the camera's sensor.cfa is rggb"),
        (("table.xlsx",), "table.xlsx: no such file"),
        ((".",), ".: a folder, where a file is meant"),
    ],
)
def test_a_mistake_in_the_command_is_named(arguments, words, tmp_path, run):
    world(tmp_path)
    assert words in refused(run("import", *arguments, "--camera", CAMERA, "--out", "out"))
    assert not (tmp_path / "out").exists()


def test_a_white_level_that_nobody_states_is_said(tmp_path, run):
    rows = world(tmp_path)
    for row in rows:
        np.save(tmp_path / row["file"], np.load(tmp_path / row["file"]) >> 4)
    _, said = imported(run, tmp_path, table_of(tmp_path, rows), "--camera", CAMERA)
    assert "white_level_dn is taken as 65535, as nothing states it" in said


def roll(folder, levels, signal_dn, names, seconds):
    """Write DNGs of a mono sensor with black levels by place, captured at these seconds."""
    noise = {"black_level_dn": 64, "white_level_dn": 4095, "electrons_per_s": 1e5}
    camera = {
        "title": "mono",
        "sensor": {"cfa": "mono", "noise": noise},
        "shots": [{}] * len(names),
    }
    (folder / "mine.yaml").write_text(yaml.safe_dump(camera))
    for name, second, signal in zip(names, seconds, signal_dn, strict=True):
        facts = Facts(captured=datetime(2026, 11, 27, 10, 0, second))
        mosaic = np.rint(np.resize(levels, (24, 32)) + signal).astype(np.uint16)
        (folder / name).write_bytes(encode_dng(mosaic, "mono", levels, 4095, 0.02, facts=facts))


def test_files_of_a_roll_are_shots_in_the_order_of_their_times_and_one_line_says_so(tmp_path, run):
    names = [f"IMG_{number}.dng" for number in ("9998", "9999", "0001", "0002")]
    textures = [n * LIT[0][:24, :32].astype(float) / LIT[0].max() for n in (1000, 1200, 1400, 1600)]
    roll(tmp_path, np.full((24, 32), 64), textures, names, range(0, 8, 2))
    session, said = imported(run, tmp_path, "--shots", "*.dng", "--camera", "mine.yaml")
    stored = [session.stored[frame.id].metadata["name"] for frame in session.frames]
    assert stored == names
    assert "*.dng: IMG_0001.dng follows IMG_9999.dng" in said
    assert said.count("by time, not by name") == 1


@pytest.mark.parametrize("gain", ["1", "2"])
def test_without_darks_readings_are_above_the_black_level_of_each_place(tmp_path, run, gain):
    rows, columns = np.indices((24, 32))
    levels = 64 + 40 * (rows % 2) + 3 * (columns % 4)
    texture = 1500 * LIT[0][:24, :32].astype(float) / LIT[0].max()
    roll(tmp_path, levels, [texture], ["s.dng"], [0])
    table_of(tmp_path, [{"file": "s.dng", "kind": "shot", "shot": 0, "gain": gain}])
    session, _ = imported(run, tmp_path, tmp_path / "table.csv", "--camera", "mine.yaml")
    readings = open_frames(session.folder)[1].readings[0]
    factor = np.median(readings / np.maximum(np.rint(texture), 1))
    assert np.allclose(readings, factor * np.rint(texture), atol=factor)

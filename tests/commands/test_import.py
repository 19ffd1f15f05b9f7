"""Files of another program become the session that the sequencer would have made of them."""

import csv
import hashlib
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
import yaml
from programs import one_line, program

from drivers.dng import encode_dng
from emmc_rig.files.cameras import shipped_camera_files
from emmc_rig.processing.reconstructing import open_frames
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.frame_means import decoded
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
        "open": [{"held_out": True}, {"mask_um": [0, 0]}, {"mask_um": [24, 0]}],
    },
    "darks": {"repeats": 2, "of_shots": 2},
}
LIT = np.random.default_rng(3).integers(300, 40_000, (4, 24, 32), np.uint16)
DARK = np.random.default_rng(4).integers(250, 262, (2, 24, 32), np.uint16)
CAMERA = "rgbw-bayer-2shots"


def exported(session, folder, write):
    """Write a session's frames as files of another program, with the table that names them."""
    folder.mkdir()
    frames = [f for f in session.frames if f.kind != "metering" and f.id in session.stored]
    rows = []
    for frame, (raw, exposure_s) in zip(frames, decoded(session, frames), strict=True):
        bench, um = frame.bench, frame.bench.offsets_um
        row = {"file": write(folder / frame.id, raw.mosaic), "kind": frame.kind}
        row |= {"exposure_s": repr(exposure_s), "lamp": bench.lamp}
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
    done = program("capture", folder / "plan.yaml", *RIG, "--out", folder / "session")
    assert done[0] == 0, done
    table = exported(Session(folder / "session"), folder / "files", npy)
    done = program("import", table, "--camera", CAMERA, "--out", folder / "imported")
    assert done[0] == 0, done
    return folder


def test_an_imported_session_is_complete_and_says_that_it_was_imported(captured):
    session = Session(captured / "imported")
    assert session.is_complete
    assert verify(session).is_complete
    (entry,) = of_kind(session.journal.entries, ImportedEntry)
    assert len(entry.files) == len(session.stored)
    first = session.frames[0].id
    frame = decode_frame(session.read(first), session.stored[first])
    file = captured / "files/dark-0-r0.npy"
    assert session.stored[first].metadata["imported"] == str(file)
    assert frame.original == file.read_bytes()
    assert entry.files[str(file)] == hashlib.sha256(file.read_bytes()).hexdigest()


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
    done = program("capture", folder / "plan.yaml", *RIG, "--out", folder / "session")
    assert done[0] == 0, done
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
    "form", [pytest.param(one, marks=[] if one in ("npy", "dng") else pytest.mark.slow)
             for one in FORMATS]
)  # fmt: skip
def test_shots_of_every_format_read_as_those_of_the_captured_session(shots_only, tmp_path, form):
    table = exported(Session(shots_only / "session"), tmp_path / "files", FORMATS[form])
    out = tmp_path / "imported"
    done = program("import", table, "--camera", shots_only / "mine.yaml", "--out", out)
    assert done[0] == 0, done
    (psi, frames), (own_psi, own_frames) = map(open_frames, (shots_only / "session", out))
    assert np.array_equal(psi.weights, own_psi.weights)
    assert np.array_equal(frames.readings, own_frames.readings)
    assert np.array_equal(frames.deviation, own_frames.deviation)

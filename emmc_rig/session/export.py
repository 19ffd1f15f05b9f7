"""A session as one HDF5 file with the names of NeXus, written when the session is complete.

    /entry                      NXentry: title, start_time, end_time, program_name
        /instrument/detector    NXdetector: data (frame, y, x) uint16, count_time, gain, levels
        /instrument/mask        NXpositioner: x, y; commanded beside; /aperture likewise
        /instrument/source      NXsource: the lamp of every frame
        /sample                 NXsample: scene or whiteboard
        /data                   NXdata: the frames, with id, kind and shot of each
        /fused                  NXdata: each shot's bracket as a linear rate with its deviation
        /process                NXprocess: versions; the plan and the camera as NXnote

Frames pass one at a time: memory stays flat. Source: NeXus definitions 2024.02, base classes.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from calibration.boards import gain_of
from calibration.errors import CalibrationError
from emmc_rig.errors import AppError
from emmc_rig.files.folders import new_file
from emmc_rig.session.board_sets import whiteboards
from emmc_rig.session.frame_means import decoded, session_darks
from emmc_rig.session.journal import FrameEntry
from emmc_rig.session.readings import fused_shot, shot_frames
from emmc_rig.session.session import CAMERA, RIG, Session

AXES = {"mask": ("mask_x", "mask_y"), "aperture": ("aperture_x", "aperture_y")}
Group = h5py.Group


def export_hdf5(
    session: Session,
    path: Path,
    compress: bool = False,
    on_frame: Callable[[str], None] = lambda frame_id: None,
) -> None:
    """Write a session to an HDF5 file: whole, or not at all.

    Every frame's digest is checked on the way. Raises AppError for a session that is not
    complete or not good, where a file of that name is there, and where it cannot be written.
    """
    missing = session.missing()
    if missing:
        raise AppError(
            f"{session.folder}: {len(missing)} of {len(session.needed)} frames are missing; "
            "resume it with `emmc-rig capture` first"
        )
    with new_file(path) as part, h5py.File(part, "w") as file:
        _write(session, file, compress, on_frame)


def _write(
    session: Session, file: h5py.File, compress: bool, on_frame: Callable[[str], None]
) -> None:
    file.attrs["default"] = "entry"
    file.attrs["creator"] = "emmc-rig"
    entry = _group(file, "entry", "NXentry", default="data")
    frames = session.needed
    lines = [session.stored[frame.id] for frame in frames]
    entry["title"] = session.header["title"]
    entry["program_name"] = "emmc-rig"
    entry["program_name"].attrs["version"] = session.header["versions"]["emmc-rig"]
    entry["start_time"] = session.header["created"]
    entry["end_time"] = max(line.wall for line in lines)
    instrument = _group(entry, "instrument", "NXinstrument")
    _detector(session, instrument, compress, on_frame)
    for name, axes in AXES.items():
        _positioner(instrument, name, axes, lines)
    source = _group(instrument, "source", "NXsource")
    source["name"] = _texts([frame.bench.lamp for frame in frames])
    sample = _group(entry, "sample", "NXsample")
    sample["name"] = _texts([frame.bench.target for frame in frames])
    data = _group(entry, "data", "NXdata", signal="data", axes=["frame_id", ".", "."])
    data["data"] = h5py.SoftLink("/entry/instrument/detector/data")
    data["frame_id"] = _texts([frame.id for frame in frames])
    data["kind"] = _texts([frame.kind for frame in frames])
    data["shot"] = [frame.bench.shot for frame in frames]
    data["masks_in"] = [frame.bench.masks_in for frame in frames]
    data["plan"] = [line.plan for line in lines]
    data["view"] = [frame.view or (-1, -1) for frame in frames]
    data["sha256"] = _texts([line.sha256 for line in lines])
    _fused(session, entry)
    process = _group(entry, "process", "NXprocess")
    process["program"] = "emmc-rig capture"
    process["version"] = session.header["versions"]["emmc-rig"]
    for name, kind, text in (
        ("plan", "application/yaml", session.plan_yaml),
        ("camera", "application/json", session.holding(CAMERA).decode()),
        ("rig", "application/json", session.holding(RIG).decode()),
    ):
        note = _group(process, name, "NXnote")
        note["type"], note["data"] = kind, text


def _detector(
    session: Session, instrument: Group, compress: bool, on_frame: Callable[[str], None]
) -> None:
    frames = session.needed
    lines = [session.stored[frame.id] for frame in frames]
    detector = _group(instrument, "detector", "NXdetector")
    shape = lines[0].shape
    data = detector.create_dataset(
        "data",
        (len(frames), *shape),
        np.uint16,
        chunks=(1, *shape),
        compression="gzip" if compress else None,
        compression_opts=1 if compress else None,
        shuffle=compress,
    )
    data.attrs["units"] = "DN"
    for place, (planned, (frame, _)) in enumerate(
        zip(frames, decoded(session, frames), strict=True)
    ):
        if frame.mosaic.shape != shape:
            raise AppError(f"{session.folder}: frame {planned.id} has another size than the first")
        data[place] = frame.mosaic
        on_frame(planned.id)
    _values(detector, "count_time", [line.exposure_s for line in lines], "s")
    _values(detector, "gain", [line.gain for line in lines], "")
    _values(detector, "black_level", [line.black_level_dn for line in lines], "DN")
    detector["saturation_value"] = lines[0].white_level_dn
    detector["saturation_value"].attrs["units"] = "DN"
    detector["bayer_pattern"] = lines[0].cfa
    camera = {} if session.first_run is None else session.first_run.camera
    for name, key in (("vendor", "maker"), ("model", "model"), ("serial_number", "serial")):
        detector[name] = camera.get(key, "")


def _positioner(
    instrument: Group, name: str, axes: tuple[str, str], lines: list[FrameEntry]
) -> None:
    """Write where the axes read to be, and were sent; NaN where a frame did not need them."""
    if not any(axis in line.read_um for line in lines for axis in axes):
        return
    group = _group(instrument, name, "NXpositioner")
    for letter, axis in zip("xy", axes, strict=True):
        read = [line.read_um.get(axis, np.nan) for line in lines]
        commanded = [line.commanded_um.get(axis, np.nan) for line in lines]
        _values(group, letter, read, "um")
        _values(group, f"{letter}_commanded", commanded, "um")


def _fused(session: Session, entry: Group) -> None:
    """Write every shot's bracket as one linear frame, where darks say what the sensor adds."""
    shots = shot_frames(session)
    if not shots or not any(frame.kind == "dark" for frame in session.frames):
        return
    darks = session_darks(session)
    gain = None
    with suppress(AppError, CalibrationError):
        gain = gain_of(whiteboards(session))
    if gain is None:
        return
    group = _group(entry, "fused", "NXdata", signal="data", axes=["shot", ".", "."])
    shape = (len(shots), *darks[0].mean_dn.shape)
    data = group.create_dataset("data", shape, np.float32)
    errors = group.create_dataset("data_errors", shape, np.float32)
    usable = group.create_dataset("usable", shape, bool)
    data.attrs["units"] = errors.attrs["units"] = "DN/s"
    for place, frames in enumerate(shots.values()):
        linear = fused_shot(session, frames, darks, gain)
        data[place], errors[place] = linear.dn_per_s, np.sqrt(linear.variance)
        usable[place] = linear.usable
    group["shot"] = list(shots)


def _group(parent: Group, name: str, kind: str, **attributes: Any) -> Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    for key, value in attributes.items():
        group.attrs[key] = value
    return group


def _values(group: Group, name: str, values: list[Any], units: str) -> None:
    group[name] = np.array(values, dtype=np.float64)
    if units:
        group[name].attrs["units"] = units


def _texts(values: list[str]) -> np.ndarray:
    return np.array(values, dtype=h5py.string_dtype())

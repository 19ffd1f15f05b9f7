"""A session as one HDF5 file with the names of NeXus, written when the session is complete.

    /entry                      NXentry: title, start_time, end_time, program_name
        /instrument/detector    NXdetector: data (frame, y, x) uint16, count_time, gain, levels
        /instrument/mask        NXpositioner: x, y; commanded beside; /aperture likewise
        /instrument/source      NXsource: the lamp of every frame
        /sample                 NXsample: scene or whiteboard
        /data                   NXdata: the frames, with id, kind, shot, time, notes (JSON) of each
        /environment            NXcollection: temperatures, sources of the rig's file; NaN: not read
        /process                NXprocess: versions; the plan and the camera as NXnote

Or as a folder of DNG files, whose EXIF says of each frame what the session knows.

Frames pass one at a time: memory stays flat. Source: NeXus definitions 2024.02, base classes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from emmc_rig.drivers.camera import CameraIdentity
from emmc_rig.drivers.dng import Facts
from emmc_rig.drivers.raw import captured_at
from emmc_rig.errors import AppError
from emmc_rig.progress import Watcher
from emmc_rig.session.board_sets import decoded
from emmc_rig.session.frame_file import dng_of, iso_of
from emmc_rig.session.journal import FrameEntry, ImportedEntry, RunEntry, of_kind
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import CAMERA, RIG, Session
from emmc_rig.store.folders import new_file, result_folder

AXES = {"mask": ("mask_x", "mask_y"), "aperture": ("aperture_x", "aperture_y")}
UNITS = {"count_time": "s", "black_level": "DN", "saturation_value": "DN", "data": "DN"}
"""Of numbers; places are in um."""


def export_hdf5(
    session: Session,
    path: Path,
    compress: bool = False,
    watcher: Watcher | None = None,
) -> None:
    """Write a session to an HDF5 file: whole, or not at all.

    Every frame's digest is checked on the way. Raises AppError for a session that is not
    complete or not good, where a file of that name is there, and where it cannot be written.
    """
    missing = session.missing()
    if missing:
        raise AppError(
            f"{session.folder}: {len(missing)} of {len(session.needed)} frames are missing; "
            "resume the capture first",
            "capture",
            session.folder,
        )
    frames = session.needed
    lines = [session.stored[frame.id] for frame in frames]
    runs = of_kind(session.journal.entries, RunEntry)
    with new_file(path) as part, h5py.File(part, "w") as file:
        file.attrs.update(default="entry", creator="emmc-rig")
        for name, (nx_class, values) in _groups(session, frames, lines).items():
            _fill(file.create_group(name), nx_class, values)
        file["entry"].attrs["default"] = "data"
        file["entry/program_name"].attrs["version"] = session.header["versions"]["emmc-rig"]
        units = {name: unit for run in runs for name, unit in run.environment.items()}
        if isinstance(beside := file.get("entry/environment"), h5py.Group):
            for name, values in beside.items():
                values.attrs["units"] = units.get(name, "C")
        _write_frames(
            session,
            file.require_group("entry/instrument/detector"),
            lines[0].shape,
            compress,
            watcher or Watcher(),
        )
        file["entry/data"].attrs.update(signal="data", axes=["frame_id", ".", "."])
        file["entry/data/data"] = h5py.SoftLink("/entry/instrument/detector/data")


def export_dng(session: Session, folder: Path, watcher: Watcher | None = None) -> None:
    """Write every stored frame as a DNG with its facts into a folder, named as in the session.

    Its mosaic as the camera gave it, levels in whole DN. Exposure, ISO (where the camera states
    it), the time of exposure to the millisecond, maker, model, serial number, and as
    ImageUniqueID the session's id followed by 16 digits of the frame's own. Every frame's digest is
    checked on the way. Raises AppError where a frame is not good, or nothing can be written.
    """
    watcher = watcher or Watcher()
    frames = [frame for frame in session.frames if frame.id in session.stored]
    if not frames:
        raise AppError(f"{session.folder}: no frame was captured yet; resume the capture")
    runs = of_kind(session.journal.entries, RunEntry)
    imported = bool(of_kind(session.journal.entries, ImportedEntry))
    with result_folder(folder, "session export --dng") as new:
        for planned, frame in zip(frames, decoded(session, frames), strict=True):
            line = session.stored[planned.id]
            run = runs[max(0, line.run - 1)] if runs else None
            named = {} if run is None else run.camera
            keys = ("maker", "model", "serial")
            maker, model, serial = (named.get(key) or line.metadata.get(key, "") for key in keys)
            facts = Facts(
                iso_of(line.metadata),
                _captured(line, imported),
                f"session {session.id}, frame {planned.id}",
                f"{session.id}{line.sha256[:16]}",
                f"emmc-rig {session.header['versions']['emmc-rig']}",
            )
            identity = CameraIdentity(maker, model, serial)
            data = dng_of(frame, identity, facts=facts)
            (new / line.file).with_suffix(".dng").write_bytes(data)
            watcher.step(planned.id)


def _captured(line: FrameEntry, imported: bool) -> datetime | None:
    """Return when a frame was exposed; of an imported one by the camera's clock, if it says."""
    if imported:
        return captured_at(line.metadata)
    try:
        return datetime.fromisoformat(line.wall)
    except ValueError:
        return None


def _groups(
    session: Session, frames: Sequence[PlannedFrame], lines: Sequence[FrameEntry]
) -> dict[str, tuple[str, Mapping[str, Any]]]:
    """Return class and datasets of every group, those above others first."""
    camera = {} if session.first_run is None else session.first_run.camera
    version = session.header["versions"]["emmc-rig"]
    noted = session.notes
    beside = [line.temperatures_c | line.environment for line in lines]
    names = dict.fromkeys(name for values in beside for name in values)
    read = {name: [values.get(name, np.nan) for values in beside] for name in names}
    detector = {
        "count_time": [line.exposure_s for line in lines],
        "gain": [line.gain for line in lines],
        "black_level": [line.black_level_dn for line in lines],
        "saturation_value": lines[0].white_level_dn,
        "bayer_pattern": lines[0].cfa,
        "vendor": camera.get("maker", ""),
        "model": camera.get("model", ""),
        "serial_number": camera.get("serial", ""),
    }
    data = {
        "frame_id": [frame.id for frame in frames],
        "kind": [frame.kind for frame in frames],
        "shot": [frame.bench.shot for frame in frames],
        "masks_in": [frame.bench.masks_in for frame in frames],
        "plan": [line.plan for line in lines],
        "view": [frame.view or (-1, -1) for frame in frames],
        "sha256": [line.sha256 for line in lines],
        "time": [line.wall for line in lines],
        "notes": [json.dumps(noted.get(frame.id, {})) for frame in frames],
    }
    notes = {
        "plan": ("application/yaml", session.plan_yaml),
        "camera": ("application/json", session.holding(CAMERA).decode()),
        "rig": ("application/json", session.holding(RIG).decode()),
    }
    entry = {
        "title": session.header["title"],
        "program_name": "emmc-rig",
        "start_time": session.header["created"],
        "end_time": max(line.wall for line in lines),
    }
    lamps, targets = ([getattr(f.bench, key) for f in frames] for key in ("lamp", "target"))
    return {
        "entry": ("NXentry", entry),
        "entry/instrument": ("NXinstrument", {}),
        "entry/instrument/detector": ("NXdetector", detector),
        **{
            f"entry/instrument/{name}": ("NXpositioner", _places_um(axes, lines))
            for name, axes in AXES.items()
            if any(axis in line.read_um for line in lines for axis in axes)
        },
        "entry/instrument/source": ("NXsource", {"name": lamps}),
        "entry/sample": ("NXsample", {"name": targets}),
        "entry/data": ("NXdata", data),
        **({"entry/environment": ("NXcollection", read)} if read else {}),
        "entry/process": ("NXprocess", {"program": "emmc-rig capture", "version": version}),
        **{
            f"entry/process/{name}": ("NXnote", {"type": kind, "data": text})
            for name, (kind, text) in notes.items()
        },
    }


def _places_um(axes: tuple[str, str], lines: Sequence[FrameEntry]) -> dict[str, list[float]]:
    """Return where axes read to be, and were sent; NaN where a frame did not need them."""
    places = {}
    for letter, axis in zip("xy", axes, strict=True):
        places[letter] = [line.read_um.get(axis, np.nan) for line in lines]
        places[f"{letter}_commanded"] = [line.commanded_um.get(axis, np.nan) for line in lines]
    return places


def _fill(group: h5py.Group, nx_class: str, values: Mapping[str, Any]) -> None:
    group.attrs["NX_class"] = nx_class
    for name, value in values.items():
        is_texts = isinstance(value, list) and isinstance(value[0], str)
        group[name] = np.array(value, h5py.string_dtype()) if is_texts else value
        units = "um" if nx_class == "NXpositioner" else UNITS.get(name)
        if units and not isinstance(value, str):
            group[name].attrs["units"] = units


def _write_frames(
    session: Session,
    detector: h5py.Group,
    shape: tuple[int, int],
    compress: bool,
    watcher: Watcher,
) -> None:
    frames = session.needed
    packing = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if compress else {}
    data = detector.create_dataset(
        "data", (len(frames), *shape), np.uint16, chunks=(1, *shape), **packing
    )
    data.attrs["units"] = UNITS["data"]
    for place, frame in enumerate(decoded(session, frames)):
        if frame.mosaic.shape != shape:
            name = frames[place].id
            raise AppError(f"{session.folder}: frame {name} has another size than the first")
        data[place] = frame.mosaic
        watcher.step(frames[place].id)

"""A frame as a file that decodes to it again, on any machine, without the camera's driver.

That is the camera's own bytes where they are of a format known here; of any other camera, such as
a plug-in's, a DNG of the mosaic with the camera's own bytes in it. The choice depends on a trial:
the camera's bytes are decoded and compared with the frame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from emmc_rig.drivers.camera import CameraIdentity
from emmc_rig.drivers.cameras import CAMERAS
from emmc_rig.drivers.dng import LARGEST_TILE, Facts, encode_dng, private_data
from emmc_rig.drivers.errors import DriverError, RawFrameError
from emmc_rig.drivers.raw import RAW_SUFFIXES, TIFF_MAGICS, RawFrame, captured_at, decode_raw
from emmc_rig.errors import AppError
from emmc_rig.session.journal import Figures, FrameEntry

STREAMED = ".bin"
"""Frames that the drivers of `drivers.cameras` decode by themselves."""
NO_FIGURES = Figures(0.0, 0.0, 0.0)
UNSTORABLE = "the camera's frame cannot be stored without loss: correct its driver"


@dataclass(frozen=True)
class FrameFile:
    """What is stored of a frame; camera_sha256: see `FrameEntry`."""

    suffix: str
    data: bytes
    sha256: str
    camera_sha256: str | None = None


def frame_facts(frame: RawFrame) -> dict[str, Any]:
    """Return what is kept of a frame beside its bytes: plain data, for JSON.

    A large tile of black levels is kept as the means of a 2x2 tile: the file alone has room for it.
    """
    black_dn = frame.black_level_dn
    if black_dn.size > LARGEST_TILE:
        black_dn = np.array(
            [[black_dn[row::2, column::2].mean() for column in (0, 1)] for row in (0, 1)]
        )
    return {
        "shape": list(frame.mosaic.shape),
        "cfa": frame.cfa,
        "black_level_dn": black_dn.tolist(),
        "white_level_dn": frame.white_level_dn,
        "exposure_s": frame.exposure_s,
        "gain": frame.gain,
        "camera_time_s": frame.camera_time_s,
        "host_time_s": frame.host_time_s,
        "metadata": dict(frame.metadata),
    }


def frame_entry(frame: RawFrame, exposure_s: float, gain: float, **about: Any) -> FrameEntry:
    """Return what a journal keeps of a frame beside its file, and `about` it.

    exposure_s, gain: the frame's own, or the camera's where it says none.
    """
    known = {**frame_facts(frame), "exposure_s": exposure_s, "gain": gain}
    return FrameEntry(id="", file="", bytes=0, sha256="", **known, **about)


def iso_of(metadata: Mapping[str, Any]) -> int | None:
    """Return the ISO that the camera states with a frame."""
    stated = str(metadata.get("iso", ""))
    return int(stated) if stated.isdecimal() and int(stated) else None


def frame_file(frame: RawFrame, wall: str = "", serial: str = "") -> FrameFile:
    """Return the file from which `decode_frame` returns the frame.

    wall, serial: the time of exposure as `FrameEntry` has it, and the camera's serial number, for a
    DNG that is made here; time and number in the frame's metadata come first. Raises AppError for a
    frame that no file can hold.
    """
    suffix = Path(frame.metadata.get("name", "")).suffix.lower()
    if suffix not in RAW_SUFFIXES:
        suffix = ".dng" if frame.original[:4] in TIFF_MAGICS else STREAMED
    own = FrameFile(suffix, frame.original, frame.sha256)
    if _decodes_to(own, frame):
        return own
    stated = frame.metadata
    identity = CameraIdentity(
        stated.get("maker", ""), stated.get("model", ""), stated.get("serial", serial)
    )
    asked = datetime.fromisoformat(wall) if wall else None
    facts = Facts(iso_of(stated), captured_at(stated) or asked)
    data = dng_of(frame, identity, frame.original, facts)
    made = FrameFile(".dng", data, hashlib.sha256(data).hexdigest(), frame.sha256)
    if not _decodes_to(made, frame):
        raise AppError(f"{UNSTORABLE} (a DNG of it decodes to something else)")
    return made


def decode_frame(data: bytes, entry: FrameEntry) -> RawFrame:
    """Return the frame in a session's file; entry: its journal line. Raises a `DriverError`."""
    if entry.camera_sha256 is not None:
        frame = decode_raw(data)
        if frame.black_level_dn.size <= LARGEST_TILE:  # in whole DN in DNGs of versions before 0.4
            frame = replace(frame, black_level_dn=np.array(entry.black_level_dn, np.float64))
        frame = replace(
            frame,
            white_level_dn=entry.white_level_dn,
            cfa=entry.cfa,
            original=private_data(data),
            sha256=entry.camera_sha256,
        )
    elif Path(entry.file).suffix == STREAMED:
        protocols = (driver for driver in CAMERAS.values() if driver.frame_prefix)
        driver = next(
            (driver for driver in protocols if data.startswith(driver.frame_prefix)), None
        )
        if driver is None:
            raise RawFrameError(
                f"{entry.file} is in a format that only the plug-in of its camera knows: "
                "emmc-rig 0.2 stored it without its mosaic"
            )
        black_dn = entry.black_level_dn[0][0]
        frame = driver.load().decode_frame(data, black_dn, entry.white_level_dn)
    else:
        frame = decode_raw(data)
    return replace(frame, exposure_s=entry.exposure_s, gain=entry.gain)


def _decodes_to(file: FrameFile, frame: RawFrame) -> bool:
    try:
        named = {"file": f"frame{file.suffix}", "camera_sha256": file.camera_sha256}
        entry = frame_entry(frame, 0.0, 1.0, figures=NO_FIGURES)
        back = decode_frame(file.data, entry.model_copy(update=named))
    except DriverError:
        return False
    return (
        (back.cfa, back.white_level_dn) == (frame.cfa, frame.white_level_dn)
        and np.array_equal(back.black_level_dn, frame.black_level_dn)
        and np.array_equal(back.mosaic, frame.mosaic)
        and (back.original, back.sha256) == (frame.original, frame.sha256)
    )


def dng_of(
    frame: RawFrame,
    identity: CameraIdentity,
    private: bytes | None = None,
    facts: Facts | None = None,
) -> bytes:
    """Return a DNG of a frame's mosaic, see `encode_dng`: its levels not below 0.

    Raises AppError for a frame that no DNG can hold.
    """
    try:
        return encode_dng(
            frame.mosaic,
            frame.cfa,
            np.maximum(frame.black_level_dn, 0),
            frame.white_level_dn,
            frame.exposure_s,
            identity,
            private,
            facts,
        )
    except (ValueError, OverflowError) as fault:
        raise AppError(f"{UNSTORABLE} ({fault})") from fault

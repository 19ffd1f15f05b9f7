"""A frame as a file: the camera's own bytes out, and the frame back with what the journal knows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from drivers.raw import RAW_SUFFIXES, TIFF_MAGICS, RawFrame, decode_raw
from emmc_rig.session.journal import Entry

STREAMED = ".bin"
"""Frames of USB3 Vision cameras: leader, payload and trailer."""


def suffix_of(frame: RawFrame) -> str:
    """Return the kind of file that the camera's bytes are."""
    suffix = Path(frame.metadata.get("name", "")).suffix.lower()
    if suffix in RAW_SUFFIXES:
        return suffix
    return ".dng" if frame.original[:4] in TIFF_MAGICS else STREAMED


def frame_facts(frame: RawFrame) -> dict[str, Any]:
    """Return what a journal keeps of a frame beside its bytes: plain data, for JSON."""
    return {
        "shape": list(frame.mosaic.shape),
        "cfa": frame.cfa,
        "black_level_dn": frame.black_level_dn.tolist(),
        "white_level_dn": frame.white_level_dn,
        "exposure_s": frame.exposure_s,
        "gain": frame.gain,
        "camera_time_s": frame.camera_time_s,
        "host_time_s": frame.host_time_s,
        "metadata": dict(frame.metadata),
    }


def decode_frame(data: bytes, entry: Entry) -> RawFrame:
    """Return the frame in a session's file; entry: its journal line. Raises a `DriverError`."""
    if Path(entry["file"]).suffix == STREAMED:
        # Its kernels take half a second to load, and most cameras write files.
        from drivers.u3v import decode_u3v

        black_dn = float(entry["black_level_dn"][0][0])
        frame = decode_u3v(data, black_dn, entry["white_level_dn"])
    else:
        frame = decode_raw(data)
    return replace(frame, exposure_s=entry["exposure_s"], gain=entry["gain"])

"""Replaying a recording: each planned frame is matched with a RAW file, by name, time and exposure.

A file named as a frame (`shot-0-e0-r0.dng`, or as sessions name their files) is that frame. The
other files are matched by time, then name, if they are as many as the frames left and all exposures
agree. Nothing else is guessed: missing frames are named, and the rest of the session is taken.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from emmc_rig.bench.hardware import Rig
from emmc_rig.drivers.camera import EXPOSURE_AGREEMENT
from emmc_rig.drivers.errors import FolderCameraError
from emmc_rig.drivers.folder import FolderCamera, Recorded
from emmc_rig.errors import AppError
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session


def matched(frames: Sequence[PlannedFrame], files: Sequence[Recorded]) -> dict[str, Recorded]:
    """Return the file of each frame, by the frame's id; files: in the order of capture."""
    # Sessions put a number before the frame's name.
    named = {re.sub(r"^\d{5}-", "", Path(file.name).stem): file for file in files}
    found = {frame.id: named[frame.id] for frame in frames if frame.id in named}
    taken = {file.name for file in found.values()}
    left = [file for file in files if file.name not in taken]
    wanted = [frame for frame in frames if frame.id not in found and not frame.is_optional]
    if len(wanted) == len(left) and all(map(_agree, wanted, left)):
        found |= {frame.id: file for frame, file in zip(wanted, left, strict=True)}
    return found


def _agree(frame: PlannedFrame, file: Recorded) -> bool:
    """Return whether the exposures that both state are the same."""
    if frame.exposure_s is None or file.exposure_s is None:
        return True
    return abs(file.exposure_s / frame.exposure_s - 1) <= EXPOSURE_AGREEMENT


def replaying(rig: Rig, frames: Sequence[PlannedFrame]) -> tuple[Rig, Mapping[str, Recorded]]:
    """Return the rig, whose folder camera then gives each frame its file, and these files.

    Raises AppError where no file is a frame.
    """
    camera = rig.camera
    assert isinstance(camera, FolderCamera)
    files = camera.files()
    found = matched(frames, files)
    if not found:
        raise AppError(
            f"{camera.folder}: its {len(files)} files cannot be matched to the plan's "
            f"{len(frames)} frames by number and exposures; name them after the frames, as "
            f"{frames[0].id}.dng"
        )

    def choose(frame_id: str) -> None:
        if frame_id not in found:
            raise FolderCameraError(str(camera.folder), f"no file of it is frame {frame_id}")
        camera.choose(found[frame_id].name)

    recorded_s = {name: file.exposure_s for name, file in found.items() if file.exposure_s}
    rig = replace(rig, about_to_expose=choose, recorded_s=recorded_s, reopen_camera=None)
    return rig, found


def there(
    session: Session, found: Mapping[str, Recorded]
) -> Callable[[Callable[[], float]], tuple[PlannedFrame, ...]]:
    """Return a `Sequencer`'s selection of frames: missing frames that have a file."""

    def choose(now_s: Callable[[], float]) -> tuple[PlannedFrame, ...]:
        known = {*found, *session.stored, None}
        return tuple(f for f in session.missing() if f.id in found and f.metered_by in known)

    return choose


def missing_words(
    folder: Path, frames: Sequence[PlannedFrame], found: Mapping[str, Recorded]
) -> str:
    """Return a sentence that names frames without a file, or ""; frames: still to be taken."""
    missing = [frame for frame in frames if frame.id not in found and not frame.is_optional]
    if not missing:
        return ""
    shown = ", ".join(
        f"{frame.id} ({frame.exposure_s:g} s)" if frame.exposure_s else frame.id
        for frame in missing[:5]
    )
    more = ", ..." if len(missing) > 5 else ""
    return (
        f"{folder}: no file is known to be {shown}{more}; the others are taken. Add it as "
        f"{missing[0].id}.dng and run the same command"
    )

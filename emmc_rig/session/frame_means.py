"""Means of a session's frames: darks, references, whiteboards; one frame in memory at a time."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from emmc_rig.calibration.frames import MeanFrame, average, before_and_after
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.model.settings import validated
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import FrameEntry, ImportedEntry, of_kind
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

KEPT_BYTES = 2**28
"""Of means of frames that an open session keeps."""


def camera_of(session: Session) -> Camera:
    """Return the camera as planned."""
    return validated(Camera, session.camera, str(session.folder), AppError)


def taken_shots(session: Session) -> tuple[int, ...]:
    """Return the shots of the scene that the session needs, by their place in the plan."""
    return tuple(sorted({f.bench.shot for f in session.needed if f.kind == "shot"}))


def decoded(session: Session, frames: Iterable[PlannedFrame]) -> Iterator[RawFrame]:
    """Yield frames with exposure and gain as journalled; raises AppError for a damaged frame."""
    for frame in frames:
        data = session.read(frame.id)
        yield decode_frame(data, session.stored[frame.id])


def stage_um_of(frame: PlannedFrame) -> tuple[float, float]:
    """Return where the mask stage was sent, from where it is centred, x and y."""
    offsets = frame.bench.offsets_um
    return offsets.get("mask_x", 0.0), offsets.get("mask_y", 0.0)


def references_of(session: Session) -> dict[tuple[int, str], list[PlannedFrame]]:
    """Return the frames of the open aperture without masks, by shot and lamp."""
    found: dict[tuple[int, str], list[PlannedFrame]] = defaultdict(list)
    for frame in session.frames:
        if frame.kind == "reference":
            found[frame.bench.shot, frame.bench.lamp].append(frame)
    return found


def session_darks(session: Session, of_shots: bool = True) -> tuple[MeanFrame, ...]:
    """Return the darks of each exposure; those taken before and after the whiteboards as one.

    of_shots: those too that were taken for the shots of the scene. Of an imported session what no
    dark tells is the camera's: see `_imported_dark`.
    """
    if is_imported(session) and not any(frame.kind == "dark" for frame in session.frames):
        return (_imported_dark(session),)
    groups: dict[tuple[float, int], list[PlannedFrame]] = defaultdict(list)
    for frame in darks_of(session):
        if frame.is_dark_of_shots and not of_shots:
            continue
        groups[exposure_of(session, frame), frame.part].append(frame)
    found: dict[float, MeanFrame] = {}
    for (exposure_s, _), frames in sorted(groups.items()):
        mean = mean_of(session, frames)
        earlier = found.get(exposure_s)
        found[exposure_s] = mean if earlier is None else before_and_after(earlier, mean)
    if is_imported(session):
        known = _imported_dark(session).variance_dn2
        return tuple(
            replace(dark, variance_dn2=known) if dark.count == 1 else dark
            for dark in found.values()
        )
    return tuple(found.values())


def is_imported(session: Session) -> bool:
    """Return whether the frames are files of another program."""
    return bool(of_kind(session.journal.entries, ImportedEntry))


def _imported_dark(session: Session) -> MeanFrame:
    """Return the dark that black level and read noise of the camera make."""
    noise = camera_of(session).sensor.noise
    (frame,) = decoded(session, session.needed[:1])
    entry = session.stored[session.needed[0].id]
    read_dn = noise.gain_dn_per_electron * noise.read_noise_electrons
    # Reading out in whole DN adds a twelfth.
    black = frame.black_by_place().astype(np.float32)
    return MeanFrame(black, read_dn**2 + 1 / 12, 1, entry.exposure_s)


def mean_dark(session: Session) -> MeanFrame:
    """Return the average of the dark frames of the shortest exposure; raises AppError."""
    return min(session_darks(session, of_shots=False), key=lambda frame: frame.exposure_s)


def darks_of(session: Session) -> list[PlannedFrame]:
    """Return the dark frames; raises AppError without any in the plan."""
    darks = [frame for frame in session.frames if frame.kind == "dark"]
    if not darks:
        raise AppError(f"{session.folder}: its plan has no darks")
    return darks


def frame_shape(session: Session) -> tuple[int, int]:
    """Return rows and columns of the frames captured; raises AppError where no dark was."""
    first = (session.frames if is_imported(session) else darks_of(session))[0]
    exposure_of(session, first)
    rows, columns = session.stored[first.id].shape
    return rows, columns


def exposure_of(session: Session, frame: PlannedFrame) -> float:
    """Return how long a frame was exposed; raises AppError where it was not captured yet."""
    entry = session.stored.get(frame.id)
    if entry is None:
        raise AppError(f"{session.folder}: frame {frame.id} was not captured yet; resume it")
    return entry.exposure_s


def _taken_s(session: Session, entry: FrameEntry) -> float:
    """Return when a frame was taken, in seconds of the session.

    The clock of a run may begin anew with it: then the run follows the one before.
    """
    times: dict[int, list[float]] = defaultdict(list)
    for other in session.stored.values():
        times[other.run].append(other.host_time_s or 0.0)
    offset = latest = 0.0
    for run in sorted(times):
        offset = max(0.0, latest - min(times[run])) if run != min(times) else 0.0
        latest = max(times[run]) + offset
        if run == entry.run:
            break
    return (entry.host_time_s or 0.0) + offset


def alike_frames(session: Session, frames: list[PlannedFrame]) -> list[PlannedFrame]:
    """Return the most repeats that are alike in exposure: an amendment of the plan may change it.

    Raises AppError where one was not captured yet.
    """
    exposures_s = [exposure_of(session, frame) for frame in frames]
    (exposure_s, _), *_ = Counter(exposures_s).most_common()
    return [frame for frame, own_s in zip(frames, exposures_s, strict=True) if own_s == exposure_s]


def mean_of(session: Session, frames: list[PlannedFrame]) -> MeanFrame:
    """Return the mean of frames that differ in nothing; raises AppError or CalibrationError.

    Each mean is computed once while those of a session take less than KEPT_BYTES.
    """
    alike = alike_frames(session, frames)
    entries = [session.stored[frame.id] for frame in alike]
    key = tuple((frame.id, entry.sha256) for frame, entry in zip(alike, entries, strict=True))
    if key in session.means:
        return session.means[key]
    mosaics = (frame.mosaic for frame in decoded(session, alike))
    taken_s = float(np.mean([_taken_s(session, entry) for entry in entries]))
    first, what, lit = entries[0], alike[0].id, alike[0].kind != "dark"
    mean = average(mosaics, first.exposure_s, first.white_level_dn, what, taken_s, lit)
    if (len(session.means) + 1) * mean.mean_dn.nbytes <= KEPT_BYTES:
        session.means[key] = mean
    return mean

"""Whiteboards, darks and references of a session as calibration takes them: means of frames.

One frame is in memory at a time.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import BoardFrame, BoardSet
from emmc_rig.calibration.frames import MeanFrame, average, before_and_after
from emmc_rig.calibration.levels import Check, check_of
from emmc_rig.calibration.sensor import Pair
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.model.settings import validated
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import FrameEntry, ImportedEntry, of_kind
from emmc_rig.session.planned import VALIDATION, PlannedFrame
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
        raise AppError(
            f"{session.folder}: frame {frame.id} was not captured yet; resume the capture"
        )
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


@dataclass(frozen=True, eq=False)
class SessionBoards:
    """A session's whiteboards by what takes them; None where the plan has no such frames.

    fit: for the parametric methods, those of the open aperture, and those through the pinhole as
    well. pinholes: for the method free. held_out: used by no fit. turned: by the degrees that the
    board was turned.
    """

    fit: BoardSet | None
    pinholes: BoardSet | None
    held_out: BoardSet | None
    turned: Mapping[float, BoardSet]


def board_sets(session: Session, channels: NDArray[np.uint8]) -> SessionBoards:
    """Return a session's whiteboards; channels: (y, x), the colour each pixel sees (3: all)."""
    every = _without_boards(session)
    found = {kind: _board_frames(session, kind) for kind in ("open", "whiteboard", VALIDATION)}
    turned: dict[float, dict[bool, list[PlannedFrame]]] = defaultdict(lambda: defaultdict(list))
    for frame in session.frames:
        if frame.kind == "turned":
            turned[frame.bench.board_turn_deg][frame.bench.masks_in].append(frame)
    if not turned and not any(found.values()):
        raise AppError(f"{session.folder}: its plan has no whiteboards")
    checks = tuple(_checks(session, every, channels))
    few = [*found["open"], *(found["whiteboard"] if found["open"] else ())]
    fit, free, held_out = (
        replace(every, frames=tuple(frames), checks=checks) if frames else None
        for frames in (few, found["whiteboard"], found[VALIDATION])
    )
    own_um = next((board.stage_um for board in found["open"]), (0.0, 0.0))
    boards = {
        turn_deg: BoardSet(
            every.darks,
            {(0, "white"): mean_of(session, by[False])},
            (BoardFrame.held(mean_of(session, by[True]), own_um),),
        )
        for turn_deg, by in turned.items()
    }
    return SessionBoards(fit, free, held_out, boards)


def whiteboards(session: Session) -> BoardSet:
    """Return the whiteboards through the pinhole, which `measure_psi` takes.

    Raises AppError where the plan has no whiteboards, no darks, or they were not all captured.
    """
    if not references_of(session):
        raise AppError(f"{session.folder}: its plan has no whiteboards")
    return _without_boards(session).with_frames(_board_frames(session, "whiteboard"))


def _without_boards(session: Session) -> BoardSet:
    """Return darks and references; the white lamp's first: the sensor's gain follows from it."""
    by_lamp = sorted(references_of(session).items(), key=lambda item: item[0][1] != "white")
    references = {key: mean_of(session, frames) for key, frames in by_lamp}
    return BoardSet(session_darks(session, of_shots=False), references, ())


def _board_frames(session: Session, kind: str) -> list[BoardFrame]:
    """Return the whiteboards of a kind, each of all its repeats that are alike."""
    groups: dict[str, list[PlannedFrame]] = defaultdict(list)
    for frame in session.frames:
        if frame.kind == kind:
            groups[frame.id.rpartition("-r")[0]].append(frame)
    found = []
    for frames in groups.values():
        alike, first = alike_frames(session, frames), frames[0]
        read, bench = partial(mean_of, session, alike), first.bench
        places = [session.stored[frame.id].deviation_um for frame in alike]
        loose = first.view is not None and any(
            "aperture_x" in by or "aperture_y" in by for by in places
        )
        how = stage_um_of(first), bench.shot, first.view, bench.lamp, first.window, loose
        found.append(BoardFrame(read, len(alike), *how))
    return found


def _checks(session: Session, boards: BoardSet, channels: NDArray[np.uint8]) -> Iterator[Check]:
    """Yield every look at a whiteboard that was seen before, single frames each.

    Nothing where none was planned: references alone show no drift.
    """
    checks = [frame for frame in session.frames if frame.kind == "check"]
    if not checks:
        return
    first = [f for f in references_of(session).get((0, "white"), ()) if f.id in session.stored]
    for frame in [*first, *checks]:
        mean = mean_of(session, [frame])
        dark_dn = boards.dark_at(mean.exposure_s).mean_dn
        yield check_of(mean, frame.bench.masks_in, dark_dn, channels)


def sensor_pairs(session: Session) -> tuple[list[Pair], Iterator[Pair]]:
    """Return pairs of darks, and of white references without masks, of every exposure that has two.

    References are those of the first shot, and the checks without masks.

    Raises AppError where that is fewer than two dark and four lit exposures.
    """
    again = (f for f in session.frames if f.kind == "check" and not f.bench.masks_in)
    whites = [*references_of(session).get((0, "white"), ()), *again]
    darks, flats = (_by_exposure(session, frames) for frames in (darks_of(session), whites))
    if len(darks) < 2 or len(flats) < 4:
        raise AppError(
            f"{session.folder}: calibrating the sensor needs two darks at each of two exposures "
            f"at least, and two references at each of four (it has {len(darks)} and {len(flats)})",
            "plan-whiteboards",
        )

    def pairs(groups: Mapping[float, list[PlannedFrame]]) -> Iterator[Pair]:
        for exposure_s, frames in groups.items():
            first, second = (frame.mosaic for frame in decoded(session, frames[:2]))
            yield Pair(exposure_s, first, second)

    return list(pairs(darks)), pairs(flats)


def _by_exposure(
    session: Session, frames: Iterable[PlannedFrame]
) -> dict[float, list[PlannedFrame]]:
    """Return the frames of every exposure that has two at least, shortest first."""
    groups: dict[float, list[PlannedFrame]] = defaultdict(list)
    for frame in frames:
        groups[exposure_of(session, frame)].append(frame)
    return {exposure_s: some for exposure_s, some in sorted(groups.items()) if len(some) > 1}

"""Frames of a session: readings of its shots, or of its film frame by frame."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from emmc_rig.calibration.scale import Scale
from emmc_rig.errors import AppError
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.session.board_sets import decoded, taken_shots
from emmc_rig.session.journal import FilmEntry, FrameEntry, of_kind
from emmc_rig.session.measured_psi import session_scale
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

SHOWN_FAULTS = 5
SAME_EXPOSURE = 0.01
"""By how much the exposures of a film's frames may differ: by less than cameras state them."""
EVERY = range(sys.maxsize)
"""All places of a film."""


def shot_frames(session: Session) -> dict[int, list[PlannedFrame]]:
    """Return the frames of each shot of the scene that is needed, film excepted: see `film_frames`.

    Those of a shot are its bracket and repeats.
    """
    shots: dict[int, list[PlannedFrame]] = defaultdict(list)
    for frame in session.needed:
        if frame.is_still_shot:
            shots[frame.bench.shot].append(frame)
    return dict(sorted(shots.items()))


def shot_readings(session: Session, scale: Scale) -> Frames:
    """Return the readings of the shots of a scale; one bracket is in memory at a time.

    Raises AppError or CalibrationError.
    """
    frames = shot_frames(session)
    return scale.frames(lambda shot: list(decoded(session, frames[shot])))


@dataclass(frozen=True, eq=False)
class FilmPlace:
    """When a frame of a film was exposed.

    place: in time, from 0; places that were dropped are left out. time_s: seconds from the film's
    first frame; what passed between two segments is not known, and counts as one period for each
    place. segment: within one, time went on without a break. planned, entry: the frame of the plan,
    and its line of the journal.
    """

    place: int
    time_s: float
    segment: int
    planned: PlannedFrame
    entry: FrameEntry

    @property
    def shot(self) -> int:
        """Number of the camera's shot."""
        return self.planned.bench.shot


def film_places(session: Session) -> list[FilmPlace]:
    """Return when the frames of a session's film were exposed, in the order of time.

    Raises AppError naming frames that are out of order, doubled, exposed unlike the first, or whose
    mask did not step.
    """
    film = _film(session)
    if not film:
        raise AppError(f"{session.folder}: holds no film; its plan needs `film: {{frames, rate}}`")
    if faults := list(_film_faults(film)):
        shown = "; ".join(faults[:SHOWN_FAULTS]) + ("; ..." if len(faults) > SHOWN_FAULTS else "")
        raise AppError(f"{session.folder}: no film to reconstruct: {shown}")
    rates = {begun.segment: begun.rate_hz for begun in of_kind(session.journal.entries, FilmEntry)}
    places: list[FilmPlace] = []
    segment, began_s, time_s, place = -1, 0.0, 0.0, 0
    for frame, entry in film:
        assert frame.film is not None
        assert entry.segment is not None
        assert entry.film_s is not None
        if entry.segment != segment:
            segment = entry.segment
            began_s = time_s + (frame.film - place) / rates[segment] - entry.film_s
        time_s, place = began_s + entry.film_s, frame.film
        places.append(FilmPlace(place, time_s, segment, frame, entry))
    return places


def film_frames(
    session: Session, scale: Scale, only: Container[int] = EVERY
) -> Iterator[tuple[FilmPlace, Frames]]:
    """Yield the frames of a session's film in the order of time, each of one shot.

    One frame is in memory at a time. scale: of all shots of the plan. only: places to yield
    (default: all). Raises AppError, before the first frame, as `film_places`; later for a frame
    that shows the same as the frame before it; CalibrationError.
    """
    before = np.zeros(0)
    for at in film_places(session):
        # The frame before a wanted one is decoded, too, to be compared with.
        if at.place not in only and at.place + 1 not in only:
            continue
        (raw,) = decoded(session, [at.planned])
        if np.array_equal(raw.mosaic, before):
            raise AppError(f"{session.folder}: {at.entry.id} shows the same as the frame before it")
        before = raw.mosaic
        if at.place in only:
            frames = scale.frames(lambda shot, raw=raw: [raw], [at.shot])
            exposures = (replace(frames.exposures[0], time_s=at.time_s),)
            yield at, replace(frames, exposures=exposures)


def _film(session: Session) -> list[tuple[PlannedFrame, FrameEntry]]:
    """Return the frames of a film that are stored, and their lines, in the order of time."""
    film = [frame for frame in session.frames if frame.film is not None]
    film.sort(key=lambda frame: frame.film or 0)
    return [(frame, session.stored[frame.id]) for frame in film if frame.id in session.stored]


def _film_faults(film: Sequence[tuple[PlannedFrame, FrameEntry]]) -> Iterator[str]:
    """Yield what is wrong with the frames of a film, as their lines say."""
    first, seen = film[0][1], dict[tuple[int | None, str], str]()
    before = first
    for frame, entry in film:
        if entry is not first and _moment(entry) <= _moment(before):
            yield f"{frame.id} was not exposed after {before.id}: out of order"
        numbers = [entry.camera_sha256 or entry.sha256]
        if block := entry.metadata.get("block_id"):
            numbers.append(f"number {block}")
        for number in numbers:
            twin = seen.setdefault((entry.segment, number), frame.id)
            if twin != frame.id:
                yield f"{frame.id} is {twin} again: doubled"
                break
        exposed, alike = (entry.exposure_s, entry.gain), (first.exposure_s, first.gain)
        if not np.allclose(exposed, alike, rtol=SAME_EXPOSURE):
            yield f"{frame.id} was exposed for {entry.exposure_s:g} s, not {first.exposure_s:g} s"
        for axis, um in entry.read_um.items():
            there_um = entry.commanded_um.get(axis, um)
            left_um = before.commanded_um.get(axis, there_um)
            if abs(um - there_um) > abs(um - left_um):
                yield f"{frame.id}: {axis} did not step, it read {um:g} um, not {there_um:g} um"
        before = entry


def _moment(entry: FrameEntry) -> tuple[int, float]:
    """Return by what the frames of a film are ordered: segment, and time within it."""
    if entry.segment is None or entry.film_s is None:
        raise AppError(f"{entry.id}: its line in the journal does not say when it was exposed")
    return entry.segment, entry.film_s


def session_frames(
    session: Session, scale: Scale | None = None, place: int | None = None
) -> tuple[Psi, Frames]:
    """Return Psi and the readings of the shots that a session needs, or of one frame of its film.

    scale: of the shots of the plan (default: see `session_scale`). place: of a film's frame, by its
    place in time from 0. Raises AppError, as `film_frames` and for a place without a frame, or
    CalibrationError.
    """
    if place is None and not shot_frames(session) and _film(session):
        raise AppError(
            f"{session.folder}: holds a film, whose frames are no shots of one light field: "
            "name one of them",
            "name-frame",
        )
    scale = session_scale(session) if scale is None else scale
    if place is None:
        scale = scale.of_shots(taken_shots(session))
        return scale.psi, shot_readings(session, scale)
    for at, frames in film_frames(session, scale, [place]):
        return scale.of_shots([at.shot]).psi, frames
    raise AppError(f"{session.folder}: no frame {place}; frames are counted from 0")

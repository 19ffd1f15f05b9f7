"""Normalised readings of a session's shots: brackets fused, one frame in memory at a time."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.bracket import LinearFrame, fuse
from calibration.frames import MeanFrame, SensorGain
from emmc_rig.errors import AppError
from emmc_rig.model.camera import json_of_shots
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.session.frame_means import camera_of, decoded
from emmc_rig.session.journal import FilmEntry, FrameEntry, of_kind
from emmc_rig.session.measured_psi import Scale, session_scale
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

SHOWN_FAULTS = 5
SAME_EXPOSURE = 0.01
"""By how much the exposures of a film's frames may differ: by less than cameras state them."""
EVERY = range(sys.maxsize)
"""All places of a film."""


@dataclass(frozen=True, eq=False)
class SessionReadings:
    """What was captured, normalised as Psi is, all (shot, y, x).

    readings: see `Frames`. variance: of the readings; infinite where not usable.
    """

    psi: ImagingMatrix
    readings: NDArray[np.float32]
    variance: NDArray[np.float32]
    usable: NDArray[np.bool_]

    @property
    def noise_sigma(self) -> float:
        """Root mean variance of the usable readings, which solvers take as their typical noise."""
        usable = self.variance[self.usable]
        return float(np.sqrt(np.mean(usable, dtype=np.float64))) if usable.size else 0.0


def shot_frames(session: Session) -> dict[int, list[PlannedFrame]]:
    """Return the frames of each shot of the scene that is needed, film excepted: see `film_frames`.

    Those of a shot are its bracket and repeats.
    """
    shots: dict[int, list[PlannedFrame]] = defaultdict(list)
    for frame in session.needed:
        if frame.is_still_shot:
            shots[frame.bench.shot].append(frame)
    return dict(sorted(shots.items()))


def fused_shot(
    session: Session,
    frames: list[PlannedFrame],
    darks: Sequence[MeanFrame],
    gain: SensorGain,
) -> LinearFrame:
    """Return a shot's bracket as one linear frame, at a gain of 1."""
    mosaics, exposures_s, white_dn = [], [], 0
    for frame, exposure_s in decoded(session, frames):
        mosaics.append(frame.mosaic)
        exposures_s.append(exposure_s)
        white_dn = frame.white_level_dn
    amplified = {frame.gain for frame in frames}
    if len(amplified) > 1:
        raise AppError(f"{session.folder}: the gain differs within one shot; plan it alike")
    factor = amplified.pop()
    if factor == 1:
        return fuse(mosaics, exposures_s, darks, gain, white_dn)
    # The signal above the black grows with the gain, its shot noise per DN too.
    amplified_gain = SensorGain(
        gain.gain_dn_per_electron * factor, gain.dark_variance_dn2 * factor**2
    )
    black = np.mean(session.stored[frames[0].id].black_level_dn)
    lifted = [
        replace(
            dark,
            mean_dn=(black + factor * (dark.mean_dn - black)).astype(np.float32),
            variance_dn2=dark.variance_dn2 * factor**2,
            extra_variance_dn2=dark.extra_variance_dn2 * factor**2,
        )
        for dark in darks
    ]
    fused = fuse(mosaics, exposures_s, lifted, amplified_gain, white_dn)
    return LinearFrame(fused.dn_per_s / factor, fused.variance / factor**2, fused.usable)


def taken_shots(session: Session) -> tuple[int, ...]:
    """Return the shots of the scene that the session needs, by their place in the plan."""
    return tuple(sorted({f.bench.shot for f in session.needed if f.kind == "shot"}))


def scaled_readings(session: Session, scale: Scale, shots: Sequence[int]) -> SessionReadings:
    """Return what some shots read, and their Psi, in the order given."""
    whole = list(shots) == list(range(scale.psi.shots))
    psi = (
        scale.psi if whole else scale.psi.of_shots(shots, json_of_shots(camera_of(session), shots))
    )
    frames = shot_frames(session)
    readings = np.empty(psi.frames_shape, dtype=np.float32)
    variance = np.empty(psi.frames_shape, dtype=np.float32)
    usable = np.empty(psi.frames_shape, dtype=bool)
    for place, shot in enumerate(shots):
        linear = fused_shot(session, frames[shot], scale.darks, scale.gain)
        readings[place], variance[place], usable[place] = _normalised(linear, scale, shot)
    return SessionReadings(psi, readings, variance, usable)


def _normalised(linear: LinearFrame, scale: Scale, shot: int) -> tuple[NDArray, NDArray, NDArray]:
    """Return a shot's readings, their variance and which are usable, each (y, x)."""
    seen = scale.white_dn_per_s[shot] > 0
    white = np.where(seen, scale.white_dn_per_s[shot], 1.0)
    # What a pixel that is not to be used reads says nothing, not even how much at least.
    readings = linear.dn_per_s / white * (seen & scale.good)
    return readings, linear.variance / white**2, linear.usable & seen & scale.good


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
        """Which of Psi's shots it is."""
        return self.planned.bench.shot


@dataclass(frozen=True, eq=False)
class FilmFrame(FilmPlace):
    """One frame of a film, normalised as Psi is; readings, deviation, usable: (1, y, x).

    deviation: of the readings, infinite where not usable.
    """

    readings: NDArray[np.float32]
    deviation: NDArray[np.float32]
    usable: NDArray[np.bool_]


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
    rates = {one.segment: one.rate_hz for one in of_kind(session.journal.entries, FilmEntry)}
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
    session: Session, scale: Scale | None = None, only: Container[int] = EVERY
) -> Iterator[FilmFrame]:
    """Yield the film that a session holds, frame by frame in the order of time.

    One frame is in memory at a time. scale: what `session_scale` returns, which it is by default.
    only: places to yield (default: all). Raises AppError, before the first frame, as `film_places`;
    later for one that shows the same as the frame before it; CalibrationError.
    """
    places = film_places(session)
    scale = session_scale(session) if scale is None else scale
    before = np.zeros(0)
    for at in places:
        # One before what is wanted is read, too, to be compared with.
        if at.place not in only and at.place + 1 not in only:
            continue
        linear = fused_shot(session, [at.planned], scale.darks, scale.gain)
        if np.array_equal(linear.dn_per_s, before):
            raise AppError(f"{session.folder}: {at.entry.id} shows the same as the frame before it")
        before = linear.dn_per_s
        if at.place in only:
            readings, variance, usable = _normalised(linear, scale, at.shot)
            yield FilmFrame(
                **vars(at),
                readings=readings[np.newaxis].astype(np.float32),
                deviation=np.sqrt(variance)[np.newaxis].astype(np.float32),
                usable=usable[np.newaxis],
            )


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


def session_readings(session: Session) -> SessionReadings:
    """Return what the shots read that a session needs, by the Psi of its whiteboards.

    Raises AppError, as for a film, or CalibrationError.
    """
    if not shot_frames(session) and _film(session):
        raise AppError(
            f"{session.folder}: holds a film, whose frames are no shots of one light field: "
            "choose one, such as --frame 0"
        )
    return scaled_readings(session, session_scale(session), taken_shots(session))


def film_readings(session: Session, place: int) -> SessionReadings:
    """Return what one frame of a film reads, by its place in time, as of a capture of one shot.

    Raises AppError, as `film_frames` and for a place without a frame, or CalibrationError.
    """
    scale = session_scale(session)
    for one in film_frames(session, scale, [place]):
        psi = scale.psi.of_shots([one.shot], json_of_shots(camera_of(session), [one.shot]))
        return SessionReadings(psi, one.readings, np.square(one.deviation), one.usable)
    raise AppError(f"{session.folder}: no frame {place}; frames are counted from 0")

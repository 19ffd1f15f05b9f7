"""Psi and normalised readings from the whiteboards and shots of a session.

Frames are decoded one at a time and averaged or fused as they come.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.boards import BoardFrame, BoardSet, channels_of
from calibration.bracket import LinearFrame, fuse
from calibration.frames import MeanFrame, SensorGain, average, before_and_after
from calibration.levels import Check, check_of
from calibration.routes import Outcome, calibrate
from calibration.sensor import Pair
from calibration.whiteboard import Calibration, NewArray, Whiteboards, in_memory, measure_psi
from drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, build_imaging_matrix, pixel_light, psi_layout
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import validated
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import Entry
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

Array = NDArray[np.floating]


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


@dataclass(frozen=True, eq=False)
class Scale:
    """What turns a session's frames into readings, of every planned shot, taken or not.

    white_dn_per_s: (shot, y, x), what a reading of 1 gives. darks: of one exposure or
    more. good: (y, x), pixels to use at all.
    """

    psi: ImagingMatrix
    white_dn_per_s: NDArray[np.floating]
    darks: tuple[MeanFrame, ...]
    gain: SensorGain
    good: NDArray[np.bool_]


def camera_of(session: Session) -> Camera:
    """Return the camera as planned."""
    return validated(Camera, session.camera, str(session.folder), AppError)


def decoded(session: Session, frames: Iterable[PlannedFrame]) -> Iterator[tuple[RawFrame, float]]:
    """Yield frames and their exposures in seconds; raises AppError for one that is not good."""
    for frame in frames:
        entry = session.stored.get(frame.id)
        data = session.read(frame.id)
        assert entry is not None
        yield decode_frame(data, entry), float(entry["exposure_s"])


def whiteboards(session: Session) -> Whiteboards:
    """Return the averages that `calibration.whiteboard.measure_psi` takes.

    Raises AppError where the plan has no whiteboards, no darks, or they were not all captured.
    """
    references = _references(session)
    pinholes: dict[tuple[int, int, int, str], list[PlannedFrame]] = defaultdict(list)
    for frame in session.frames:
        shot, lamp = frame.bench.shot, frame.bench.lamp
        if frame.kind == "whiteboard" and frame.view is not None:
            pinholes[shot, *frame.view, lamp].append(frame)
    if not references:
        raise AppError(f"{session.folder}: its plan has no whiteboards")
    return Whiteboards(
        mean_dark(session),
        {key: _mean(session, frames) for key, frames in references.items()},
        {key: _mean(session, frames) for key, frames in pinholes.items()},
    )


@dataclass(frozen=True, eq=False)
class SessionBoards:
    """A session's whiteboards by what takes them; None where the plan has no such frames.

    fit: for the parametric routes, those of the open aperture, and those through the pinhole as
    well. pinholes: for the free route. held_out: seen by no fit. turned: by the degrees that the
    board was turned.
    """

    fit: BoardSet | None
    pinholes: BoardSet | None
    held_out: BoardSet | None
    turned: Mapping[float, BoardSet]


def board_sets(session: Session, channels: NDArray[np.uint8]) -> SessionBoards:
    """Return a session's whiteboards; channels: (y, x), the colour each pixel sees (3: all)."""
    groups: dict[tuple[str, str], list[PlannedFrame]] = defaultdict(list)
    for frame in session.frames:
        if frame.kind in ("open", "held-out", "whiteboard", "turned"):
            groups[frame.kind, frame.id.rpartition("-r")[0]].append(frame)
    if not groups:
        raise AppError(f"{session.folder}: its plan has no whiteboards")
    found: dict[str, list[BoardFrame]] = defaultdict(list)
    turned: dict[float, dict[bool, MeanFrame]] = defaultdict(dict)
    for (kind, _), frames in groups.items():
        bench = frames[0].bench
        if kind == "turned":
            turned[bench.board_turn_deg][bench.masks_in] = _mean(session, frames)
            continue
        alike = _alike(session, frames)
        stage_um = _stage_um(frames[0])
        view, window = frames[0].view, frames[0].window
        read = partial(_mean, session, alike)
        found[kind].append(
            BoardFrame(read, len(alike), stage_um, bench.shot, view, bench.lamp, window)
        )
    references = {key: _mean(session, frames) for key, frames in _references(session).items()}
    # The white lamp's first: the sensor's gain follows from it.
    references = dict(sorted(references.items(), key=lambda item: item[0][1] != "white"))
    darks = session_darks(session, of_shots=False)
    every = BoardSet(darks, references, ())
    checks = tuple(_checks(session, every, channels))
    few = [*found["open"], *(found["whiteboard"] if found["open"] else ())]
    fit, free, held_out = (
        replace(every, frames=tuple(frames), checks=checks) if frames else None
        for frames in (few, found["whiteboard"], found["held-out"])
    )
    own_um = next((one.stage_um for one in found["open"]), (0.0, 0.0))
    boards = {
        turn_deg: BoardSet(darks, {(0, "white"): by[False]}, (BoardFrame.held(by[True], own_um),))
        for turn_deg, by in turned.items()
    }
    return SessionBoards(fit, free, held_out, boards)


def _checks(session: Session, boards: BoardSet, channels: NDArray[np.uint8]) -> Iterator[Check]:
    """Yield every look at a whiteboard that was seen before, single frames each.

    Nothing where none was planned: references alone show no drift.
    """
    checks = [frame for frame in session.frames if frame.kind == "check"]
    if not checks:
        return
    first = [f for f in _references(session).get((0, "white"), ()) if f.id in session.stored]
    for frame in [*first, *checks]:
        mean = _mean(session, [frame])
        dark_dn = boards.dark_at(mean.exposure_s).mean_dn
        yield check_of(mean, frame.bench.masks_in, dark_dn, channels)


def stage_frames(session: Session) -> tuple[list[PlannedFrame], BoardSet]:
    """Return each single frame of the open aperture with the masks in, planned and as a whiteboard.

    Of the first shot, under the white lamp: each shows where the mask stage stood.
    """
    planned = [
        frame
        for frame in session.frames
        if frame.kind in ("open", "held-out", "check")
        and frame.bench.masks_in
        and frame.bench.shot == 0
        and frame.bench.lamp == "white"
    ]
    white = _references(session).get((0, "white"))
    references = {} if white is None else {(0, "white"): _mean(session, white)}
    boards = tuple(
        BoardFrame(partial(_mean, session, [one]), 1, _stage_um(one), window=one.window)
        for one in planned
    )
    return planned, BoardSet(session_darks(session, of_shots=False), references, boards)


def _stage_um(frame: PlannedFrame) -> tuple[float, float]:
    """Return where the mask stage was sent, from where it is centred, x and y."""
    offsets = frame.bench.offsets_um
    return offsets.get("mask_x", 0.0), offsets.get("mask_y", 0.0)


def _references(session: Session) -> dict[tuple[int, str], list[PlannedFrame]]:
    found: dict[tuple[int, str], list[PlannedFrame]] = defaultdict(list)
    for frame in session.frames:
        if frame.kind == "reference":
            found[frame.bench.shot, frame.bench.lamp].append(frame)
    return found


def session_darks(session: Session, of_shots: bool = True) -> tuple[MeanFrame, ...]:
    """Return the darks of each exposure; those taken before and after the whiteboards as one.

    of_shots: those too that were taken for the shots of the scene.
    """
    groups: dict[tuple[float, int], list[PlannedFrame]] = defaultdict(list)
    for frame in _darks(session):
        if frame.is_dark_of_shots and not of_shots:
            continue
        groups[_exposure_s(session, frame), frame.part].append(frame)
    found: dict[float, MeanFrame] = {}
    for (exposure_s, _), frames in sorted(groups.items()):
        mean = _mean(session, frames)
        earlier = found.get(exposure_s)
        found[exposure_s] = mean if earlier is None else before_and_after(earlier, mean)
    return tuple(found.values())


def sensor_pairs(session: Session) -> tuple[list[Pair], Iterator[Pair]]:
    """Return pairs of darks, and of white references without masks, of every exposure that has two.

    Raises AppError where that is fewer than two dark and four lit exposures.
    """
    darks, flats = (_by_exposure(session, frames) for frames in (_darks(session), _flats(session)))
    if len(darks) < 2 or len(flats) < 4:
        raise AppError(
            f"{session.folder}: --sensor takes two darks at each of two exposures at least, and "
            f"two references at each of four (it has {len(darks)} and {len(flats)}): "
            "`emmc-rig calibrate --plan` writes a plan that has, unless response is left out"
        )

    def pairs(groups: Mapping[float, list[PlannedFrame]]) -> Iterator[Pair]:
        for exposure_s, frames in groups.items():
            first, second = (frame.mosaic for frame, _ in decoded(session, frames[:2]))
            yield Pair(exposure_s, first, second)

    return list(pairs(darks)), pairs(flats)


def _flats(session: Session) -> list[PlannedFrame]:
    """Return the white references of the first shot, and those seen again without masks."""
    again = (f for f in session.frames if f.kind == "check" and not f.bench.masks_in)
    return [*_references(session).get((0, "white"), ()), *again]


def _by_exposure(
    session: Session, frames: Iterable[PlannedFrame]
) -> dict[float, list[PlannedFrame]]:
    """Return the frames of every exposure that has two at least, shortest first."""
    groups: dict[float, list[PlannedFrame]] = defaultdict(list)
    for frame in frames:
        groups[_exposure_s(session, frame)].append(frame)
    return {exposure_s: some for exposure_s, some in sorted(groups.items()) if len(some) > 1}


def mean_dark(session: Session) -> MeanFrame:
    """Return the average of the dark frames of the shortest exposure; raises AppError."""
    return min(session_darks(session, of_shots=False), key=lambda frame: frame.exposure_s)


def _darks(session: Session) -> list[PlannedFrame]:
    darks = [frame for frame in session.frames if frame.kind == "dark"]
    if not darks:
        raise AppError(f"{session.folder}: its plan has no darks")
    return darks


def _frame_shape(session: Session) -> tuple[int, int]:
    """Return rows and columns of the frames captured; raises AppError where no dark was."""
    first = _darks(session)[0]
    _exposure_s(session, first)
    rows, columns = session.stored[first.id]["shape"]
    return rows, columns


def _exposure_s(session: Session, frame: PlannedFrame) -> float:
    """Return how long a frame was exposed; raises AppError where it was not captured yet."""
    entry = session.stored.get(frame.id)
    if entry is None:
        raise AppError(f"{session.folder}: frame {frame.id} was not captured yet; resume it")
    return float(entry["exposure_s"])


def _taken_s(session: Session, entry: Entry) -> float:
    """Return when a frame was taken, in seconds of the session.

    The clock of a run may begin anew with it: then the run follows the one before.
    """
    times: dict[int, list[float]] = defaultdict(list)
    for one in session.stored.values():
        times[one.get("run", 0)].append(one.get("host_time_s") or 0.0)
    offset = latest = 0.0
    for run in sorted(times):
        offset = max(0.0, latest - min(times[run])) if run != min(times) else 0.0
        latest = max(times[run]) + offset
        if run == entry.get("run", 0):
            break
    return (entry.get("host_time_s") or 0.0) + offset


def _alike(session: Session, frames: list[PlannedFrame]) -> list[PlannedFrame]:
    """Return the most repeats that are alike in exposure: an amendment of the plan may change it.

    Raises AppError where one was not captured yet.
    """
    exposures_s = [_exposure_s(session, frame) for frame in frames]
    (exposure_s, _), *_ = Counter(exposures_s).most_common()
    return [one for one, own_s in zip(frames, exposures_s, strict=True) if own_s == exposure_s]


def _mean(session: Session, frames: list[PlannedFrame]) -> MeanFrame:
    alike = _alike(session, frames)
    entries = [session.stored[frame.id] for frame in alike]
    mosaics = (frame.mosaic for frame, _ in decoded(session, alike))
    taken_s = float(np.mean([_taken_s(session, entry) for entry in entries]))
    first, what, lit = entries[0], alike[0].id, alike[0].kind != "dark"
    return average(mosaics, first["exposure_s"], first["white_level_dn"], what, taken_s, lit)


def shot_frames(session: Session) -> dict[int, list[PlannedFrame]]:
    """Return the frames of each shot of the scene that is needed: its bracket and repeats."""
    shots: dict[int, list[PlannedFrame]] = defaultdict(list)
    for frame in session.needed:
        if frame.kind == "shot":
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
    black = np.mean(session.stored[frames[0].id]["black_level_dn"])
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


def session_calibration(session: Session) -> Calibration:
    """Return Psi measured from the session's whiteboards; raises AppError or CalibrationError.

    Whiteboards of the open aperture are fitted, and tested on those held out; where there are
    none, every coefficient is measured through the pinhole.
    """
    if any(frame.kind == "open" for frame in session.frames):
        return session_outcome(session).calibration
    boards = whiteboards(session)
    return measure_psi(boards, designed_psi(session, boards.dark))


def session_outcome(
    session: Session,
    routes: Sequence[str] | None = None,
    on_stage: Callable[[str], None] = lambda name: None,
    empty: NewArray = in_memory,
    on_plane: Callable[[str], None] = lambda what: None,
) -> Outcome:
    """Return Psi by the routes named, with the choice among them.

    By default by every route that the session has the whiteboards for. empty, on_plane: of the
    free route, see `measure_psi`.

    Raises AppError where the session has not what a route needs, or CalibrationError.
    """
    camera = camera_of(session)
    k = camera.sensor.binning
    rows, columns = _frame_shape(session)
    size = k * rows, k * columns
    # Only where a pixel has several samples does the design say more than its layout.
    design = psi_layout(camera, size) if k == 1 else build_imaging_matrix(camera, size)
    layout = psi_layout(camera, size)
    boards = board_sets(session, channels_of(layout))
    few, pinholes, held_out = boards.fit, boards.pinholes, boards.held_out
    if routes is None:
        routes = ("parametric", "mixed") if few is not None else ("free",)
        if few is not None and _opens_every_view(camera, pinholes):
            routes = ("parametric", "mixed", "free", "combined")
    wanting = [
        what
        for needed, there, what in (
            ({"parametric", "mixed"} & set(routes), few, "open whiteboards"),
            ("free" in routes, pinholes, "whiteboards through the pinhole"),
            (True, held_out, "whiteboards held out (`held_out: true`)"),
        )
        if needed and there is None
    ]
    if wanting:
        raise AppError(
            f"{session.folder}: its plan has no {' and no '.join(wanting)}, which this route "
            "needs; `emmc-rig calibrate --plan` writes a plan that has"
        )
    assert held_out is not None
    return calibrate(
        camera,
        design,
        routes,
        held_out,
        few if set(routes) - {"free"} else None,
        pinholes,
        on_stage=on_stage,
        turned=boards.turned,
        empty=empty,
        on_plane=on_plane,
    )


def _opens_every_view(camera: Camera, pinholes: BoardSet | None) -> bool:
    """Return whether whiteboards show every view of every shot, as the free route takes them."""
    if pinholes is None:
        return False
    opened = {(one.shot, one.pinhole) for one in pinholes.frames}
    shots = range(len(camera.shots))
    return opened >= {(shot, view) for shot in shots for view in np.ndindex(camera.views)}


def taken_shots(session: Session) -> tuple[int, ...]:
    """Return the shots of the scene that the session needs, by their place in the plan."""
    return tuple(sorted({f.bench.shot for f in session.needed if f.kind == "shot"}))


def camera_json_of(session: Session, shots: Sequence[int]) -> str:
    """Return the camera with some of its shots alone, as `ImagingMatrix.camera_json`.

    "" where no camera is made of them: where a mask shows another pattern in every shot.
    """
    camera = camera_of(session)
    count = len(camera.shots)
    if any(mask.pattern.frame_count(count) > 1 for mask in camera.masks.values()):
        return ""
    exposures_s = camera.exposures_s()
    chosen = [
        camera.shots[shot].model_copy(update={"exposure_s": float(exposures_s[shot])})
        for shot in shots
    ]
    return camera.model_copy(update={"shots": tuple(chosen)}).model_dump_json()


def session_scale(session: Session) -> Scale:
    """Return the calibration by the session's whiteboards and darks.

    Without whiteboards it is the designed Psi and the camera's own noise model, which is coarser.
    Raises AppError or CalibrationError.
    """
    darks, dark = session_darks(session), mean_dark(session)
    if any(frame.kind in ("whiteboard", "open") for frame in session.frames):
        known = session_calibration(session)
        good = np.ones(dark.mean_dn.shape, dtype=bool) if known.good is None else known.good
        return Scale(known.psi, known.white_dn_per_s, darks, known.gain, good)
    camera = camera_of(session)
    noise = camera.sensor.noise
    psi = designed_psi(session, dark)
    per_second = noise.gain_dn_per_electron * noise.electrons_per_s
    white = per_second * pixel_light(camera, psi.size)
    gain = SensorGain(noise.gain_dn_per_electron, dark.variance_dn2)
    return Scale(psi, white, darks, gain, np.ones(dark.mean_dn.shape, dtype=bool))


def scaled_readings(session: Session, scale: Scale, shots: Sequence[int]) -> SessionReadings:
    """Return what some shots read, and their Psi, in the order given."""
    whole = list(shots) == list(range(scale.psi.shots))
    psi = scale.psi if whole else scale.psi.of_shots(shots, camera_json_of(session, shots))
    frames = shot_frames(session)
    readings = np.empty(psi.frames_shape, dtype=np.float32)
    variance = np.empty(psi.frames_shape, dtype=np.float32)
    usable = np.empty(psi.frames_shape, dtype=bool)
    for place, shot in enumerate(shots):
        linear = fused_shot(session, frames[shot], scale.darks, scale.gain)
        seen = scale.white_dn_per_s[shot] > 0
        white = np.where(seen, scale.white_dn_per_s[shot], 1.0)
        readings[place] = linear.dn_per_s / white
        variance[place] = linear.variance / white**2
        usable[place] = linear.usable & seen & scale.good
        # What a pixel that is not to be used reads says nothing, not even how much at least.
        readings[place] *= seen & scale.good
    return SessionReadings(psi, readings, variance, usable)


def session_readings(session: Session) -> SessionReadings:
    """Return what the shots read that a session needs, by the Psi of its whiteboards.

    Raises AppError or CalibrationError.
    """
    return scaled_readings(session, session_scale(session), taken_shots(session))


def designed_psi(session: Session, frame: MeanFrame) -> ImagingMatrix:
    """Return Psi as the camera is designed, at the size of the frames captured."""
    camera = camera_of(session)
    k = camera.sensor.binning
    rows, columns = frame.mean_dn.shape
    return build_imaging_matrix(camera, (rows * k, columns * k))

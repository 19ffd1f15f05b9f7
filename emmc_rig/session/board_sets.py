"""A session's whiteboards by what takes them: fits, the free route, judges, stage and sensor."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calibration.boards import BoardFrame, BoardSet
from calibration.frames import MeanFrame
from calibration.levels import Check, check_of
from calibration.sensor import Pair
from emmc_rig.errors import AppError
from emmc_rig.session.frame_means import (
    alike_frames,
    darks_of,
    decoded,
    exposure_of,
    mean_of,
    references_of,
    session_darks,
    stage_um_of,
)
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session


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
            turned[bench.board_turn_deg][bench.masks_in] = mean_of(session, frames)
            continue
        alike = alike_frames(session, frames)
        stage_um = stage_um_of(frames[0])
        view, window = frames[0].view, frames[0].window
        read = partial(mean_of, session, alike)
        found[kind].append(
            BoardFrame(read, len(alike), stage_um, bench.shot, view, bench.lamp, window)
        )
    references = {key: mean_of(session, frames) for key, frames in references_of(session).items()}
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
    first = [f for f in references_of(session).get((0, "white"), ()) if f.id in session.stored]
    for frame in [*first, *checks]:
        mean = mean_of(session, [frame])
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
    white = references_of(session).get((0, "white"))
    references = {} if white is None else {(0, "white"): mean_of(session, white)}
    boards = tuple(
        BoardFrame(partial(mean_of, session, [one]), 1, stage_um_of(one), window=one.window)
        for one in planned
    )
    return planned, BoardSet(session_darks(session, of_shots=False), references, boards)


def sensor_pairs(session: Session) -> tuple[list[Pair], Iterator[Pair]]:
    """Return pairs of darks, and of white references without masks, of every exposure that has two.

    Raises AppError where that is fewer than two dark and four lit exposures.
    """
    darks, flats = (
        _by_exposure(session, frames) for frames in (darks_of(session), _flats(session))
    )
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
    return [*references_of(session).get((0, "white"), ()), *again]


def _by_exposure(
    session: Session, frames: Iterable[PlannedFrame]
) -> dict[float, list[PlannedFrame]]:
    """Return the frames of every exposure that has two at least, shortest first."""
    groups: dict[float, list[PlannedFrame]] = defaultdict(list)
    for frame in frames:
        groups[exposure_of(session, frame)].append(frame)
    return {exposure_s: some for exposure_s, some in sorted(groups.items()) if len(some) > 1}

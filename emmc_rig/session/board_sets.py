"""A session's whiteboards by what takes them: fits, the method free, validation and sensor."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import BoardFrame, BoardSet
from emmc_rig.calibration.levels import Check, check_of
from emmc_rig.calibration.sensor import Pair
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
from emmc_rig.session.planned import VALIDATION, PlannedFrame
from emmc_rig.session.session import Session


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

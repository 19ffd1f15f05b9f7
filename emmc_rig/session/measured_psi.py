"""Psi as a session's whiteboards measure it, and what turns its frames into readings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.boards import BoardSet, channels_of
from calibration.frames import MeanFrame, SensorGain
from calibration.routes import Outcome, calibrate
from calibration.whiteboard import Calibration, NewArray, in_memory, measure_psi
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, build_imaging_matrix, pixel_light, psi_layout
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.session.board_sets import SessionBoards, board_sets, whiteboards
from emmc_rig.session.frame_means import (
    camera_of,
    frame_shape,
    mean_dark,
    session_darks,
)
from emmc_rig.session.session import Session


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


def session_calibration(session: Session) -> Calibration:
    """Return Psi measured from the session's whiteboards; raises AppError or CalibrationError.

    Whiteboards of the open aperture are fitted, and tested on those for validation; where there are
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
    """Return Psi by the calibration methods named, with the choice among them.

    By default by every method that the session has the whiteboards for. empty, on_plane: of the
    method free, see `measure_psi`.

    Raises AppError where the session has not what a method needs, or CalibrationError.
    """
    camera, k = camera_of(session), camera_of(session).sensor.binning
    rows, columns = frame_shape(session)
    size = k * rows, k * columns
    boards = board_sets(session, channels_of(psi_layout(camera, size)))
    where = f"{session.folder}: its plan has", "`emmc-rig calibrate --plan` writes a plan that has"
    return boards_outcome(camera, size, boards, where, routes, on_stage, empty, on_plane)


def boards_outcome(
    camera: Camera,
    size: tuple[int, int],
    boards: SessionBoards,
    where: tuple[str, str],
    routes: Sequence[str] | None = None,
    on_stage: Callable[[str], None] = lambda name: None,
    empty: NewArray = in_memory,
    on_plane: Callable[[str], None] = lambda what: None,
) -> Outcome:
    """Return Psi of whiteboards, see `session_outcome`.

    size: rows and columns of the light field. where: the beginning of an error's line, what has not
    the whiteboards that a method needs, and its end, what to do.
    """
    # Only where a pixel has several samples does the design say more than its layout.
    whole = camera.sensor.binning > 1
    design = build_imaging_matrix(camera, size) if whole else psi_layout(camera, size)
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
            (True, held_out, "validation whiteboard (`validation: true`)"),
        )
        if needed and there is None
    ]
    if wanting:
        raise AppError(
            f"{where[0]} no {' and no '.join(wanting)}, which this calibration method needs; "
            f"{where[1]}"
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
    """Return whether whiteboards show every view of every shot, as the method free takes them."""
    if pinholes is None:
        return False
    opened = {(one.shot, one.pinhole) for one in pinholes.frames}
    shots = range(len(camera.shots))
    return opened >= {(shot, view) for shot in shots for view in np.ndindex(camera.views)}


def session_scale(session: Session) -> Scale:
    """Return the calibration by the session's whiteboards and darks.

    Without whiteboards it is the designed Psi and the camera's own noise model, which is coarser.
    Raises AppError or CalibrationError.
    """
    darks, dark = session_darks(session), mean_dark(session)
    if not psi_is_assumed(session):
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


def psi_is_assumed(session: Session) -> bool:
    """Return whether no whiteboard measures Psi, so that it is the camera as described."""
    return not any(frame.kind in ("whiteboard", "open") for frame in session.frames)


def designed_psi(session: Session, frame: MeanFrame) -> ImagingMatrix:
    """Return Psi as the camera is designed, at the size of the frames captured."""
    camera = camera_of(session)
    k = camera.sensor.binning
    rows, columns = frame.mean_dn.shape
    return build_imaging_matrix(camera, (rows * k, columns * k))

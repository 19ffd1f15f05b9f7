"""Psi as a session's whiteboards measure it, and scales: what turns frames into readings.

On the disk Psi is in psi.h5; beside it calibration.h5 holds the rest of the scale.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from emmc_rig.calibration.boards import BoardSet, channels_of
from emmc_rig.calibration.frames import MeanFrame, SensorGain
from emmc_rig.calibration.routes import Outcome, calibrate
from emmc_rig.calibration.scale import MANY, Scale, designed_scale
from emmc_rig.calibration.whiteboard import Calibration, NewArray, in_memory, measure_psi
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, build_imaging_matrix, psi_layout
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import stored_arrays
from emmc_rig.model.sensing import Psi
from emmc_rig.progress import Watcher
from emmc_rig.session.board_sets import (
    SessionBoards,
    board_sets,
    camera_of,
    frame_shape,
    mean_dark,
    session_darks,
    taken_shots,
    whiteboards,
)
from emmc_rig.session.planned import VALIDATION
from emmc_rig.session.session import CALIBRATION, Session
from emmc_rig.store.products import Product, product_digest, read_product
from emmc_rig.store.psi import PSI

CALIBRATION_FILE = "calibration.h5"
DARK_FACTS = tuple(f.name for f in fields(MeanFrame) if f.name != "mean_dn")


def write_scale(file: h5py.File, scale: Scale) -> None:
    """Write all of a scale but Psi into calibration.h5, open for writing."""
    file.attrs["gain_dn_per_electron"] = scale.gain.gain_dn_per_electron
    file.attrs["dark_variance_dn2"] = scale.gain.dark_variance_dn2
    file.attrs["shots"] = scale.shots
    file.attrs["darks"] = json.dumps(
        [{name: getattr(dark, name) for name in DARK_FACTS} for dark in scale.darks]
    )
    file["darks_dn"] = np.stack([dark.mean_dn for dark in scale.darks])
    file["white_dn_per_s"] = scale.white_dn_per_s
    file["good"] = scale.good


def open_scale(place: Path) -> Scale:
    """Return the scale of a folder of `emmc-rig calibrate`, or of the file of a Psi.

    A Psi without calibration.h5 beside it is scaled by its camera's noise model, which is coarser.
    Calibrations of version 0.4 and before hold one dark, as of every exposure. Raises AppError,
    SensingError or ModelError.
    """
    file = place / PSI if place.is_dir() else place
    if not file.is_file():
        raise AppError(f"{place}: no Psi; name a session, the folder of a calibration or psi.h5")
    psi, beside = Psi.load(file), file.parent / CALIBRATION_FILE
    if not beside.is_file():
        return designed_scale(psi)
    with stored_arrays(beside, AppError, "calibrate again") as stored:
        attributes = stored.attributes
        gain = SensorGain(
            float(np.asarray(attributes["gain_dn_per_electron"])),
            float(np.asarray(attributes["dark_variance_dn2"])),
        )
        white = stored.array("white_dn_per_s")
        good = np.ones(white.shape[1:], dtype=bool)
        if "good" in stored:
            good = stored.array("good").astype(bool)
        if "darks" in attributes:
            facts = parse_json(str(attributes["darks"]), str(beside), ValueError)
            means = stored.array("darks_dn")
            # Version 0.4 wrote the covariance with the next row as well.
            darks = tuple(
                MeanFrame(mean, **{**known, "rows_dn2": float(np.ravel(known["rows_dn2"])[0])})
                for mean, known in zip(means, facts, strict=True)
            )
            shots = tuple(int(shot) for shot in np.asarray(attributes["shots"]))
        else:
            darks = (MeanFrame(stored.array("dark_dn"), gain.dark_variance_dn2, MANY, 0.0),)
            shots = ()
    if white.shape != psi.frames_shape or (shots and len(shots) != psi.shots):
        raise AppError(f"{file}: does not fit the {CALIBRATION_FILE} beside it; calibrate again")
    return Scale(psi, white, darks, gain, good, shots)


PSI_PRODUCT = "psi"
SCENE_KINDS = ("shot", "metering")
"""Kinds of frames from which no Psi follows."""


def session_calibration(session: Session) -> Calibration:
    """Return Psi measured from the session's whiteboards; raises AppError or CalibrationError.

    Of pinholes alone, without a whiteboard for validation, every coefficient is measured through
    the pinhole, and nothing judges it.
    """
    if is_judged(session):
        return session_outcome(session).calibration
    boards = whiteboards(session)
    return measure_psi(boards, designed_psi(session, boards.dark))


def session_outcome(
    session: Session,
    routes: Sequence[str] | None = None,
    empty: NewArray = in_memory,
    watcher: Watcher | None = None,
) -> Outcome:
    """Return Psi by the calibration methods named, with the choice among them.

    By default by every method that the session has the whiteboards for. empty: of the
    method free, see `measure_psi`.

    Raises AppError where the session has not what a method needs, or CalibrationError.
    """
    camera, k = camera_of(session), camera_of(session).sensor.binning
    rows, columns = frame_shape(session)
    size = k * rows, k * columns
    boards = board_sets(session, channels_of(psi_layout(camera, size)))
    where = f"{session.folder}: its plan has"
    return boards_outcome(camera, size, boards, where, routes, empty, watcher)


def boards_outcome(
    camera: Camera,
    size: tuple[int, int],
    boards: SessionBoards,
    where: str,
    routes: Sequence[str] | None = None,
    empty: NewArray = in_memory,
    watcher: Watcher | None = None,
) -> Outcome:
    """Return Psi of whiteboards, see `session_outcome`.

    size: rows and columns of the light field. where: the beginning of an error's line, what lacks
    whiteboards that a method needs.
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
            f"{where} no {' and no '.join(wanting)}, which this calibration method needs; "
            "capture them",
            "plan-whiteboards",
        )
    assert held_out is not None
    watcher = watcher or Watcher()
    frames = () if pinholes is None else pinholes.frames
    planes = len({(frame.shot, frame.pinhole, frame.lamp) for frame in frames})
    return calibrate(
        camera,
        design,
        routes,
        held_out,
        few if set(routes) - {"free"} else None,
        pinholes,
        on_stage=lambda name: watcher.begin(name, planes if name == "Psi, free" else None),
        turned=boards.turned,
        empty=empty,
        on_plane=watcher.step,
    )


def _opens_every_view(camera: Camera, pinholes: BoardSet | None) -> bool:
    """Return whether whiteboards show every view in the lens's pupil, in every shot.

    The method free needs them.
    """
    if pinholes is None:
        return False
    opened = {(board.shot, board.pinhole) for board in pinholes.frames}
    shots = range(len(camera.shots))
    views = [(int(v), int(u)) for v, u in np.argwhere(camera.views_measured())]
    return opened >= {(shot, view) for shot in shots for view in views}


def psi_inputs(session: Session) -> dict[str, Any]:
    """Return what the Psi of a session's whiteboards follows from, besides the method: plain data.

    All frames but those of the scene, how the bench stood for them, and the camera as planned.
    """
    stored = session.stored
    return {
        "camera": session.camera,
        "shots": taken_shots(session),
        "frames": [
            {
                **frame.as_dict(),
                "sha256": entry.sha256,
                "exposed_s": entry.exposure_s,
                "black_level_dn": entry.black_level_dn,
                "white_level_dn": entry.white_level_dn,
                "deviation_um": entry.deviation_um,
                "time_s": entry.host_time_s,
            }
            for frame in session.frames
            if frame.kind not in SCENE_KINDS and (entry := stored.get(frame.id)) is not None
        ],
    }


def stored_calibration(session: Session) -> tuple[Product | None, str]:
    """Return what the calibration stored in a session follows from, and a sentence that names it.

    Returns None and an empty sentence for a session without a calibration; None and the reason for
    a calibration by other frames, by an earlier plan or by another version of the program.
    """
    folder = session.folder / CALIBRATION
    if not (folder / PSI).is_file():
        return None, ""
    product = read_product(folder, PSI_PRODUCT)
    if product is None:
        return None, f"{folder} was made by a version that did not note its frames"
    method = product.inputs.get("method")
    if product.digest != product_digest(PSI_PRODUCT, {**psi_inputs(session), "method": method}):
        return None, f"{folder} is of other frames, another plan or version"
    return product, f"{folder}, method {method}, made {product.made}"


def stored_scale(session: Session) -> tuple[Scale | None, str]:
    """Return the scale of the calibration stored in a session: see `stored_calibration`."""
    product, words = stored_calibration(session)
    return None if product is None else open_scale(session.folder / CALIBRATION), words


def session_scale(session: Session) -> Scale:
    """Return the scale that is stored in a session, else that of its whiteboards and darks.

    Without whiteboards it is the designed Psi and the camera's own noise model, which is coarser.
    Raises AppError or CalibrationError.
    """
    known, _ = stored_scale(session)
    return measured_scale(session) if known is None else known


def measured_scale(session: Session) -> Scale:
    """Return the scale of a session's whiteboards and darks, computed now: see `session_scale`."""
    if psi_is_assumed(session):
        return designed_scale(designed_psi(session, mean_dark(session)), session_darks(session))
    return scale_of(session_calibration(session), session)


def scale_of(calibration: Calibration, session: Session, shots: Sequence[int] = ()) -> Scale:
    """Return the scale of a calibration and all darks of its session; shots: see `Scale`."""
    white, good = calibration.white_dn_per_s, calibration.good
    good = np.ones(white.shape[1:], dtype=bool) if good is None else good
    darks = session_darks(session)
    return Scale(calibration.psi, white, darks, calibration.gain, good, tuple(shots))


def is_judged(session: Session) -> bool:
    """Return whether a calibration of the session is judged by validation, as `calibrate` does."""
    return any(frame.kind in ("open", VALIDATION) for frame in session.frames)


def psi_is_assumed(session: Session) -> bool:
    """Return whether no whiteboard measures Psi, so that it is the camera as described."""
    return not any(frame.kind in ("whiteboard", "open") for frame in session.frames)


def designed_psi(session: Session, frame: MeanFrame) -> Psi:
    """Return Psi as the camera is designed, at the size of the frames captured."""
    camera = camera_of(session)
    k = camera.sensor.binning
    rows, columns = frame.mean_dn.shape
    return build_imaging_matrix(camera, (rows * k, columns * k))

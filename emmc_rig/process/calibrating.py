"""Whiteboards to Psi for the Python API: those of a session, or arrays of anybody's bench."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from emmc_rig.calibration.boards import BoardFrame, BoardSet
from emmc_rig.calibration.frames import MeanFrame, average
from emmc_rig.calibration.scale import Scale
from emmc_rig.errors import AppError
from emmc_rig.model.arguments import numbers_of, refusal, required
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.camera import Camera, Offset, Positive
from emmc_rig.model.settings import Settings, validated
from emmc_rig.process.session_calibration import (
    SessionCalibration,
    calibrate_session,
    calibration_metrics,
    routes_of,
)
from emmc_rig.progress import Watcher
from emmc_rig.session.board_sets import SessionBoards
from emmc_rig.session.measured_psi import boards_outcome
from emmc_rig.session.session import Session

ARRAYS = (list, tuple, np.ndarray)
BOARDS_TAKE = "a list of arrays, DN; a session is given without poses, camera and darks"
POSES_TAKE = "a list of dicts, one for each whiteboard, such as {'mask_um': (0, 0), 'shot': 0}"
DARKS_TAKE = "an array (repeat, y, x), or such arrays by their exposure"
LEAST_MOVED = 0.1
"""Of a cell: masks are moved by several; of mm taken for um, a thousandth of that is left."""
View = Annotated[int, Field(ge=0)]


class Pose(Settings):
    """The bench during a whiteboard: mask position, pinhole, lamp and exposure.

    reference: whether the aperture was open and no mask in the beam.
    mask_um: position of the mask, (x, y) um from where the camera's design centres it; None: that
    of the shot.
    shot: the camera's shot, from 0, whose masks and filter were in the beam.
    view: the view (v, u), from 0, that a pinhole opened; None: all were open.
    lamp: its colour.
    validation: whether the whiteboard is used by no fit, to test the calibration.
    exposure_s: in any unit, the same for all.
    taken_s: seconds on any clock, for the drift of the lamp.
    """

    renamed: ClassVar = {"held_out": "validation"}

    reference: bool = False
    mask_um: tuple[Offset, Offset] | None = None
    shot: int = Field(default=0, ge=0)
    view: tuple[View, View] | None = None
    lamp: Literal["white", "red", "green", "blue"] = "white"
    validation: bool = False
    exposure_s: Positive = 1.0
    taken_s: float = 0.0


def calibrate(
    whiteboards: Session | str | Path | Sequence[ArrayLike] | np.ndarray,
    poses: Sequence[Mapping[str, Any]] | None = None,
    camera: Camera | None = None,
    *,
    darks: ArrayLike | Mapping[float, ArrayLike] | None = None,
    method: str = "auto",
    sensor: bool = False,
    watcher: Watcher | None = None,
) -> SessionCalibration:
    """Return Psi measured from whiteboards: those of a session, or arrays with their poses.

    `calibrate(session)` reads a session of `capture`. `calibrate(whiteboards, poses, camera,
    darks=darks)` takes arrays of another bench, and calibrates them by the same methods. A session
    can also hold whiteboards turned in their plane, with the lamp moved, through pinholes of
    several views at once, or taken after the scene; the report names what arrays lack of that.

    Args:
        whiteboards: a session, or its folder. Or a list of arrays (repeat, y, x) in DN: at least
            one reference of two repeats, one for validation, and as many as the method needs:
            through the open aperture with the mask in a few places, or through a pinhole of every
            view.
        poses: with arrays, a dict for each whiteboard, with the keys of `Pose`: lengths in um,
            times in s, exposures in any unit, the same for all.
        camera: with arrays, the camera as designed; its sensor's noise states the white level, DN.
        darks: with arrays, frames with the lamp off, (repeat, y, x) in DN, at the exposure of the
            first whiteboard; or a dict of such frames by exposure.
        method: "parametric" fits the positions of the designed masks; "mixed" also finds dust and
            defects of the masks; "free" measures every coefficient of Psi, through a pinhole of
            each view; "auto" tries all methods for which the whiteboards suffice. Of the methods
            whose residual on the validation whiteboards is noise, it takes that of the least
            stated error.
        sensor: whether gain, read noise and other figures of a session's sensor are measured, too,
            from its darks and references.
        watcher: with a session, a `Watcher` whose methods are called with stages and steps.

    Returns:
        The calibration: `psi` is the imaging matrix; `held_out_error` is the relative error of the
        predicted validation whiteboard, without unit; `frames(dn)` makes readings of the bench's
        raw frames; `save(folder)` writes psi.h5 and a report.

    Raises:
        AppError: an unknown method; whiteboards without poses, of another size, or fewer than are
            needed; masks that moved by so little that millimetres were given.
        CalibrationError: whiteboards that are unfit: no lamp, another mask, saturated, unsteady.
        ArgumentError: an argument of another type; poses with a session, or `sensor` with arrays.
    """
    arrays = isinstance(whiteboards, ARRAYS)
    if not arrays and all(given is None for given in (poses, camera, darks)):
        return calibrate_session(whiteboards, method, sensor, watcher)
    required(whiteboards, ARRAYS, "whiteboards", BOARDS_TAKE)
    if sensor:
        raise refusal(sensor, "sensor", "True with a session only, whose darks it needs")
    return _of_arrays(whiteboards, poses, camera, darks, method)


@one_blas_thread()
def _of_arrays(
    whiteboards: Any, poses: Any, camera: Any, darks: Any, method: str
) -> SessionCalibration:
    """Return the calibration of arrays; see `calibrate`."""
    started = time.perf_counter()
    required(poses, (list, tuple), "poses", POSES_TAKE)
    required(camera, Camera, "camera", "the camera as designed, emmc_rig.camera(...)")
    if len(whiteboards) != len(poses):
        raise AppError(f"{len(whiteboards)} whiteboards, and {len(poses)} poses: give one for each")
    stood = [validated(Pose, pose, f"poses[{place}]", AppError) for place, pose in enumerate(poses)]
    if darks is None:
        raise refusal(darks, "darks", DARKS_TAKE)
    _refuse_millimetres(stood, camera)
    exposed = darks if isinstance(darks, Mapping) else {stood[0].exposure_s: darks}
    dark = _dark_frames(exposed, camera)
    boards = _sorted_boards(whiteboards, stood, camera, dark)
    k, (rows, columns) = camera.sensor.binning, dark[0].mean_dn.shape
    size, routes = (k * rows, k * columns), routes_of(method)
    outcome = boards_outcome(camera, size, boards, "poses: they have", routes)
    metrics = calibration_metrics(outcome, camera.title, "", method, started)
    chosen = outcome.calibration
    good = outcome.good if chosen.good is None else chosen.good
    scale = Scale(chosen.psi, chosen.white_dn_per_s, dark, chosen.gain, good)
    return SessionCalibration(outcome, chosen, scale, metrics)


def _dark_frames(darks: Mapping[float, ArrayLike], camera: Camera) -> tuple[MeanFrame, ...]:
    """Return the mean dark frame of each exposure; raises AppError for different sizes."""
    for exposure_s in darks:
        required(exposure_s, Real, "an exposure of darks", "a number, as poses give it")
    means = tuple(
        _mean(frames, float(exposure_s), camera, f"darks at {exposure_s:g}", lit=False)
        for exposure_s, frames in darks.items()
    )
    sizes = {mean.mean_dn.shape for mean in means}
    if len(sizes) != 1:
        raise AppError(f"darks: of {len(sizes)} sizes, {', '.join(map(str, sorted(sizes)))} pixels")
    return means


def _sorted_boards(
    whiteboards: Sequence[ArrayLike],
    poses: Sequence[Pose],
    camera: Camera,
    darks: tuple[MeanFrame, ...],
) -> SessionBoards:
    """Return the whiteboards of the fit, of the method free, and of validation.

    Raises AppError for a whiteboard of another size than the darks, and without a reference.
    """
    references: dict[tuple[int, str], MeanFrame] = {}
    sorted_in: dict[str, list[BoardFrame]] = {"open": [], "pinhole": [], "validation": []}
    for place, (frames, pose) in enumerate(zip(whiteboards, poses, strict=True)):
        name, size = f"whiteboards[{place}]", darks[0].mean_dn.shape
        _refuse_beyond(pose, camera, name)
        mean = _mean(frames, pose.exposure_s, camera, name, taken_s=pose.taken_s)
        if mean.mean_dn.shape != size:
            raise AppError(f"{name}: {mean.mean_dn.shape} pixels, the darks have {size}")
        if pose.reference:
            references[pose.shot, pose.lamp] = mean
            continue
        of_shot = camera.shots[pose.shot].offset_um
        stage_um = pose.mask_um or next(iter(of_shot.values()), (0.0, 0.0))
        kind = "validation" if pose.validation else "pinhole" if pose.view else "open"
        sorted_in[kind].append(BoardFrame.held(mean, stage_um, pose.shot, pose.view, pose.lamp))
    if not references:
        raise AppError(
            "poses: none is {'reference': True}, a whiteboard without the mask, aperture open"
        )
    # The white lamp's first: the sensor's gain follows from it.
    white_first = dict(sorted(references.items(), key=lambda item: item[0][1] != "white"))
    every = BoardSet(darks, white_first, ())
    fitted = [*sorted_in["open"], *(sorted_in["pinhole"] if sorted_in["open"] else ())]
    return SessionBoards(
        *(
            every.with_frames(frames) if frames else None
            for frames in (fitted, sorted_in["pinhole"], sorted_in["validation"])
        ),
        turned={},
    )


def _mean(
    frames: Any,
    exposure_s: float,
    camera: Camera,
    name: str,
    taken_s: float = 0.0,
    lit: bool = True,
) -> MeanFrame:
    takes = "DN, an array (repeat, y, x) or (y, x)"
    array = numbers_of(frames, name, takes)
    if array.ndim not in (2, 3) or not array.size:
        raise refusal(frames, name, takes)
    if not np.isfinite(array).all():
        raise AppError(f"{name}: holds values that are not finite")
    repeats = array.reshape(-1, *array.shape[-2:])
    white_dn = camera.sensor.noise.white_level_dn
    return average(repeats, exposure_s, white_dn, name, taken_s, lit)


def _refuse_millimetres(poses: Sequence[Pose], camera: Camera) -> None:
    """Raise AppError where the mask moved, but by less than calibration can use."""
    moved_um = max((abs(at) for pose in poses for at in pose.mask_um or ()), default=0.0)
    cell_um = min((mask.cell_um for mask in camera.masks.values()), default=0.0)
    if 0 < moved_um < LEAST_MOVED * cell_um:
        raise AppError(
            f"poses: the mask moves by {moved_um:g} um at most, and its cells are {cell_um:g} um "
            "wide: mask_um is in um; were these mm?"
        )


def _refuse_beyond(pose: Pose, camera: Camera, name: str) -> None:
    """Raise AppError where the camera has no such shot or view."""
    if pose.shot >= len(camera.shots):
        raise AppError(
            f"{name}: shot {pose.shot}, the camera has shots 0 to {len(camera.shots) - 1}"
        )
    if pose.view and any(at >= count for at, count in zip(pose.view, camera.views, strict=True)):
        raise AppError(f"{name}: view {pose.view}, the camera has {camera.views} views from 0")

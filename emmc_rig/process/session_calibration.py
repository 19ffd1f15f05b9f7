"""A session's whiteboards to Psi, by the method that predicts the validation whiteboard best."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.calibration.fit import Fit
from emmc_rig.calibration.placement import SCALARS, labels
from emmc_rig.calibration.routes import Outcome
from emmc_rig.calibration.scale import Scale
from emmc_rig.calibration.sensor import SensorSheet, characterise
from emmc_rig.calibration.whiteboard import Calibration, NewArray, in_memory
from emmc_rig.errors import AppError
from emmc_rig.model.arguments import numbers_of, path_of
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.camera import camera_of as camera_of_psi
from emmc_rig.model.camera import json_of_shots
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.inputs import check_frames
from emmc_rig.session.board_sets import camera_of, sensor_pairs, taken_shots
from emmc_rig.session.measured_psi import (
    CALIBRATION_FILE,
    PSI_PRODUCT,
    is_judged,
    measured_scale,
    open_scale,
    psi_inputs,
    scale_of,
    session_outcome,
    stored_scale,
    write_scale,
)
from emmc_rig.session.session import CALIBRATION, Session
from emmc_rig.store.folders import result_folder
from emmc_rig.store.products import record_product
from emmc_rig.store.psi import PSI
from emmc_rig.store.result_files import read_metrics
from emmc_rig.store.results import command_line, metrics_text, versions, write_metrics

SENSOR = "sensor.json"
METHODS = {
    "auto": ("parametric", "mixed", "free", "combined"),
    "parametric": ("parametric",),
    "mixed": ("parametric", "mixed"),
    "free": ("free",),
}
Array = NDArray[np.floating]
REPORT = "report.html"


@dataclass(frozen=True, eq=False)
class GivenFrame:
    """A raw frame given as an array: see `calibration.scale.RawValues`."""

    mosaic: NDArray
    black_level_dn: NDArray[np.floating]
    white_level_dn: int
    exposure_s: float
    gain: float = 1.0


@dataclass(frozen=True, eq=False, repr=False)
class SessionCalibration:
    """Psi measured from whiteboards, of a session or given as arrays; see `emmc_rig.calibrate`.

    outcome: all methods tried, and the choice among them.
    calibration: the chosen one, of the shots that the session has.
    scale: converts raw frames to readings.
    metrics: the figures, with the keys of metrics.json.
    sensor: figures of the sensor, where they were measured.
    inputs: what Psi follows from, for `store.products`; None with arrays.
    """

    outcome: Outcome
    calibration: Calibration
    scale: Scale
    metrics: dict[str, Any]
    sensor: SensorSheet | None = None
    inputs: dict[str, Any] | None = None

    @property
    def psi(self) -> Psi:
        """The measured imaging matrix; it maps (v, u, y, x, c) to (shot, pixel_y, pixel_x)."""
        return self.calibration.psi

    @property
    def held_out_error(self) -> float:
        """Relative error of the predicted validation whiteboard; 0.01 is one per cent."""
        return self.outcome.judged[self.outcome.chosen].relative_error

    def frames(self, dn: ArrayLike, exposures_s: float | Sequence[float] = 1.0) -> Frames:
        """Return the readings of raw frames, with their deviations, for `emmc_rig.reconstruct`.

        Args:
            dn: raw values, DN, (shot, pixel_y, pixel_x), of the shots of Psi.
            exposures_s: of all shots, or of each, in the unit of the whiteboards' exposures.

        Raises:
            ReconstructionError: another shape than Psi's frames.
            ArgumentError: values other than numbers.
        """
        taken = numbers_of(dn, "dn", "raw values, an array (shot, pixel_y, pixel_x)")
        check_frames(self.psi.frames_shape, taken)
        times_s = np.broadcast_to(np.asarray(exposures_s, np.float64), len(taken))
        noise = camera_of_psi(self.psi).sensor.noise
        black = np.full((1, 1), noise.black_level_dn)
        raw = {
            shot: GivenFrame(mosaic, black, noise.white_level_dn, float(time_s))
            for shot, mosaic, time_s in zip(self.scale.shots, taken, times_s, strict=True)
        }
        return self.scale.frames(lambda shot: [raw[shot]])

    def save(self, out: str | Path) -> None:
        """Write psi.h5, calibration.h5, metrics.json and report.html into a folder.

        Args:
            out: the folder; made if missing. An earlier calibration in it is replaced.

        Raises:
            AppError: a folder that holds anything else, or that cannot be written.
        """
        place = Path(self.metrics["session"]) / CALIBRATION
        with result_folder(Path(out), "calibrate", belongs_to=place) as folder:
            self.write(folder)

    def write(self, folder: Path) -> None:
        """Write the same files into an existing folder."""
        from emmc_rig.report.calibration_page import write_calibration_report  # templates

        save_outcome(folder, self.outcome, self.calibration, self.scale)
        if self.inputs is not None:
            record_product(folder, PSI_PRODUCT, self.inputs)
        write_calibration_report(folder / REPORT, self.outcome, self.metrics, self.sensor)
        write_metrics(folder, self.metrics)
        if self.sensor is not None:
            figures: dict[str, Any] = {
                row.quantity: {
                    "value": row.value,
                    "deviation": row.deviation,
                    "unit": row.unit,
                    "remark": row.remark,
                }
                for row in self.sensor.rows()
            }
            curve = self.sensor.curve
            figures["Photon transfer curve"] = {
                "signal_dn": curve.mean_dn.tolist(),
                "variance_dn2": curve.variance_dn2.tolist(),
                "exposure_s": curve.exposure_s.tolist(),
            }
            (folder / SENSOR).write_text(metrics_text(figures), encoding="utf-8")

    def __repr__(self) -> str:
        return (
            f"SessionCalibration(method {self.outcome.chosen}, validation error "
            f"{self.held_out_error:.2%}, {self.psi!r})"
        )


def calibrate_session(
    session: object, method: str, sensor: bool, watcher: Watcher | None
) -> SessionCalibration:
    """Return Psi as a session's whiteboards measure it, see `calibrating.calibrate`.

    Raises ArgumentError unless `session` is a session or its folder.
    """
    if not isinstance(session, Session):
        takes = "a session, or its folder; or whiteboards as arrays, with poses and a camera"
        session = Session(path_of(session, "session", takes))
    return _calibrated(session, method, sensor, watcher or Watcher(), in_memory)


def calibrate_into(
    folder: Path, session: Session, method: str, sensor: bool, watcher: Watcher
) -> SessionCalibration:
    """Calibrate and write the result into an existing folder.

    The method free writes Psi and its deviations view by view, and does not hold them in memory:
    the returned calibration has closed arrays. Raises AppError or CalibrationError.
    """
    whole = taken_shots(session) == tuple(range(len(camera_of(session).shots)))
    with arrays_in(folder) as on_disk:
        empty = on_disk if method == "free" and whole else in_memory
        calibration = _calibrated(session, method, sensor, watcher, empty)
        calibration.write(folder)
    return calibration


def calibrated_scale(session: Session, watcher: Watcher | None = None) -> Scale:
    """Return the scale that is stored in a session; measured and stored first where there is none.

    watcher: gets the name of the calibration as a note. A stored calibration whose frames or
    program version differ is measured again, by its own method.

    Raises AppError or CalibrationError.
    """
    tell = (watcher or Watcher()).tell
    known, words = stored_scale(session)
    if known is not None:
        tell(f"Psi: {words}")
        return known
    if not is_judged(session):
        return measured_scale(session)
    place, method = session.folder / CALIBRATION, _method_of(session)
    if words:
        tell(f"{words}: measured again, method {method}")
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(result_folder(place, "calibrate", belongs_to=place))
        except AppError as fault:
            tell(f"the calibration is not stored: {fault}")
            return measured_scale(session)
        calibrate_into(folder, session, method, False, Watcher())
    return open_scale(place)


def _method_of(session: Session) -> str:
    """Return the method of the calibration in a session; auto where there is none."""
    with suppress(AppError):
        method = read_metrics(session.folder / CALIBRATION).get("route")
        if method in METHODS:
            return method
    return "auto"


@one_blas_thread()
def _calibrated(
    session: Session, method: str, sensor: bool, watcher: Watcher, empty: NewArray
) -> SessionCalibration:
    routes, started = routes_of(method), time.perf_counter()
    watcher.begin("frames", None)
    outcome = session_outcome(session, routes, empty, watcher)
    title = session.header["title"] or session.folder.name
    metrics = calibration_metrics(outcome, title, str(session.folder), method, started)
    shots = taken_shots(session)
    chosen = outcome.calibration
    if len(shots) < chosen.psi.shots:
        # What `reconstruct --psi` takes with the session's own shots.
        chosen = chosen.of_shots(shots, json_of_shots(camera_of(session), shots))
    sheet = None
    if sensor:
        watcher.begin("sensor", None)
        planned = camera_of(session).sensor
        white_dn, monochrome = planned.noise.white_level_dn, planned.cfa == "mono"
        sheet = characterise(*sensor_pairs(session), white_dn, monochrome)
    scale = scale_of(chosen, session, shots)
    inputs = {**psi_inputs(session), "method": method}
    return SessionCalibration(outcome, chosen, scale, metrics, sheet, inputs)


def routes_of(method: str) -> tuple[str, ...] | None:
    """Return what a method tries, None for all that the whiteboards suffice for; or AppError."""
    if method not in METHODS:
        raise AppError(f"method {method}: use one of {', '.join(METHODS)}")
    return None if method == "auto" else METHODS[method]


def calibration_metrics(
    outcome: Outcome, title: str, session: str, method: str, started: float
) -> dict[str, Any]:
    """Return what metrics.json says; title: of the camera, started: by `time.perf_counter`."""
    return {
        "camera": title,
        "session": session,
        "size": list(outcome.calibration.psi.size),
        "route": method,  # the key that scripts read
        **outcome_figures(outcome),
        "calibration_seconds": time.perf_counter() - started,
        "command": command_line(),
        "versions": versions(),
    }


def outcome_figures(outcome: Outcome) -> dict:
    """Return what a calibration says of itself, for metrics.json and the report."""
    mixed, best = outcome.mixed, outcome.mixed or outcome.parametric
    defects = None if mixed is None else 0 if mixed.defects is None else mixed.defects.count
    return {
        "chosen": outcome.chosen,
        "why": outcome.why,
        "findings": list(outcome.findings),
        "advice": list(outcome.advice),
        "unwatched": list(outcome.unwatched),
        "held_out": {
            name: {
                "chi2": judged.chi2,
                "relative_error": judged.relative_error,
                "chi2_by_kind": dict(judged.groups),
            }
            for name, judged in outcome.judged.items()
        },
        "frames": dict(outcome.frames),
        "bad_pixels": float(1 - outcome.good.mean()),
        "defects": defects,
        "parameters": {} if best is None else _parameters(best.fit),
        "fit": {} if best is None else _fit_figures(best.fit),
    }


def _parameters(fit: Fit) -> dict[str, dict[str, float]]:
    """Return the parameters of the mask's placement with their deviations, by name."""
    values, deviations = fit.placement.vector(), np.sqrt(np.diag(fit.covariance))
    rows, columns = np.array(fit.placement.aperture).shape
    return {
        name: {"value": float(value), "deviation": float(deviation)}
        for name, value, deviation in zip(labels((rows, columns)), values, deviations, strict=True)
    }


def _fit_figures(fit: Fit) -> dict[str, object]:
    return {
        "correlation": fit.correlation,
        "chi2": fit.chi2,
        "outliers": fit.outliers,
        "steps": fit.steps,
        "status": fit.status,
        "undecided": list(fit.undecided),
        "boards": [asdict(board) for board in fit.boards],
    }


@contextmanager
def arrays_in(folder: Path) -> Iterator[NewArray]:
    """Yield what makes the arrays of Psi in the files of a folder that `save_outcome` completes."""
    with ExitStack() as files:

        def empty(name: str, shape: tuple[int, ...]) -> h5py.Dataset:
            path = folder / {"weights": PSI, "deviation": CALIBRATION_FILE}[name]
            file = files.enter_context(h5py.File(path, "w"))
            return file.create_dataset(name, shape, np.float32)

        yield empty


def save_outcome(folder: Path, outcome: Outcome, chosen: Calibration, scale: Scale) -> None:
    """Write psi.h5 and calibration.h5 of the calibration chosen into an existing folder.

    Arrays that are on disk stay where they are, and their files get the rest.
    """
    weights, deviation = chosen.psi.weights, chosen.deviation
    if isinstance(weights, h5py.Dataset) and isinstance(deviation, h5py.Dataset):
        chosen.psi.describe(weights.file)
        _describe(deviation.file, outcome, scale)
        return
    chosen.psi.save(folder / PSI)
    with h5py.File(folder / CALIBRATION_FILE, "w") as file:
        file["deviation"] = chosen.deviation
        _describe(file, outcome, scale)


def _describe(file: h5py.File, outcome: Outcome, scale: Scale) -> None:
    """Write the scale of the readings, the crosstalk, and the placement of the mask."""
    write_scale(file, scale)
    if outcome.crosstalk is not None:
        # What every filter sees of the colours, (filter, colour).
        file["crosstalk"] = outcome.crosstalk.seen
    best = outcome.mixed or outcome.parametric
    by_route = {"parametric": outcome.parametric, "mixed": outcome.mixed, "combined": best}
    known = by_route.get(outcome.chosen)
    if known is not None:
        for name in SCALARS:
            file.attrs[name] = getattr(known.fit.placement, name)
        file["aperture"] = np.array(known.fit.placement.aperture)
        if known.fit.placement.pupil is not None:
            # As described, or of the shape that the whiteboards show: the scalars are relative.
            file.attrs["pupil"] = known.fit.placement.pupil.model_dump_json()
        if known.defects is not None:
            file["lost"] = known.defects.lost

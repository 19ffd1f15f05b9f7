"""A session's whiteboards to Psi, by the route that predicts the whiteboard held out best."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.routes import Outcome
from calibration.sensor import SensorSheet, characterise
from calibration.whiteboard import Calibration, NewArray, in_memory
from emmc_rig.errors import AppError
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import command_line, metrics_text, versions, write_metrics
from emmc_rig.model.arguments import path_of
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.pages.calibration_page import write_calibration_report
from emmc_rig.processing.calibration_settings import ROUTES
from emmc_rig.processing.stored import REPORT, arrays_in, outcome_figures, save_outcome
from emmc_rig.progress import Silent, Watcher
from emmc_rig.session.board_sets import sensor_pairs
from emmc_rig.session.frame_means import camera_of
from emmc_rig.session.measured_psi import session_outcome
from emmc_rig.session.readings import camera_json_of, taken_shots
from emmc_rig.session.session import CALIBRATION, Session

SENSOR = "sensor.json"


def _figures(rows: Iterable[tuple[str, float, float | None, str]]) -> dict[str, Any]:
    return {
        name: {"value": value, "deviation": deviation, "unit": unit}
        for name, value, deviation, unit in rows
    }


@dataclass(frozen=True, eq=False, repr=False)
class SessionCalibration:
    """Psi as a session's whiteboards measure it.

    outcome: all routes tried, and the choice among them. calibration: the one chosen, of the shots
    that the session has. metrics: what metrics.json says.
    """

    outcome: Outcome
    calibration: Calibration
    metrics: dict[str, Any]
    sensor: SensorSheet | None = None

    @property
    def psi(self) -> ImagingMatrix:
        """The imaging matrix of the session's shots."""
        return self.calibration.psi

    @property
    def held_out_error(self) -> float:
        """Relative error at which the whiteboard held out of the fit is predicted."""
        return self.outcome.judged[self.outcome.chosen].relative_error

    def save(self, out: str | Path) -> None:
        """Write psi.h5, calibration.h5, metrics.json and report.html as the folder `out`.

        An earlier result of that name is replaced; raises AppError where something else is there.
        """
        place = Path(self.metrics["session"]) / CALIBRATION
        with result_folder(Path(out), "calibrate", belongs_to=place) as folder:
            self.write(folder)

    def write(self, folder: Path, truth: Mapping[str, float] | None = None) -> None:
        """Write the same files into an existing folder; truth: parameters of a simulated bench."""
        save_outcome(folder, self.outcome, self.calibration)
        write_calibration_report(folder / REPORT, self.outcome, self.metrics, truth, self.sensor)
        write_metrics(folder, self.metrics)
        if self.sensor is not None:
            figures = _figures(self.sensor.rows())
            curve = self.sensor.curve
            figures["Photon transfer curve"] = {
                "signal_dn": curve.mean_dn.tolist(),
                "variance_dn2": curve.variance_dn2.tolist(),
                "exposure_s": curve.exposure_s.tolist(),
            }
            (folder / SENSOR).write_text(metrics_text(figures), encoding="utf-8")

    def __repr__(self) -> str:
        return (
            f"SessionCalibration({self.outcome.chosen} route, whiteboard held out to "
            f"{self.held_out_error:.2%}, {self.psi!r})"
        )


def calibrate(
    session: Session | str | Path,
    route: str = "auto",
    *,
    sensor: bool = False,
    watcher: Watcher | None = None,
) -> SessionCalibration:
    """Return Psi as a session's whiteboards measure it; `.save(folder)` writes it with a report.

    session: itself, or its folder. route: parametric, mixed or free; `auto` takes every one that
    the session has whiteboards for, and chooses. sensor: its figures too, from the darks and the
    references at several exposures.
    Raises AppError or CalibrationError.
    """
    if not isinstance(session, Session):
        session = Session(path_of(session, "session", "a session, or its folder"))
    return _calibrated(session, route, sensor, watcher or Silent(), in_memory)


def calibrate_into(
    folder: Path, session: Session, route: str, sensor: bool, watcher: Watcher
) -> SessionCalibration:
    """Calibrate and write the result into an existing folder.

    The free route writes Psi and its deviations view by view, and does not hold them in memory:
    they are no longer there in what is returned. Raises AppError or CalibrationError.
    """
    whole = taken_shots(session) == tuple(range(len(camera_of(session).shots)))
    with arrays_in(folder) as on_disk:
        empty = on_disk if route == "free" and whole else in_memory
        calibration = _calibrated(session, route, sensor, watcher, empty)
        calibration.write(folder)
    return calibration


@one_blas_thread()
def _calibrated(
    session: Session, route: str, sensor: bool, watcher: Watcher, empty: NewArray
) -> SessionCalibration:
    if route not in ROUTES:
        raise AppError(f"--route {route}: use one of {', '.join(ROUTES)}")
    started = time.perf_counter()
    watcher.begin("frames", None)
    whiteboards = (frame for frame in session.frames if frame.kind == "whiteboard")
    planes = len({(one.bench.shot, one.view, one.bench.lamp) for one in whiteboards})
    outcome = session_outcome(
        session,
        None if route == "auto" else ROUTES[route],
        lambda name: watcher.begin(name, planes if name == "Psi, free" else None),
        empty,
        watcher.step,
    )
    metrics = {
        "camera": session.header["title"] or session.folder.name,
        "session": str(session.folder),
        "size": list(outcome.calibration.psi.size),
        "route": route,
        **outcome_figures(outcome),
        "calibration_seconds": time.perf_counter() - started,
        "command": command_line(),
        "versions": versions(),
    }
    shots = taken_shots(session)
    chosen = outcome.calibration
    if len(shots) < chosen.psi.shots:
        # What `reconstruct --psi` takes with the session's own shots.
        chosen = chosen.of_shots(shots, camera_json_of(session, shots))
    sheet = None
    if sensor:
        watcher.begin("sensor", None)
        white_dn = camera_of(session).sensor.noise.white_level_dn
        sheet = characterise(*sensor_pairs(session), white_dn)
    return SessionCalibration(outcome, chosen, metrics, sheet)

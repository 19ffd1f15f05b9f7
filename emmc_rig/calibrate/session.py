"""A session's whiteboards to Psi, by the route that predicts the whiteboard held out best."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.routes import Outcome
from calibration.sensor import SensorSheet, characterise
from calibration.whiteboard import Calibration
from emmc_rig.calibrate.settings import ROUTES
from emmc_rig.calibrate.stored import REPORT, outcome_figures, save_outcome
from emmc_rig.errors import AppError
from emmc_rig.files.folders import result_folder
from emmc_rig.files.results import command_line, metrics_text, versions, write_metrics
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.pages.calibration_page import write_calibration_report
from emmc_rig.progress import Silent, Watcher
from emmc_rig.session.readings import (
    camera_json_of,
    camera_of,
    sensor_pairs,
    session_outcome,
    taken_shots,
)
from emmc_rig.session.session import CALIBRATION, Session

SENSOR = "sensor.json"


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

    def write(self, folder: Path) -> None:
        """Write the same files into an existing folder."""
        save_outcome(folder, self.outcome, self.calibration)
        write_calibration_report(folder / REPORT, self.outcome, self.metrics, sensor=self.sensor)
        write_metrics(folder, self.metrics)
        if self.sensor is not None:
            figures = {
                name: {"value": value, "deviation": deviation, "unit": unit}
                for name, value, deviation, unit in self.sensor.rows()
            }
            curve = self.sensor.curve
            figures["Photon transfer curve"] = {
                "signal_dn": curve.mean_dn.tolist(),
                "variance_dn2": curve.variance_dn2.tolist(),
                "exposure_s": curve.exposure_s.tolist(),
            }
            for name, one in (("DSNU, DN", self.sensor.dsnu), ("PRNU, share", self.sensor.prnu)):
                figures[f"Spectrogram of {name}"] = {
                    direction: {
                        "cycles_per_pixel": one.frequency[direction].tolist(),
                        "amplitude": amplitude.tolist(),
                    }
                    for direction, amplitude in one.spectra.items()
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
    session = session if isinstance(session, Session) else Session(Path(session))
    watcher = watcher or Silent()
    if route not in ROUTES:
        raise AppError(f"--route {route}: use one of {', '.join(ROUTES)}")
    started = time.perf_counter()
    watcher.begin("frames", None)
    outcome = session_outcome(
        session,
        None if route == "auto" else ROUTES[route],
        lambda name: watcher.begin(name, None),
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

"""A session as a capture: Psi of its calibration, and the readings of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from emmc_rig.calibration.scale import Scale
from emmc_rig.errors import AppError
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.process.captures import Capture
from emmc_rig.process.session_calibration import calibrated_scale
from emmc_rig.progress import Watcher
from emmc_rig.reconstruction.verdict.rules import Reason
from emmc_rig.session.board_sets import frame_shape, session_darks, taken_shots
from emmc_rig.session.brightness import exposure_reasons, shot_exposures
from emmc_rig.session.measured_psi import CALIBRATION_FILE, open_scale, psi_is_assumed
from emmc_rig.session.readings import session_frames
from emmc_rig.session.session import CALIBRATION, Session
from emmc_rig.store.folders import SESSION_RECONSTRUCTION
from emmc_rig.store.psi import PSI, StoredPsi


class SessionCapture(Capture):
    """An open session, whose light field has a folder in it."""

    def __init__(self, session: Session) -> None:
        super().__init__(session.folder)
        self.session = session
        self.own_place = session.folder / SESSION_RECONSTRUCTION
        self.assumed = psi_is_assumed(session)
        self.planned_frames = sum(frame.film is not None for frame in session.frames)

    def psi_file(self) -> Path:
        """Return the file of the Psi that its whiteboards measured."""
        calibrated_scale(self.session)
        path = self.folder / CALIBRATION / PSI
        if not path.is_file():
            raise AppError(f"{self.folder}: no whiteboards measure its Psi; name the file of one")
        return path

    def frames(
        self, psi: Path | None, place: int | None, out: Path, watcher: Watcher
    ) -> tuple[Frames, Path]:
        """Return readings, and the file of their Psi: its own is written to `out`."""
        own, frames = session_frames(self.session, self.scale(psi, watcher), place)
        if psi is None:
            own.save(out / PSI)
        return frames, psi or out / PSI

    def loaded(self, psi: Path | None, place: int | None) -> tuple[Psi, Frames]:
        """Return Psi and readings."""
        own, frames = session_frames(self.session, self.scale(psi), place)
        return own if psi is None else StoredPsi(psi).load(), frames

    def exposure_reasons(self) -> Sequence[Reason]:
        """Return what speaks against the exposures of its shots."""
        return exposure_reasons(shot_exposures(self.session))

    def scale(self, psi: Path | None, watcher: Watcher | None = None) -> Scale:
        """Return what makes readings of the frames.

        psi: of another calibration, whose whiteboards then scale the readings, with the darks of
        this session, if any. Raises AppError for a calibration of other frames.
        """
        if psi is None or not (psi.parent / CALIBRATION_FILE).is_file():
            return calibrated_scale(self.session, watcher)
        scale, session = open_scale(psi), self.session
        fits = scale.psi.frames_shape[1:] == frame_shape(session)
        if not fits or not set(taken_shots(session)) <= set(scale.shots):
            raise AppError(f"{psi}: of other frames than those of {self.folder}; calibrate these")
        if not any(frame.kind == "dark" for frame in session.frames):
            return scale
        return replace(scale, darks=session_darks(session))

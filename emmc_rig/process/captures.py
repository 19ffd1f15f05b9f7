"""What is reconstructed: a session, or a folder of frames with their Psi; each is opened once."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.progress import Watcher
from emmc_rig.store.folders import is_session
from emmc_rig.store.psi import StoredPsi, psi_beside, read_frames

if TYPE_CHECKING:
    from emmc_rig.reconstruction.verdict.rules import Reason


class Capture:
    """Frames that are reconstructed with their Psi: here a folder that `simulate` or `demo` wrote.

    folder: holds the frames. own_place: folder of the result in `folder`; None where results go
    elsewhere. assumed: whether Psi is the camera as described, measured by no whiteboard.
    planned_frames: how many frames of a film were planned; 0 where it is no film.
    """

    own_place: Path | None = None
    assumed = False
    planned_frames = 0

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def psi_file(self) -> Path:
        """Return the file of its own Psi; raises AppError where none is stored."""
        return psi_beside(self.folder)

    def frames(
        self, psi: Path | None, place: int | None, out: Path, watcher: Watcher
    ) -> tuple[Frames, Path]:
        """Return readings, and the file of their Psi, which is written into `out` if need be.

        psi: the file of another Psi. place: of the one frame of a film, from 0. watcher:
        gets the name of Psi as a note. Raises AppError, SensingError or CalibrationError.
        """
        return read_frames(self.folder), psi or self.psi_file()

    def loaded(self, psi: Path | None, place: int | None) -> tuple[Psi, Frames]:
        """Return Psi and readings; see `frames`."""
        return StoredPsi(psi or self.psi_file()).load(), read_frames(self.folder)

    def exposure_reasons(self) -> Sequence[Reason]:
        """Return what speaks against the exposures, for the verdict; a folder states none."""
        return ()


def opened_capture(folder: Path) -> Capture:
    """Return what is in a folder; raises AppError for a damaged session, or a file."""
    if is_session(folder):
        # What sessions need, the formats of cameras among it, loads for as long as all else here.
        from emmc_rig.process.session_capture import SessionCapture
        from emmc_rig.session.session import Session

        return SessionCapture(Session(folder))
    return Capture(folder)

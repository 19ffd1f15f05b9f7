"""What is reconstructed: a session, or a folder of frames with their Psi; each is opened once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.progress import Watcher
from emmc_rig.store.folders import is_session
from emmc_rig.store.psi import StoredPsi, psi_beside, read_frames

if TYPE_CHECKING:
    from emmc_rig.reconstruction.verdict.rules import Reason


class Capture(Protocol):
    """Frames that are reconstructed with their Psi."""

    @property
    def folder(self) -> Path:
        """Where the frames are."""
        ...

    @property
    def own_place(self) -> Path | None:
        """Folder of the result in `folder`; None where results go elsewhere."""
        ...

    @property
    def assumed(self) -> bool:
        """Whether Psi is the camera as described, measured by no whiteboard."""
        ...

    @property
    def planned_frames(self) -> int:
        """How many frames of a film were planned; 0 where it is no film."""
        ...

    def psi_file(self) -> Path:
        """Return the file of its own Psi; raises AppError where none is stored."""
        ...

    def frames(
        self, psi: Path | None, place: int | None, out: Path, watcher: Watcher
    ) -> tuple[Frames, Path]:
        """Return readings, and the file of their Psi, which is written into `out` if need be.

        psi: the file of another Psi. place: of the one frame of a film, from 0. watcher:
        gets the name of Psi as a note. Raises AppError, SensingError or CalibrationError.
        """
        ...

    def loaded(self, psi: Path | None, place: int | None) -> tuple[ImagingMatrix, Frames]:
        """Return Psi and readings; see `frames`."""
        ...

    def exposure_reasons(self) -> Sequence[Reason]:
        """Return what speaks against the exposures, for the verdict."""
        ...


@dataclass(frozen=True)
class FolderCapture:
    """A folder that `simulate` or `demo` wrote: see `Capture`."""

    folder: Path
    own_place = None
    assumed = False
    planned_frames = 0

    def psi_file(self) -> Path:
        """Return the file of its Psi."""
        return psi_beside(self.folder)

    def frames(
        self, psi: Path | None, place: int | None, out: Path, watcher: Watcher
    ) -> tuple[Frames, Path]:
        """Return readings, and the file of their Psi."""
        return read_frames(self.folder), psi or self.psi_file()

    def loaded(self, psi: Path | None, place: int | None) -> tuple[ImagingMatrix, Frames]:
        """Return Psi and readings."""
        return StoredPsi(psi or self.psi_file()).load(), read_frames(self.folder)

    def exposure_reasons(self) -> Sequence[Reason]:
        """Return nothing: a folder does not state its exposures."""
        return ()


def opened_capture(folder: Path) -> Capture:
    """Return what is in a folder; raises AppError for a damaged session, or a file."""
    if is_session(folder):
        # What sessions need, the formats of cameras among it, loads for as long as all else here.
        from emmc_rig.process.session_capture import SessionCapture
        from emmc_rig.session.session import Session

        return SessionCapture(Session(folder))
    return FolderCapture(folder)

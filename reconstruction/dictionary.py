"""A dictionary is a set of light-field patches of unit norm: check it, keep it in a file."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from reconstruction.errors import DictionaryError

KINDS = ("ksvd", "online", "dct", "separable", "lambertian")
FORMAT = "emmc-rig dictionary 1"
_NORM_TOLERANCE = 1e-3
_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, eq=False)
class Dictionary:
    """atoms: (atom, v, u, y, x, c) float32, each of unit l2 norm. kind: one of KINDS.

    provenance: JSON about the training: scenes, seed, settings, error history, versions.
    Raises DictionaryError for another shape, values that are not finite, another norm than 1.
    """

    atoms: NDArray[np.float32]
    kind: str
    provenance: str = ""

    def __post_init__(self) -> None:
        norms = _norms(self.atoms, self.kind)
        wrong = np.flatnonzero(np.abs(norms - 1) > _NORM_TOLERANCE)
        if wrong.size:
            raise DictionaryError(
                f"atom {wrong[0]} has norm {norms[wrong[0]]:.4g}, needs 1: "
                "build the dictionary with Dictionary.normalised"
            )
        # A frozen dataclass sets its fields so; solvers want one contiguous float32 matrix.
        object.__setattr__(self, "atoms", np.ascontiguousarray(self.atoms, dtype=np.float32))

    @classmethod
    def normalised(cls, atoms: NDArray[np.floating], kind: str, provenance: str = "") -> Dictionary:
        """Return the dictionary of atoms (atom, v, u, y, x, c) brought to unit norm.

        Raises DictionaryError as the constructor does, and for an atom that is zero.
        """
        norms = _norms(atoms, kind)
        zero = np.flatnonzero(norms == 0)
        if zero.size:
            raise DictionaryError(f"atom {zero[0]} is zero everywhere: leave it out")
        scaled = (atoms / norms.reshape(-1, 1, 1, 1, 1, 1)).astype(np.float32)
        return cls(scaled, kind, provenance)

    @property
    def size(self) -> int:
        """Number of atoms."""
        return self.atoms.shape[0]

    @property
    def patch_shape(self) -> tuple[int, int, int, int, int]:
        """Rows and columns of views, rows and columns of pixels, colours of a patch."""
        v, u, y, x, c = self.atoms.shape[1:]
        return v, u, y, x, c

    @property
    def matrix(self) -> NDArray[np.float32]:
        """The atoms as rows (atom, v u y x c), a view of the same memory."""
        return self.atoms.reshape(self.size, -1)

    def checked(
        self, views: tuple[int, int], patch: tuple[int, int], colours: int = 3
    ) -> Dictionary:
        """Return the dictionary, or raise DictionaryError naming what does not fit.

        views: rows and columns of views. patch: rows and columns of pixels.
        """
        has_v, has_u, has_y, has_x, has_c = self.patch_shape
        faults = [
            (f"{has_v}x{has_u} views", f"{views[0]}x{views[1]}", (has_v, has_u) != tuple(views)),
            (f"{has_y}x{has_x} pixels", f"{patch[0]}x{patch[1]}", (has_y, has_x) != tuple(patch)),
            (f"{has_c} colour(s)", f"{colours}", has_c != colours),
        ]
        told = [f"{has}, not {needs}" for has, needs, differs in faults if differs]
        if told:
            raise DictionaryError(
                f"the dictionary's patches have {'; '.join(told)}: "
                "train or choose a dictionary for these patches"
            )
        return self

    def save(self, path: str | os.PathLike) -> None:
        """Write HDF5 (checksummed); the file appears whole or not at all.

        Raises DictionaryError when it cannot be written.
        """
        path = Path(path)
        partial = path.with_name(f".{path.name}.{os.getpid()}.part")
        atom_bytes = self.atoms[0].nbytes
        rows = min(self.size, max(1, _CHUNK_BYTES // atom_bytes))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with h5py.File(partial, "w") as file:
                file.attrs["format"] = FORMAT
                file.attrs["kind"] = self.kind
                file.create_dataset(
                    "atoms",
                    data=self.atoms,
                    chunks=(rows, *self.atoms.shape[1:]),
                    fletcher32=True,
                )
                file["provenance"] = self.provenance
            os.replace(partial, path)
        except OSError as fault:
            raise DictionaryError(f"{path}: cannot be written ({_one_line(fault)})") from fault
        finally:
            partial.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Dictionary:
        """Read what `save` wrote.

        Raises DictionaryError: no such file, not HDF5, cut short or damaged, or no dictionary.
        """
        path = Path(path)
        if not path.is_file():
            raise DictionaryError(f"{path}: no such file; `emmc-rig train` makes a dictionary")
        try:
            with h5py.File(path, "r") as file:
                found = file.attrs.get("format")
                if found != FORMAT:
                    raise DictionaryError(
                        f"{path}: not a dictionary of this program (format {found!r}, "
                        f"needs {FORMAT!r}); `emmc-rig train` makes one"
                    )
                atoms, kind = file["atoms"][()], file.attrs["kind"]
                provenance = file["provenance"].asstr()[()]
        except (OSError, RuntimeError, KeyError, AttributeError, TypeError) as fault:
            raise DictionaryError(
                f"{path}: damaged or cut short ({_one_line(fault)}); copy it again or train anew"
            ) from fault
        try:
            return cls(atoms, kind, provenance)
        except DictionaryError as fault:
            raise DictionaryError(f"{path}: {fault}") from fault


def _norms(atoms: NDArray[np.floating], kind: str) -> NDArray[np.float64]:
    """Return the norm of every atom, or raise DictionaryError for what is no set of atoms."""
    if kind not in KINDS:
        raise DictionaryError(f"unknown kind of dictionary '{kind}': one of {', '.join(KINDS)}")
    atoms = np.asarray(atoms)
    if atoms.ndim != 6 or atoms.size == 0 or not np.issubdtype(atoms.dtype, np.floating):
        raise DictionaryError(
            f"atoms of shape {atoms.shape} and type {atoms.dtype}: "
            "needs floating (atom, v, u, y, x, c), none of them 0"
        )
    rows = atoms.reshape(len(atoms), -1)
    norms = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))
    wrong = np.flatnonzero(~np.isfinite(norms))
    if wrong.size:
        raise DictionaryError(f"atom {wrong[0]} holds values that are not finite")
    return norms


def _one_line(fault: Exception) -> str:
    return " ".join(str(fault).split())

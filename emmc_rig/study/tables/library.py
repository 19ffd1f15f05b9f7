"""The scenes of the tables, by name: checked, identified by their content, cut to the middle."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.scenes import open_scene
from simulators.scenes import SCENES

Array = NDArray[np.float32]
Size = tuple[int, int] | None
VIEWS = (5, 5)
SMALLEST_PX = 16
_KEPT_BYTES = 500 * 2**20
_ENDINGS = (".h5", ".hdf5")


def scene_specs(folder: Path | None) -> dict[str, str]:
    """Return what `open_scene` calls each scene of a folder, by name; the built-in ones for None.

    Raises AppError for no such folder, one without scenes, and scenes of the same name.
    """
    if folder is None:
        return {name: name for name in SCENES}
    if not folder.is_dir():
        raise AppError(f"--scenes {folder}: no such folder")
    if any(folder.glob("view_*_*.png")):
        raise AppError(
            f"--scenes {folder}: is itself a scene; give the folder that holds it and others"
        )
    specs: dict[str, str] = {}
    for path in sorted(folder.iterdir()):
        is_folder = path.is_dir() and any(path.glob("view_*_*.png"))
        if not is_folder and not (path.is_file() and path.suffix.lower() in _ENDINGS):
            continue
        name = path.name if is_folder else path.stem
        if name in specs:
            raise AppError(f"--scenes {folder}: two scenes are called '{name}'; rename one")
        specs[name] = str(path.resolve())
    if not specs:
        raise AppError(
            f"--scenes {folder}: no scenes; needed is a folder of view_ROW_COL.png, or an HDF5 "
            "light field, for each"
        )
    return specs


@dataclass(frozen=True)
class Cut:
    """The middle `size` (rows, columns), all without one, down to a multiple of k pixels."""

    size: Size = None
    multiple: int = 1


def middle(light_field: Array, cut: Cut) -> Array:
    """Return the middle of a light field (v, u, y, x, c); less where there is less."""
    has = light_field.shape[2:4]
    wanted = cut.size or has
    kept = [min(w, n) // cut.multiple * cut.multiple for w, n in zip(wanted, has, strict=True)]
    starts = [(whole - part) // 2 for whole, part in zip(has, kept, strict=True)]
    rows, columns = (slice(s, s + n) for s, n in zip(starts, kept, strict=True))
    return np.ascontiguousarray(light_field[:, :, rows, columns])


@dataclass
class Library:
    """Opens scenes by name; keeps the last ones, as many as fit in half a gigabyte.

    cuts: all that will be asked for, so that a scene is read once for all of them.
    """

    specs: dict[str, str]
    cuts: tuple[Cut, ...]
    seed: int = 0
    _kept: OrderedDict[tuple[str, Cut], Array] = field(default_factory=OrderedDict)
    _digests: dict[str, str] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """All names, in order."""
        return list(self.specs)

    def light_field(self, name: str, cut: Cut) -> Array:
        """Return a cut of a scene (v, u, y, x, c), 5x5 views.

        Raises SceneError for a scene that cannot be read, AppError for one that is too small.
        """
        key = name, cut
        if key not in self._kept:
            self._open(name, cut)
        self._kept.move_to_end(key)
        return self._kept[key]

    def digest(self, name: str) -> str:
        """Return a digest of the whole scene's samples."""
        if name not in self._digests:
            self._open(name, self.cuts[0])
        return self._digests[name]

    def _open(self, name: str, asked: Cut) -> None:
        whole = open_scene(self.specs[name], views=VIEWS, seed=self.seed).light_field
        if min(whole.shape[2:4]) < SMALLEST_PX:
            raise AppError(
                f"{self.specs[name]}: {whole.shape[2]}x{whole.shape[3]} pixels, needs "
                f"{SMALLEST_PX}x{SMALLEST_PX} or more; leave the scene out"
            )
        self._digests.setdefault(name, _digest(whole))
        for cut in (*(cut for cut in self.cuts if cut != asked), asked):
            self._keep((name, cut), middle(whole, cut))

    def _keep(self, key: tuple[str, Cut], light_field: Array) -> None:
        self._kept[key] = light_field
        while (
            sum(kept.nbytes for kept in self._kept.values()) > _KEPT_BYTES and len(self._kept) > 1
        ):
            self._kept.popitem(last=False)


def _digest(light_field: Array) -> str:
    digest = hashlib.blake2b(str(light_field.shape).encode(), digest_size=12)
    digest.update(np.ascontiguousarray(light_field).data)
    return digest.hexdigest()

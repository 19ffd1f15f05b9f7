"""Scenes of the tables, cut to their middle, and the dictionary, which must not have seen them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.json_text import parse_json
from emmc_rig.study.rows import SMALLEST_PX
from emmc_rig.study.tables import paper
from reconstruction.dictionary import Dictionary
from simulators.scenes import SCENES

Array = NDArray[np.float32]
Size = tuple[int, int] | None
VIEWS = (5, 5)
_ENDINGS = (".h5", ".hdf5")
UNTRAINED = ("dct", "lambertian")
"""Kinds of dictionaries that are made by formula."""


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


def middle(light_field: Array, size: Size, multiple: int = 1) -> Array:
    """Return the middle of a light field (v, u, y, x, c), down to a multiple of so many pixels.

    size: rows and columns at most; None takes all.
    """
    has = light_field.shape[2:4]
    kept = [min(w, n) // multiple * multiple for w, n in zip(size or has, has, strict=True)]
    starts = [(whole - part) // 2 for whole, part in zip(has, kept, strict=True)]
    rows, columns = (slice(s, s + n) for s, n in zip(starts, kept, strict=True))
    return np.ascontiguousarray(light_field[:, :, rows, columns])


@dataclass(frozen=True)
class Scenes:
    """The scenes by name; see `scene_specs`."""

    specs: dict[str, str]
    seed: int = 0

    @property
    def names(self) -> list[str]:
        """All names, in order."""
        return list(self.specs)

    def light_field(self, name: str, size: Size = None, multiple: int = 1) -> Array:
        """Return the `middle` of a scene (v, u, y, x, c), 5x5 views.

        Raises SceneError for a scene that cannot be read, AppError for one that is too small.
        """
        return middle(_opened(self.specs[name], self.seed), size, multiple)

    def identity(self, name: str) -> list[float]:
        """Return sums over a whole scene's samples, by which it is known again."""
        return list(_sums(self.specs[name], self.seed))


@lru_cache(maxsize=2)
def _opened(spec: str, seed: int) -> Array:
    whole = open_scene(spec, views=VIEWS, seed=seed).light_field
    if min(whole.shape[2:4]) < SMALLEST_PX:
        raise AppError(
            f"{spec}: {whole.shape[2]}x{whole.shape[3]} pixels, needs "
            f"{SMALLEST_PX}x{SMALLEST_PX} or more; leave the scene out"
        )
    return whole


@lru_cache
def _sums(spec: str, seed: int) -> tuple[float, float]:
    whole = _opened(spec, seed)
    return float(whole.sum(dtype=np.float64)), float(np.square(whole, dtype=np.float64).sum())


def is_among(name: str, names: Sequence[str]) -> bool:
    """Return whether a scene is among others, by folder name or by what the paper calls it."""
    known = paper.known_as(name)
    return any(
        other.lower() == name.lower() or (known is not None and paper.known_as(other) == known)
        for other in names
    )


def trained_on(dictionary: Dictionary) -> list[str] | None:
    """Return the names of the scenes that a dictionary learned from; None when it does not say."""
    if dictionary.kind in UNTRAINED:
        return []
    try:
        scenes = parse_json(dictionary.provenance, "provenance", ValueError)["scenes"]
        names = [scene["name"] if isinstance(scene, dict) else scene for scene in scenes]
        return [Path(name).stem for name in names] or None
    except (ValueError, KeyError, TypeError):
        return None


def check_dictionary(
    dictionary: Dictionary, spec: str, scenes: Sequence[str], binning: int
) -> None:
    """Check that a dictionary fits the pixels, and saw none of the scenes that it shall score.

    Raises AppError, also for one that does not say what it saw.
    """
    rows, columns = dictionary.patch_shape[2:4]
    if rows % binning or columns % binning:
        raise AppError(
            f"--dictionary {spec}: pixels of {binning}x{binning} samples (r = 1/{binning**2}) need "
            f"patches that are a multiple of {binning}, these are {rows}x{columns}; leave those "
            "tables out with --only"
        )
    names = trained_on(dictionary)
    if names is None:
        raise AppError(
            f"--dictionary {spec}: does not say which scenes it was trained on, so nothing can be "
            "scored with it; train it with benchmarks/train_dictionary.py"
        )
    seen = [scene for scene in scenes if is_among(scene, names)]
    if seen:
        raise AppError(
            f"--dictionary {spec}: was trained on '{seen[0]}', which is to be scored; train "
            "without it, or leave --dictionary out"
        )

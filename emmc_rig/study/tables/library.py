"""Scenes of the tables, cut to their middle; the dictionary for each: never trained on that scene.

Dictionaries: leave-one-out training on the other given scenes, kept in the output folder with its
provenance; or a given file, whose training scenes are looked up; or one that needs no training.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.settings import Settings
from emmc_rig.progress import Watcher
from emmc_rig.study.sweep import digest_of
from emmc_rig.study.tables import paper
from reconstruction.dictionary import Dictionary, dct_dictionary, lambertian_dictionary
from reconstruction.learning import LearningSettings, learn_ksvd
from reconstruction.training_patches import PatchSettings, training_patches
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


TRAINING_FREE = ("dct", "lambertian")


class TrainingSettings(Settings):
    """How the leave-one-out dictionaries are trained.

    Where pixels sum 2x2 samples, patches must be of an even size: the paper's 9x9 are not.
    """

    cut: Cut = Cut()
    patch: int = Field(default=9, ge=2)
    binned_patch: int = Field(default=8, ge=2, multiple_of=2)
    patches: PatchSettings = Field(default_factory=PatchSettings)
    learning: LearningSettings = Field(default_factory=LearningSettings)


class Source(Protocol):
    """Where dictionaries come from."""

    def recipe(self, scene: str, binning: int) -> dict:
        """Return plain data that says which dictionary scores a scene."""
        ...

    def label(self, scene: str, binning: int) -> str:
        """Return the same in a few words."""
        ...

    def dictionary(self, scene: str, binning: int, watcher: Watcher) -> Dictionary:
        """Return it, made where it is missing."""
        ...


def one_of(name: str, names: Sequence[str]) -> bool:
    """Say whether a scene is among others, by folder name or by what the paper calls it."""
    known = paper.known_as(name)
    return any(
        other.lower() == name.lower() or (known is not None and paper.known_as(other) == known)
        for other in names
    )


@dataclass
class LeaveOneOut:
    """Trains on all given scenes but the one that is scored."""

    library: Library
    settings: TrainingSettings
    folder: Path

    def others(self, scene: str) -> list[str]:
        """Return the scenes to train on: none of the name or the content of the scored one."""
        digest = self.library.digest(scene)
        found = [
            name
            for name in self.library.names
            if not one_of(name, [scene]) and self.library.digest(name) != digest
        ]
        if not found:
            raise AppError(
                f"no other scene to train a dictionary for '{scene}' on: give a second scene, or "
                "--dictionary lambertian, which needs no training"
            )
        return found

    def _patch(self, binning: int) -> int:
        return self.settings.patch if binning == 1 else self.settings.binned_patch

    def recipe(self, scene: str, binning: int) -> dict:
        """Return the training scenes with their digests, and the settings."""
        return {
            "kind": "ksvd",
            "patch": self._patch(binning),
            "scenes": {name: self.library.digest(name) for name in self.others(scene)},
            "settings": self.settings.model_dump(mode="json"),
        }

    def label(self, scene: str, binning: int) -> str:
        """Return the number of atoms asked for, and the scene left out."""
        patch = self._patch(binning)
        return f"K-SVD, {self.settings.learning.atoms} atoms, {patch}x{patch}, without {scene}"

    def dictionary(self, scene: str, binning: int, watcher: Watcher) -> Dictionary:
        """Return the one kept in the folder, or train it; a damaged file is replaced."""
        recipe, patch = self.recipe(scene, binning), self._patch(binning)
        path = self.folder / f"without-{scene}-{patch}x{patch}-{digest_of(recipe)[:10]}.h5"
        if path.is_file():
            return Dictionary.load(path)
        found = self._train(list(recipe["scenes"]), patch, f"train without {scene}", watcher)
        learned = Dictionary.normalised(found, "ksvd", json.dumps(recipe))
        learned.save(path)
        return learned

    def _train(self, scenes: list[str], patch: int, stage: str, watcher: Watcher):
        learning = self.settings.learning
        watcher.begin(f"{stage}, {patch}x{patch} patches", 2 * len(scenes) + learning.iterations)
        wanted = self.settings.patches.model_copy(update={"rows": patch, "columns": patch})
        openers = [
            lambda name=name: self.library.light_field(name, self.settings.cut) for name in scenes
        ]
        patches = training_patches(
            openers, wanted, on_scene=lambda number: watcher.step(scenes[number])
        )
        shape = patches.shape[1:]
        state = learn_ksvd(
            patches.reshape(len(patches), -1),
            shape,
            learning,
            on_step=lambda state: watcher.step(f"error {state.history[-1].updated_rmse:.4f}"),
        )
        return state.atoms.reshape(-1, *shape)


@dataclass
class Given:
    """Dictionaries that the user names: files, or those that need no training.

    by_binning: for each pixel size that is asked for, the name and the first that fits.
    """

    by_binning: dict[int, tuple[str, Dictionary]]

    @classmethod
    def opened(cls, specs: Sequence[str], binnings: Sequence[int], scenes: Sequence[str]) -> Given:
        """Open them; raises AppError when none fits a pixel size, or one saw a scored scene."""
        files = {spec: Dictionary.load(spec) for spec in specs if spec not in TRAINING_FREE}
        for spec, dictionary in files.items():
            check_not_trained_on(dictionary, spec, scenes)
        chosen = {}
        for k in binnings:
            fitting = (
                (Path(spec).name, found)
                for spec in specs
                if (found := files.get(spec) or _made(spec, k)) is not None
                and not any(n % k for n in found.patch_shape[2:4])
            )
            first = next(fitting, None)
            if first is None:
                raise AppError(
                    f"--dictionary: pixels of {k}x{k} samples (r = 1/{k * k}) need patches that "
                    f"are a multiple of {k}; give another file as well, or leave those tables out "
                    "with --only"
                )
            chosen[k] = first
        return cls(chosen)

    def recipe(self, scene: str, binning: int) -> dict:
        """Return the digest of the atoms."""
        atoms = self.by_binning[binning][1].atoms
        return {"kind": "given", "atoms": hashlib.blake2b(atoms.data, digest_size=12).hexdigest()}

    def label(self, scene: str, binning: int) -> str:
        """Return the name, and what is in it."""
        name, dictionary = self.by_binning[binning]
        rows, columns = dictionary.patch_shape[2:4]
        return f"{name}: {dictionary.kind}, {dictionary.size} atoms, {rows}x{columns}"

    def dictionary(self, scene: str, binning: int, watcher: Watcher) -> Dictionary:
        """Return the dictionary."""
        return self.by_binning[binning][1]


def _made(spec: str, binning: int) -> Dictionary:
    """Return one that needs no training: 9x9, or the nearest multiple of k below."""
    side = 9 // binning * binning
    make = dct_dictionary if spec == "dct" else lambertian_dictionary
    return make(VIEWS, (side, side))


def trained_on(dictionary: Dictionary) -> list[str] | None:
    """Return the names of the scenes that a dictionary learned from; None when it does not say."""
    if dictionary.kind in TRAINING_FREE:
        return []
    try:
        scenes = parse_json(dictionary.provenance, "provenance", ValueError)["scenes"]
        names = [scene["name"] if isinstance(scene, dict) else scene for scene in scenes]
        return [Path(name).stem for name in names] or None
    except (ValueError, KeyError, TypeError):
        return None


def check_not_trained_on(dictionary: Dictionary, spec: str, scenes: Sequence[str]) -> None:
    """Raise AppError when a dictionary has seen one of the scenes, or does not say what it saw."""
    names = trained_on(dictionary)
    if names is None:
        raise AppError(
            f"--dictionary {spec}: does not say which scenes it was trained on, so nothing can be "
            "scored with it; make it with benchmarks/train_dictionary.py"
        )
    leaked = [scene for scene in scenes if one_of(scene, names)]
    if leaked:
        raise AppError(
            f"--dictionary {spec}: was trained on '{leaked[0]}', which is to be scored; train "
            "without it, or leave --dictionary out (leave-one-out training)"
        )

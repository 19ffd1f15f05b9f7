"""The dictionary for each scored scene: never one that was trained on it.

Leave-one-out training on the other given scenes, kept in the output folder with its provenance;
or a given file, whose training scenes are looked up; or one that needs no training.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pydantic import Field

from emmc_rig.errors import AppError
from emmc_rig.model.settings import Settings
from emmc_rig.progress import Watcher
from emmc_rig.study.sweep import digest_of
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.library import VIEWS, Cut, Library
from reconstruction.dictionary import Dictionary, dct_dictionary, lambertian_dictionary
from reconstruction.learning import LearningSettings, learn_ksvd
from reconstruction.training_patches import PatchSettings, training_patches

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
        scenes = json.loads(dictionary.provenance)["scenes"]
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
            "scored with it; train it with `emmc-rig train`"
        )
    leaked = [scene for scene in scenes if one_of(scene, names)]
    if leaked:
        raise AppError(
            f"--dictionary {spec}: was trained on '{leaked[0]}', which is to be scored; train "
            "without it, or leave --dictionary out (leave-one-out training)"
        )

"""Train a dictionary: scenes in, a dictionary file and a picture of its atoms out."""

from __future__ import annotations

import difflib
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError, StoppedError
from emmc_rig.files.folders import new_file, refuse_inside_session, refuse_new_file
from emmc_rig.files.memory import peak_memory_mib
from emmc_rig.files.results import command_line, versions
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.settings import validated
from emmc_rig.progress import Watcher
from reconstruction.checkpoint import State, load_checkpoint, save_checkpoint
from reconstruction.dictionary import Dictionary
from reconstruction.learning import LearningSettings, LearningState, fixed_atoms, learn_ksvd
from reconstruction.online import OnlineState, learn_online
from reconstruction.separable import (
    SeparableSettings,
    SeparableState,
    learn_separable,
    separable_dictionary,
)
from reconstruction.training_patches import PatchSettings, training_patches
from simulators.scenes import SCENES

Learner = tuple[Callable[..., Any], type]
LEARNERS: dict[str, Learner] = {
    "ksvd": (learn_ksvd, LearningState),
    "online": (learn_online, OnlineState),
    "separable": (learn_separable, SeparableState),
}
BUILT_IN_SEEDS = 3
_CHECKPOINT_EVERY_S = 60.0
_KEPT_SCENE_BYTES = 32 << 20
_SHOWN_ATOMS = 400
_ZOOM = 3
_GAP_PX = 2


@dataclass(frozen=True)
class Source:
    """A scene to train on: its name, what to open, and the seed where it is a built-in one."""

    name: str
    spec: str
    seed: int = 0

    def open(self, views: tuple[int, int] | None) -> NDArray[np.float32]:
        """Return the light field (v, u, y, x, c), its middle views where `views` says how many."""
        return open_scene(self.spec, views=views, seed=self.seed).light_field


@dataclass(frozen=True)
class TrainSettings:
    """What to train, on what, and where to write it."""

    out: Path
    scenes: Sequence[str] = ()
    leave_out: Sequence[str] = ()
    views: tuple[int, int] | None = None
    kind: str = "ksvd"
    learning: LearningSettings | SeparableSettings = field(default_factory=LearningSettings)
    patches: PatchSettings = field(default_factory=PatchSettings)
    resume: bool = False


def train_settings(
    out: Path,
    scenes: Sequence[str],
    leave_out: Sequence[str],
    views: tuple[int, int] | None,
    kind: str,
    chosen: Mapping[str, Mapping[str, object]],
    resume: bool,
) -> TrainSettings:
    """Return the settings, `chosen` checked: plain data for "patches" and "learning".

    Raises AppError for an unknown kind and for values out of range.
    """
    if kind not in LEARNERS:
        raise AppError(f"--kind {kind}: one of {', '.join(LEARNERS)}")
    learning = SeparableSettings if kind == "separable" else LearningSettings
    return TrainSettings(
        out=out,
        scenes=scenes,
        leave_out=leave_out,
        views=views,
        kind=kind,
        learning=validated(learning, dict(chosen["learning"]), "training", AppError),
        patches=validated(PatchSettings, dict(chosen["patches"]), "training patches", AppError),
        resume=resume,
    )


def find_sources(scenes: Sequence[str], leave_out: Sequence[str]) -> list[Source]:
    """Return the scenes to train on.

    Args:
        scenes: folders of scenes, single scenes (a folder of views, an HDF5 file) and built-in
            names; none: every built-in scene. Built-in ones come with several seeds.
        leave_out: names of scenes not to use: of a folder, a file less its ending, a built-in one.

    Raises:
        AppError: a folder that holds no scene, a name to leave out that none has (it names the
            nearest), or nothing left.
    """
    sources: list[Source] = []
    for spec in scenes or SCENES:
        sources += _sources(spec)
    names = sorted({source.name for source in sources})
    for name in leave_out:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1, cutoff=0.4)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(names)}"
            raise AppError(f"--leave-out {name}: no scene of that name; {hint}")
    kept = [source for source in sources if source.name not in leave_out]
    if not kept:
        raise AppError("--leave-out leaves no scene to train on")
    return kept


def _sources(spec: str) -> list[Source]:
    if spec in SCENES:
        return [Source(spec, spec, seed) for seed in range(BUILT_IN_SEEDS)]
    folder = Path(spec)
    if not folder.is_dir() or any(folder.glob("view_*_*.png")):
        return [Source(folder.resolve().stem, spec)]
    inner = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in (".h5", ".hdf5")
        or (path.is_dir() and any(path.glob("view_*_*.png")))
    ]
    if not inner:
        raise AppError(
            f"--scenes {spec}: holds no scenes, which are folders of view_ROW_COL.png or HDF5 files"
        )
    return [Source(path.stem, str(path)) for path in inner]


def _opened_once(
    source: Source, views: tuple[int, int] | None
) -> Callable[[], NDArray[np.float32]]:
    """Return what opens a scene; a small one, slow to render, is kept for the second pass."""
    kept: list[NDArray[np.float32]] = []

    def scene() -> NDArray[np.float32]:
        if kept:
            return kept.pop()
        light_field = source.open(views)
        if light_field.nbytes <= _KEPT_SCENE_BYTES:
            kept.append(light_field)
        return light_field

    return scene


def checkpoint_path(out: Path) -> Path:
    """Return where the checkpoint of a training that writes `out` is."""
    return out.with_name(f"{out.stem}.checkpoint.h5")


def train(
    settings: TrainSettings,
    watcher: Watcher,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[Dictionary, dict[str, Any]]:
    """Train, and write the dictionary to `settings.out` and its picture beside it.

    A checkpoint is written about every minute and when the training is interrupted; it goes when
    the dictionary is written. Returns the dictionary and its provenance.

    Raises:
        AppError: scenes not found, `out` in the way, or a checkpoint where none is expected.
        StoppedError: by Ctrl-C.
        DictionaryError: what the learner says of patches, settings and checkpoint.
    """
    out, kept = settings.out, checkpoint_path(settings.out)
    check_new_file(out, "a dictionary's")
    refuse_new_file(picture_path(out))
    if kept.exists() and not settings.resume:
        raise AppError(
            f"{kept}: an earlier training stopped there; give --resume to go on, or delete it"
        )
    if settings.resume and not kept.exists():
        raise AppError(f"{kept}: no checkpoint to resume from; train without --resume")
    sources = find_sources(settings.scenes, settings.leave_out)
    started = clock()
    watcher.begin("reading scenes", 2 * len(sources))
    patches = training_patches(
        [_opened_once(source, settings.views) for source in sources],
        settings.patches,
        lambda number: watcher.step(sources[number].name),
    )
    shape = patches.shape[1:]
    rows = patches.reshape(len(patches), -1)
    read_s = clock() - started
    learn, kind = LEARNERS[settings.kind]
    purpose = {
        "kind": settings.kind,
        "scenes": sorted({source.name for source in sources}),
        "patches": settings.patches.model_dump(),
        "settings": settings.learning.model_dump(exclude={"iterations"}),
        "data": hashlib.blake2b(np.ascontiguousarray(rows).data, digest_size=16).hexdigest(),
    }
    start = load_checkpoint(kept, kind, purpose) if settings.resume else None
    state: State | None = start
    saved_at, saved_steps = clock(), len(start.history) if start else 0
    watcher.begin("learning", settings.learning.iterations)
    for _ in range(saved_steps):
        watcher.step("resumed")

    def on_step(done: State) -> None:
        nonlocal state, saved_at, saved_steps
        state = done
        watcher.step(f"error {done.history[-1].coded_rmse:.5f}")
        if clock() - saved_at > _CHECKPOINT_EVERY_S:
            save_checkpoint(kept, done, purpose)
            saved_at, saved_steps = clock(), len(done.history)

    try:
        final = learn(rows, shape, settings.learning, start, on_step)
    except KeyboardInterrupt:
        if state is None:
            outcome = "before the first step; nothing was written"
        else:
            if saved_steps < len(state.history):
                save_checkpoint(kept, state, purpose)
            outcome = (
                f"after step {len(state.history)} of {settings.learning.iterations}, which {kept} "
                "keeps; the same command with --resume goes on"
            )
        raise StoppedError(f"stopped by Ctrl-C {outcome}") from None
    provenance = {
        **{key: purpose[key] for key in ("kind", "scenes", "patches", "data")},
        "sources": [f"{s.spec}, seed {s.seed}" if s.spec in SCENES else s.spec for s in sources],
        "left_out": list(settings.leave_out),
        "settings": settings.learning.model_dump(),
        "resumed": settings.resume,
        "history": [asdict(done) for done in final.history],
        "reading_seconds": read_s,
        "learning_seconds": clock() - started - read_s,
        "peak_memory_gib": peak_memory_mib() / 2**10,
        "command": command_line(),
        "versions": versions(),
    }
    dictionary = _dictionary(settings, final, rows, shape, json.dumps(provenance, indent=1))
    with new_file(out) as written, new_file(picture_path(out)) as drawn:
        dictionary.save(written)
        if not cv2.imwrite(str(drawn), draw_atoms(dictionary)):
            raise AppError(f"{picture_path(out)}: cannot be written")
    kept.unlink(missing_ok=True)
    return dictionary, provenance


def picture_path(out: Path) -> Path:
    """Return where the picture of the atoms is."""
    return out.with_suffix(".png")


def draw_atoms(dictionary: Dictionary) -> NDArray[np.uint8]:
    """Draw the first atoms, as 8-bit BGR: of each its centre view and, below, a horizontal EPI.

    Mid-grey is 0, and every atom has its own contrast. The EPI is of the middle row of pixels,
    with the views of the middle row from top to bottom: its slope is the disparity.
    """
    atoms = dictionary.atoms[:_SHOWN_ATOMS]
    views_v, views_u, height, width, colours = dictionary.patch_shape
    centre = atoms[:, views_v // 2, views_u // 2]
    epi = atoms[:, views_v // 2, :, height // 2]
    gap = np.zeros((len(atoms), 1, width, colours), np.float32)
    tiles = np.concatenate([centre, gap, epi], axis=1)
    tiles = 0.5 + 0.5 * tiles / np.abs(tiles).max(axis=(1, 2, 3), keepdims=True)
    tiles = np.repeat(np.repeat(tiles, _ZOOM, axis=1), _ZOOM, axis=2)
    columns = max(1, int(np.ceil(np.sqrt(len(tiles) * tiles.shape[1] / tiles.shape[2]))))
    rows = -(-len(tiles) // columns)
    down, right = tiles.shape[1] + 2 * _GAP_PX, tiles.shape[2] + _GAP_PX
    sheet = np.zeros((rows * down, columns * right, 3), np.float32)
    for i, tile in enumerate(tiles):
        y, x = i // columns * down, i % columns * right
        sheet[y : y + tile.shape[0], x : x + tile.shape[1]] = tile[..., ::-1]
    return np.rint(sheet * 255).astype(np.uint8)


def check_new_file(out: Path, whose: str, endings: Sequence[str] = (".h5", ".hdf5")) -> None:
    """Raise AppError when a file could not be written there, before hours of training."""
    if out.suffix.lower() not in endings:
        raise AppError(f"--out {out}: {whose} file ends in {endings[0]}")
    refuse_inside_session(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise AppError(f"--out {out}: cannot be written ({fault.strerror})") from fault
    refuse_new_file(out)


def _dictionary(
    settings: TrainSettings,
    state: State,
    patches: NDArray[np.float32],
    patch_shape: tuple[int, ...],
    provenance: str,
) -> Dictionary:
    """Return the learnt atoms, after the flat ones in the order of the energy they carry."""
    learning = settings.learning
    if isinstance(state, SeparableState):
        assert isinstance(learning, SeparableSettings)
        return separable_dictionary(state, patches, patch_shape, learning, provenance)
    assert isinstance(learning, LearningSettings)
    if isinstance(state, LearningState):
        energy = np.zeros(len(state.atoms))
        used = state.indices >= 0
        np.add.at(energy, state.indices[used], np.square(state.coefficients[used]))
    else:
        energy = np.diagonal(state.code_sums).copy()
    energy[: len(fixed_atoms(learning, patch_shape))] = np.inf
    atoms = state.atoms[np.argsort(-energy, kind="stable")]
    return Dictionary.normalised(atoms.reshape(-1, *patch_shape), settings.kind, provenance)

"""Makes a dictionary of patches of given scenes by K-SVD, for `--dictionary FILE` of emmc-rig.

    python benchmarks/train_dictionary.py --scene SCENES/knights --scene near-planar --out mine.h5

A scene is a folder of view_ROW_COL.png, an HDF5 light field or the name of a built-in one. Beside
the dictionary lies a picture of its atoms. Ctrl-C leaves a checkpoint; the same line goes on.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from learning import Iteration, LearningSettings, LearningState, learn_ksvd
from numpy.typing import NDArray
from training_patches import PatchSettings, training_patches

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.files import whole_file
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.store.folders import new_file
from emmc_rig.store.results import command_line, parse_size, versions

CHECKPOINT_INTERVAL_S = 60.0
SHOWN_ATOMS, ZOOM, GAP_PX = 400, 3, 2


def main() -> None:
    """Train as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", action="append", default=[])
    parser.add_argument("--out", type=Path, default=Path("dictionary.h5"))
    parser.add_argument("--patch", default="9x9", help="ROWSxCOLUMNS")
    parser.add_argument("--patches", type=int, default=10_000)
    parser.add_argument("--atoms", type=int, default=1024)
    parser.add_argument("--sparsity", type=int, default=8, help="atoms of a patch, at most")
    parser.add_argument("--iterations", type=int, default=15)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smallest", action="store_true", help="one built-in scene, two steps")
    options = parser.parse_args()
    if options.smallest:
        options.scene, options.patch, options.patches = ["near-planar"], "4x4", 200
        options.atoms, options.sparsity, options.iterations = 24, 3, 2
    if not options.scene:
        parser.error("--scene is needed, once for each scene")
    size = parse_size(options.patch, "--patch", "9x9") or (9, 9)
    learning = LearningSettings(
        atoms=options.atoms, sparsity=options.sparsity, iterations=options.iterations,
        seed=options.seed,
    )  # fmt: skip
    patches = PatchSettings(rows=size[0], columns=size[1], count=options.patches, seed=options.seed)
    dictionary = train(options.out, options.scene, patches, learning)
    print(f"wrote {options.out}: {dictionary.size} atoms of {len(options.scene)} scene(s)")


def train(
    out: Path, scenes: list[str], patching: PatchSettings, learning: LearningSettings
) -> Dictionary:
    """Write a dictionary learned from scenes to `out`, and the picture of its atoms beside it."""
    picture, kept = out.with_suffix(".png"), out.with_suffix(".checkpoint.npz")
    if out.suffix not in (".h5", ".hdf5"):
        raise AppError(f"--out {out}: a dictionary's file ends in .h5")
    for path in (out, picture):
        if path.exists():
            raise AppError(f"{path}: exists already; choose another name")
    patches = training_patches(
        [lambda spec=spec: open_scene(spec).light_field for spec in scenes],
        patching,
        lambda number: print(f"read {scenes[number]}"),
    )
    shape, rows = patches.shape[1:], patches.reshape(len(patches), -1)
    recipe = json.dumps(
        {
            "kind": "ksvd",
            "scenes": sorted({Path(spec).stem for spec in scenes}),
            "patches": patching.model_dump(),
            "settings": learning.model_dump(exclude={"iterations"}),
            "data": hashlib.blake2b(np.ascontiguousarray(rows).data, digest_size=16).hexdigest(),
        }
    )
    start = load_checkpoint(kept, recipe) if kept.exists() else None
    steps, saved_at = [start] if start else [], time.perf_counter()

    def on_step(state: LearningState) -> None:
        nonlocal saved_at
        steps[:] = [state]
        done = state.history[-1]
        print(f"step {done.step} of {learning.iterations}: error {done.updated_rmse:.5f}")
        if time.perf_counter() - saved_at > CHECKPOINT_INTERVAL_S:
            save_checkpoint(kept, recipe, state)
            saved_at = time.perf_counter()

    try:
        state = learn_ksvd(rows, shape, learning, start, on_step)
    except KeyboardInterrupt:
        if steps:
            save_checkpoint(kept, recipe, steps[0])
        sys.exit(f"stopped by Ctrl-C; the same command goes on from {kept}")
    provenance = {
        **json.loads(recipe),
        "sources": scenes,
        "settings": learning.model_dump(),
        "history": [asdict(done) for done in state.history],
        "command": command_line(),
        "versions": versions(),
    }
    atoms = state.atoms.reshape(-1, *shape)
    dictionary = Dictionary.normalised(atoms, "ksvd", json.dumps(provenance, indent=1))
    with new_file(out) as written, new_file(picture) as drawn:
        dictionary.save(written)
        cv2.imwrite(str(drawn), draw_atoms(dictionary))
    kept.unlink(missing_ok=True)
    return dictionary


def save_checkpoint(path: Path, recipe: str, state: LearningState) -> None:
    """Write a state of the training that a recipe describes."""
    history = json.dumps([asdict(done) for done in state.history])
    with whole_file(path) as partial, open(partial, "wb") as file:
        np.savez(
            file, recipe=recipe, history=history, atoms=state.atoms, indices=state.indices,
            coefficients=state.coefficients,
        )  # fmt: skip


def load_checkpoint(path: Path, recipe: str) -> LearningState:
    """Return the state that `save_checkpoint` wrote; raises AppError for another training's."""
    with np.load(path) as kept:
        if str(kept["recipe"]) != recipe:
            raise AppError(f"{path}: of a training of other patches or settings; delete it")
        history = tuple(Iteration(**done) for done in json.loads(str(kept["history"])))
        return LearningState(kept["atoms"], kept["indices"], kept["coefficients"], history)


def draw_atoms(dictionary: Dictionary) -> NDArray[np.uint8]:
    """Draw the first atoms, 8-bit BGR: of each its centre view and, below, a horizontal EPI.

    Mid-grey is 0, and every atom has its own contrast. The EPI is of the middle row of pixels in
    the views of the middle row: its slope is the disparity.
    """
    atoms = dictionary.atoms[:SHOWN_ATOMS]
    views_v, views_u, height, width, colours = dictionary.patch_shape
    gap = np.zeros((len(atoms), 1, width, colours), np.float32)
    epi = atoms[:, views_v // 2, :, height // 2]
    tiles = np.concatenate([atoms[:, views_v // 2, views_u // 2], gap, epi], axis=1)
    tiles = 0.5 + 0.5 * tiles / np.abs(tiles).max(axis=(1, 2, 3), keepdims=True)
    tiles = tiles.repeat(ZOOM, axis=1).repeat(ZOOM, axis=2)[..., ::-1]
    columns = max(1, int(np.ceil(np.sqrt(len(tiles) * tiles.shape[1] / tiles.shape[2]))))
    down, right = tiles.shape[1] + 2 * GAP_PX, tiles.shape[2] + GAP_PX
    sheet = np.zeros((-(-len(tiles) // columns) * down, columns * right, 3), np.float32)
    for i, tile in enumerate(tiles):
        y, x = i // columns * down, i % columns * right
        sheet[y : y + tile.shape[0], x : x + tile.shape[1]] = tile
    return np.rint(sheet * 255).astype(np.uint8)


if __name__ == "__main__":
    try:
        main()
    except ERRORS as fault:
        sys.exit(str(fault))

"""Makes a dictionary of patches of given scenes by K-SVD, for `--dictionary FILE` of emmc-rig.

    python benchmarks/train_dictionary.py --scene SCENES/knights --scene near-planar --out mine.h5

A scene is a folder of view_ROW_COL.png, an HDF5 light field or the name of a built-in one. Beside
the dictionary lies a picture of its atoms. The first atoms are flat, one for each opponent colour;
the others are learned from patches less their flat share (Aharon, Elad, Bruckstein 2006, "K-SVD: an
algorithm for designing overcomplete dictionaries for sparse representation"). Sparse codes are
those of scikit-learn.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import sparse_encode
from training_patches import Array, drawn_patches

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.store.folders import new_file
from emmc_rig.store.results import command_line, parse_size, versions

SHOWN_ATOMS, ZOOM, GAP_PX = 400, 3, 2
LEAST_CONTRAST = 1e-3
"""Standard deviation of the samples of a patch that is learned from; flat patches teach nothing."""


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
    train(options)


def train(options: argparse.Namespace) -> None:
    """Write a dictionary learned from scenes, and the picture of its atoms beside it.

    options: those of the command line. Raises AppError for files in the way and scenes that
    cannot be learned from.
    """
    out, picture = options.out, options.out.with_suffix(".png")
    if out.suffix not in (".h5", ".hdf5"):
        raise AppError(f"--out {out}: a dictionary's file ends in .h5")
    for path in (out, picture):
        if path.exists():
            raise AppError(f"{path}: exists already; choose another name")
    for name in ("patches", "atoms", "sparsity", "iterations"):
        if (number := getattr(options, name)) < 1:
            raise AppError(f"--{name} {number}: needs 1 or more")
    if options.sparsity > (learned := options.atoms - len(OPPONENT)):
        raise AppError(
            f"--sparsity {options.sparsity}: more than the {max(learned, 0)} atoms that are "
            f"learned, beside {len(OPPONENT)} flat ones; give --atoms more"
        )
    size = parse_size(options.patch, "--patch", "9x9") or (9, 9)
    rng = np.random.default_rng(options.seed)
    patches = patches_of(options.scene, -(-options.patches // len(options.scene)), size, rng)
    flat = flat_atoms(patches.shape[1:])
    rows = patches.reshape(len(patches), -1)
    rows = rows - (rows @ flat.T) @ flat
    rows = rows[rows.std(axis=1) > LEAST_CONTRAST]
    if len(rows) < options.atoms:
        raise AppError(
            f"{len(rows)} patches are not flat, too few for {options.atoms} atoms: give --patches "
            "more, or --atoms less"
        )
    atoms = learn_ksvd(
        rows, learned, options.sparsity, options.iterations, rng,
        lambda step, error: print(f"step {step} of {options.iterations}: error {error:.5f}"),
    )  # fmt: skip
    provenance = {
        "scenes": sorted({Path(spec).stem for spec in options.scene}),
        "command": command_line(),
        "versions": versions(),
    }
    atoms = np.concatenate([flat, atoms]).reshape(-1, *patches.shape[1:])
    dictionary = Dictionary.normalised(atoms, "ksvd", json.dumps(provenance, indent=1))
    with new_file(out) as written, new_file(picture) as drawn:
        dictionary.save(written)
        cv2.imwrite(str(drawn), draw_atoms(dictionary))
    print(f"wrote {out}: {dictionary.size} atoms of {len(options.scene)} scene(s)")


def patches_of(
    specs: list[str], count: int, size: tuple[int, int], rng: np.random.Generator
) -> Array:
    """Return `count` patches (patch, v, u, y, x, c) of every scene.

    Raises AppError for scenes of other views than the first, or smaller than a patch.
    """
    found: list[Array] = []
    for spec in specs:
        light_field = open_scene(spec).light_field
        if min(np.subtract(light_field.shape[2:4], size)) < 0:
            raise AppError(f"scene {spec}: smaller than a patch of {size[0]}x{size[1]} pixels")
        views = light_field.shape[:2]
        if found and views != found[0].shape[1:3]:
            raise AppError(
                f"scene {spec}: has {views[0]}x{views[1]} views, {specs[0]} has "
                f"{found[0].shape[1]}x{found[0].shape[2]}; train on scenes of the same views"
            )
        found.append(drawn_patches(light_field, count, size, rng))
        print(f"read {spec}")
    return np.concatenate(found)


def flat_atoms(patch_shape: tuple[int, ...]) -> Array:
    """Return constant atoms (colour, sample), one for each opponent colour, of unit norm."""
    samples = int(np.prod(patch_shape[:-1]))
    return np.tile(OPPONENT, samples).astype(np.float32) / np.float32(np.sqrt(samples))


def learn_ksvd(rows: Array, atoms: int, sparsity: int, iterations: int, rng, on_step) -> Array:
    """Return atoms (atom, sample) of unit norm, learned from patches (patch, sample).

    A step codes every patch by `sparsity` atoms at most, fewer where they explain it. Then a power
    iteration improves each atom, with its weights, on the patches coded by it (Rubinstein,
    Zibulevsky, Elad 2008). An atom without patches becomes the residual of the worst patch.

    on_step: called with the number of each step and the RMS error of a sample after it.
    """
    found = rows[rng.choice(len(rows), atoms, replace=False)]
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    for step in range(1, iterations + 1):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Orthogonal matching pursuit ended prematurely")
            codes = sparse_encode(rows, found, algorithm="omp", n_nonzero_coefs=sparsity)
        codes = codes.astype(np.float32)
        left = rows - codes @ found
        for atom in range(atoms):
            users = np.flatnonzero(codes[:, atom])
            if not users.size:
                worst = np.einsum("ij,ij->i", left, left).argmax()
                if length := np.linalg.norm(left[worst]):
                    found[atom] = left[worst] / length
                    left[worst] = 0
                continue
            own = left[users] + np.outer(codes[users, atom], found[atom])
            towards = codes[users, atom] @ own
            found[atom] = towards / np.linalg.norm(towards)
            codes[users, atom] = own @ found[atom]
            left[users] = own - np.outer(codes[users, atom], found[atom])
        on_step(step, float(np.sqrt(np.mean(np.square(left)))))
    return found


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

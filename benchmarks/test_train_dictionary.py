"""Training of dictionaries: planted atoms found, patches cut, files in the way refused, drawn."""

import sys

import numpy as np
import pytest
from train_dictionary import draw_atoms, flat_atoms, learn_ksvd, main
from training_patches import cut_patches

from emmc_rig.errors import AppError
from emmc_rig.model.lightfield import save_hdf5
from emmc_rig.reconstruction.dictionary import Dictionary


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Return a function that trains on two small scenes as the command line would."""
    rng = np.random.default_rng(0)
    sizes = {"--patch": "4x4", "--patches": "120", "--atoms": "24", "--sparsity": "3"}
    typed = [word for option in sizes.items() for word in option]
    for name, views in (("cat", 2), ("dog", 2), ("owl", 3)):
        scene = rng.random((views, views, 20, 24, 3), dtype=np.float32)
        save_hdf5(tmp_path / f"{name}.h5", scene, {})

    def trained(out, *more, scenes=("cat", "dog")):
        given = [word for name in scenes for word in ("--scene", str(tmp_path / f"{name}.h5"))]
        monkeypatch.setattr(sys, "argv", ["train", *typed, *given, *more, "--out", str(out)])
        main()
        return Dictionary.load(out)

    return trained


def test_a_dictionary_holds_flat_colours_and_atoms_of_its_scenes_by_the_seed(train, tmp_path):
    first, same, other = (
        train(tmp_path / f"{name}.h5", "--seed", seed)
        for name, seed in (("first", "1"), ("same", "1"), ("other", "2"))
    )
    assert first.size == 24
    assert '"cat"' in first.provenance
    np.testing.assert_array_equal(first.atoms, same.atoms)
    assert (first.atoms != other.atoms).any()
    rows = first.atoms.reshape(24, -1)
    np.testing.assert_allclose(rows[:3], flat_atoms(first.patch_shape), atol=1e-6)
    np.testing.assert_allclose(rows[3:] @ rows[:3].T, 0, atol=1e-5)


def test_planted_atoms_are_recovered():
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((40, 50)).astype(np.float32)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    codes = np.zeros((2000, 40), np.float32)
    for code in codes:
        code[rng.choice(40, 3, replace=False)] = rng.standard_normal(3)
    errors = []
    found = learn_ksvd(codes @ truth, 40, 3, 40, rng, lambda step, error: errors.append(error))
    assert len(errors) == 40
    assert errors[-1] < 0.4 * errors[0]
    assert np.mean(np.abs(found @ truth.T).max(axis=0) > 0.99) > 0.8


@pytest.mark.parametrize("symmetry", range(8))
def test_a_symmetry_keeps_a_plane_a_plane_of_the_same_disparity(symmetry):
    texture = np.random.default_rng(0).random((20, 20)).astype(np.float32)
    lf = np.empty((3, 3, 12, 12, 1), np.float32)
    for v, u in np.ndindex(3, 3):
        lf[v, u, ..., 0] = texture[5 - v : 17 - v, 5 - u : 17 - u]
    patch = cut_patches(lf, np.array([[3, 3]]), np.array([symmetry]), (5, 5))[0]
    np.testing.assert_array_equal(patch[2, 2, 1:, 1:], patch[1, 1, :-1, :-1])
    rows = lf[1, 1, 3:8, 3:8]
    rows = rows[:, ::-1] if symmetry & 1 else rows
    rows = rows[::-1] if symmetry & 2 else rows
    rows = rows.transpose(1, 0, 2) if symmetry & 4 else rows
    np.testing.assert_array_equal(patch[1, 1], rows)


@pytest.mark.parametrize(
    ("out", "more", "scenes", "says"),
    [
        ("mine.h5", (), ("cat",), "exists already"),
        ("mine.txt", (), ("cat",), r"ends in \.h5"),
        ("d.h5", (), ("cat", "owl"), "3x3 views, .*cat.h5 has 2x2"),
        ("d.h5", ("--patch", "24x24"), ("cat",), "smaller than a patch of 24x24"),
        ("d.h5", ("--sparsity", "0"), ("cat",), "--sparsity 0: needs 1 or more"),
        ("d.h5", ("--iterations", "0"), ("cat",), "--iterations 0: needs 1 or more"),
        ("d.h5", ("--patches", "0"), ("cat",), "--patches 0: needs 1 or more"),
        ("d.h5", ("--atoms", "3"), ("cat",), "more than the 0 atoms that are learned"),
        ("d.h5", ("--sparsity", "30"), ("cat",), "more than the 21 atoms that are learned"),
        ("d.h5", ("--patches", "20"), ("cat",), "20 patches are not flat, too few for 24"),
    ],
)
def test_what_cannot_be_trained_is_refused(train, tmp_path, out, more, scenes, says):
    (tmp_path / "mine.png").write_bytes(b"mine")
    with pytest.raises(AppError, match=says):
        train(tmp_path / out, *more, scenes=scenes)
    assert not (tmp_path / out).exists()


def test_the_picture_shows_centre_view_and_epi_of_every_atom():
    atoms = np.zeros((2, 3, 3, 4, 5, 3), np.float32)
    atoms[0] = 1
    for u in range(3):
        atoms[1, 1, u, 2, 1 + u, 0] = 1  # a red dot that moves one pixel per view
    picture = draw_atoms(Dictionary.normalised(atoms, "ksvd"))[1::3, 1::3, ::-1]
    grey, red, white = [128, 128, 128], [255, 128, 128], [255, 255, 255]
    tile_high = 4 + 1 + 3
    assert (picture[:4, :5] == white).all()
    dot = np.argwhere((picture == red).all(axis=-1)) - np.argwhere(
        (picture == white).all(axis=-1)
    ).min(axis=0)
    right = dot[:, 1].min() // 6 * 6 if dot[:, 1].min() > 5 else 0
    down = 0 if right else tile_high + 1
    places = {(int(y) - down, int(x) - right) for y, x in dot}
    assert len(places) == 4
    assert (picture == grey).all(axis=-1).any()
    rows = sorted(y for y, _ in places)
    assert rows == [2, 5, 6, 7]
    slope = [x for y, x in sorted(places) if y >= 5]
    assert np.diff(slope).tolist() == [1, 1]

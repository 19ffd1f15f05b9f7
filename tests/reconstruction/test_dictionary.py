"""Dictionaries: what they refuse, their file, and the two that need no training."""

import h5py
import numpy as np
import pytest

from emmc_rig.reconstruction.dictionary import (
    KINDS,
    OPPONENT,
    Dictionary,
    lambertian_dictionary,
    plane_disparities,
    planes_of_scene,
)
from emmc_rig.reconstruction.errors import DictionaryError, ReconstructionError

VIEWS, PATCH = (3, 2), (4, 5)
SHAPE = (*VIEWS, *PATCH, 3)


def random_atoms(count=6, shape=SHAPE):
    return np.random.default_rng(0).standard_normal((count, *shape)).astype(np.float32)


@pytest.fixture
def some():
    return Dictionary.normalised(random_atoms(), "ksvd", '{"seed": 3}')


def test_atoms_have_unit_norm_and_known_shapes(some):
    assert some.size == 6
    assert some.patch_shape == SHAPE
    assert some.matrix.shape == (6, 3 * 2 * 4 * 5 * 3)
    assert some.atoms.dtype == np.float32
    assert np.shares_memory(some.matrix, some.atoms)
    np.testing.assert_allclose(np.linalg.norm(some.matrix, axis=1), 1, rtol=1e-6)


def test_normalising_keeps_directions():
    atoms = random_atoms()
    unit = Dictionary.normalised(7 * atoms, "ksvd").matrix
    flat = atoms.reshape(6, -1)
    np.testing.assert_allclose((unit * flat).sum(1), np.linalg.norm(flat, axis=1), rtol=1e-5)


def with_atom(number, value):
    """Return what sets all values of an atom."""
    return lambda atoms: np.where(np.arange(6).reshape(6, 1, 1, 1, 1, 1) == number, value, atoms)


@pytest.mark.parametrize(
    ("make", "change", "kind", "reported"),
    [
        (Dictionary, lambda a: 2 * a, "ksvd", "atom 0 has norm 2"),
        (Dictionary, lambda a: a[0], "ksvd", "(atom, v, u, y, x, c)"),
        (Dictionary, lambda a: a[:0], "ksvd", "(atom, v, u, y, x, c)"),
        (Dictionary, lambda a: (a * 99).astype(np.int32), "ksvd", "int32"),
        (Dictionary, with_atom(4, np.nan), "ksvd", "atom 4"),
        (Dictionary, with_atom(3, np.inf), "ksvd", "atom 3"),
        (Dictionary, with_atom(2, 0), "ksvd", "atom 2"),
        (Dictionary, lambda a: a, "kvsd", "ksvd, lambertian"),
        (Dictionary.normalised, with_atom(1, 0), "ksvd", "atom 1 is zero"),
    ],
)
def test_what_is_no_set_of_unit_atoms_is_refused(some, make, change, kind, reported):
    with pytest.raises(DictionaryError) as fault:
        make(change(some.atoms), kind)
    assert reported in str(fault.value)
    assert some.kind in KINDS


def test_a_dictionary_of_other_views_or_colours_is_refused(some):
    some.check_views(VIEWS)
    with pytest.raises(ReconstructionError, match=r"3x2 views .*, not 2x3 .*: train"):
        some.check_views((2, 3))
    grey = Dictionary.normalised(random_atoms(shape=(*SHAPE[:4], 1)), "ksvd")
    with pytest.raises(DictionaryError, match=r"3x2 views \(colours: 1\)"):
        grey.check_views(VIEWS)


def test_a_file_gives_back_the_same_dictionary(some, tmp_path):
    path = tmp_path / "new/folder/d.h5"
    long = Dictionary(some.atoms, "ksvd", "é" * 100_000)
    long.save(path)
    again = Dictionary.load(path)
    np.testing.assert_array_equal(again.atoms, some.atoms)
    assert (again.kind, again.provenance) == ("ksvd", long.provenance)
    assert [p.name for p in path.parent.iterdir()] == ["d.h5"]


def test_a_failed_write_leaves_the_old_file(some, tmp_path, monkeypatch):
    path = tmp_path / "d.h5"
    some.save(path)
    before = path.read_bytes()

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("emmc_rig.reconstruction.dictionary.os.replace", full)
    with pytest.raises(DictionaryError, match="No space left"):
        Dictionary.normalised(random_atoms(9), "ksvd").save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["d.h5"]


def test_a_file_cut_anywhere_is_one_clear_line(some, tmp_path):
    some.save(tmp_path / "d.h5")
    whole = (tmp_path / "d.h5").read_bytes()
    for part in np.linspace(0, len(whole) - 1, 9).astype(int):
        (tmp_path / "cut.h5").write_bytes(whole[:part])
        with pytest.raises(DictionaryError, match=r"cut\.h5") as fault:
            Dictionary.load(tmp_path / "cut.h5")
        assert "\n" not in str(fault.value)


def flipped_bit(path, some):
    content = bytearray(path.read_bytes())
    content[bytes(content).index(some.atoms[3].tobytes()) + 100] ^= 1
    path.write_bytes(content)


def rewritten(change):
    """Return what changes the datasets of an open HDF5 file."""

    def write(path, some):
        with h5py.File(path, "r+") as file:
            change(file, some)

    return write


def double_atoms(file, some):
    del file["atoms"]
    file["atoms"] = 2 * some.atoms


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path, _: path.unlink(), "no such file"),
        (flipped_bit, "cannot be read"),
        (rewritten(lambda file, _: file.attrs.pop("format")), "not a dictionary"),
        (rewritten(lambda file, _: file.pop("atoms")), "'atoms' is missing"),
        (rewritten(double_atoms), r"d\.h5: atom 0 has norm 2"),
    ],
)
def test_a_file_that_holds_no_dictionary_is_refused(some, tmp_path, spoil, words):
    path = tmp_path / "d.h5"
    some.save(path)
    spoil(path, some)
    with pytest.raises(DictionaryError, match=words):
        Dictionary.load(path)


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (((0, 5), (9, 9)), "0x5 views"),
        (((5, 5), (9, 0)), "9x0 pixels"),
    ],
)
def test_patches_of_nothing_are_refused(arguments, reported):
    with pytest.raises(DictionaryError, match=reported):
        lambertian_dictionary(*arguments)


@pytest.mark.parametrize("disparity", [-1, 0, 1, 2])
def test_an_atom_at_a_whole_disparity_is_an_exact_shift(disparity):
    views, size = (3, 3), (8, 9)
    atoms = lambertian_dictionary(views, size, [disparity]).atoms
    for v, u in np.ndindex(*views):
        down, right = disparity * (v - 1), disparity * (u - 1)
        here = atoms[:, 1, 1, max(0, -down) : 8 - max(0, down), max(0, -right) : 9 - max(0, right)]
        there = atoms[:, v, u, max(0, down) : 8 + min(0, down), max(0, right) : 9 + min(0, right)]
        np.testing.assert_allclose(there, here, atol=1e-6)


def test_a_plane_s_edge_is_coded_by_one_atom_and_the_flat_ones():
    """The sign of disparity is the light field's: an independent picture of a moving edge."""
    views, size = (5, 5), (9, 9)
    matrix = lambertian_dictionary(views, size, [0.5, 1.0]).matrix
    u, x = np.arange(5) - 2, np.arange(9) - 4
    edge = 1 / (1 + np.exp(-2.6 * (x[None, :] - 0.5 * u[:, None])))
    patch = np.broadcast_to(edge[None, :, None, :, None], (*views, *size, 3)).ravel()
    best = np.abs(matrix[3:] @ (patch - patch.mean())).max() / np.linalg.norm(patch - patch.mean())
    assert best > 0.98
    mirrored = np.broadcast_to(edge[None, ::-1, None, :, None], (*views, *size, 3)).ravel()
    other = np.abs(matrix @ (mirrored - mirrored.mean())).max() / np.linalg.norm(mirrored)
    assert other < 0.9


def test_lambertian_atoms_are_of_one_opponent_colour_and_free_of_mean_but_for_the_flat_ones():
    atoms = lambertian_dictionary((3, 3), (6, 6), [-1, 0, 1]).atoms.astype(np.float64)
    colours = atoms.reshape(len(atoms), -1, 3) @ OPPONENT.T
    strength = np.linalg.norm(colours, axis=1)
    np.testing.assert_allclose(np.sort(strength, axis=1)[:, :2], 0, atol=1e-6)
    flat = np.ptp(atoms, axis=(1, 2, 3, 4)).max(axis=1) < 1e-6
    assert flat.sum() == 3
    np.testing.assert_allclose(colours[~flat].mean(axis=1), 0, atol=1e-6)


def test_no_two_lambertian_atoms_are_nearly_the_same():
    matrix = lambertian_dictionary((5, 5), (9, 9)).matrix
    gram = np.abs(matrix @ matrix.T)
    np.fill_diagonal(gram, 0)
    assert gram.max() < 0.9951


def test_more_disparities_hold_fewer_ones_luminance_atoms():
    few = lambertian_dictionary((3, 3), (6, 6), [0, 1]).matrix
    many = lambertian_dictionary((3, 3), (6, 6), [-1, 0, 0.5, 1]).matrix
    assert (np.abs(few @ many.T).max(axis=1) > 0.99).all()


def test_planes_are_one_pixel_apart_in_the_outermost_view():
    assert plane_disparities((5, 5), (9, 9)) == (-2, -1.5, -1, -0.5, 0, 0.5, 1, 1.5, 2)
    assert plane_disparities((3, 3), (8, 8)) == (-2, -1, 0, 1, 2)
    assert plane_disparities((9, 9), (8, 8)) == (-1, -0.75, -0.5, -0.25, 0, 0.25, 0.5, 0.75, 1)
    assert plane_disparities((5, 5), (1, 1)) == (0,)


@pytest.mark.slow
@pytest.mark.parametrize(("views", "patch"), [((2, 2), (4, 6)), ((7, 7), (8, 8)), ((9, 9), (3, 3))])
def test_the_defaults_fit_any_views_and_patch(views, patch):
    assert lambertian_dictionary(views, patch).patch_shape == (*views, *patch, 3)


@pytest.mark.parametrize("disparities", [[], [np.nan], [0, np.inf], [5]])
def test_disparities_that_show_nothing_are_refused(disparities):
    with pytest.raises(DictionaryError, match="pixels per view step"):
        lambertian_dictionary((5, 5), (9, 9), disparities)


@pytest.mark.parametrize(
    ("lowest", "highest", "planes"),
    [
        (-0.3, 0.4, (-0.5, 0, 0.5)),
        (-0.5, 0.5, (-0.5, 0, 0.5)),
        (0.6, 0.9, (0.5, 1)),
        (-9, 9, (-1.5, -1, -0.5, 0, 0.5, 1, 1.5)),
        (7, 9, (1.5,)),
    ],
)
def test_a_scene_needs_the_planes_of_its_disparities(lowest, highest, planes):
    disparity = np.linspace(lowest, highest, 500).reshape(20, 25)
    disparity[0, 0], disparity[-1, -1] = -20, 20  # too rare to count
    assert planes_of_scene((5, 5), (6, 6), disparity) == planes

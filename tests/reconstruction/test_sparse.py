"""Dictionary-based reconstruction: exact where patches are sparse, honest where frames are not."""

from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.bpdn import BPDNSettings
from emmc_rig.reconstruction.dictionary import Dictionary
from emmc_rig.reconstruction.errors import DictionaryError, ReconstructionError
from emmc_rig.reconstruction.inputs import checked_inputs
from emmc_rig.reconstruction.methods import METHODS, MethodSettings, find_method, reconstruct
from emmc_rig.reconstruction.sparse import SparseSettings, estimate_patches, reconstruct_sparse

VIEWS, PATCH = (3, 3), (6, 6)


def random_atoms(count=60, views=VIEWS, patch=PATCH, seed=0):
    """One flat atom per colour, and atoms of white noise: as incoherent as can be."""
    atoms = np.random.default_rng(seed).normal(size=(count + 3, *views, *patch, 3))
    atoms[:3] = np.eye(3)[:, None, None, None, None]
    return Dictionary.normalised(atoms, "ksvd")


def tiled_light_field(dictionary, tiles=(4, 5), seed=1):
    """A light field whose patches without overlap are six atoms each, three of them flat."""
    rng = np.random.default_rng(seed)
    rows, columns = dictionary.patch_shape[2:4]
    field = np.zeros((*dictionary.patch_shape[:2], tiles[0] * rows, tiles[1] * columns, 3))
    for i, j in np.ndindex(*tiles):
        chosen = 3 + rng.choice(dictionary.size - 3, 3, replace=False)
        patch = np.tensordot(rng.normal(size=3), dictionary.atoms[chosen], 1)
        field[:, :, i * rows : (i + 1) * rows, j * columns : (j + 1) * columns] = patch
    field -= field.min()
    return (field / field.max()).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    dictionary = random_atoms()
    return dictionary, tiled_light_field(dictionary)


def settings(**more: Any):
    solver = BPDNSettings(smallest_penalty=1e-4, rtol=1e-4)
    return SparseSettings(stride=6, solver=solver, flat_favour=1, **more)


def solved(psi, truth, dictionary, chosen=None, usable=None, noise=0.0, **more):
    """Return the result from the readings of a light field by Psi."""
    frames = even_frames(psi.forward(truth), noise, usable)
    return reconstruct_sparse(psi, frames, dictionary, chosen or settings(), **more)


@pytest.mark.parametrize(("shots", "stored"), [(1, 1), (2, 1), (1, 3)])
def test_patches_of_few_atoms_come_back(random_psi, scene, shots, stored):
    dictionary, truth = scene
    psi = random_psi(shots, VIEWS, truth.shape[2:4], stored)
    result = solved(psi, truth, dictionary)
    assert psnr_db(result.light_field, truth) > 40
    assert result.status == "converged"
    assert result.parameters["patches"] == 20


def test_favoured_flat_atoms_keep_the_colour_of_an_even_scene(random_psi):
    """The penalty shrinks coefficients by the same amount: a longer atom loses less by it."""
    dictionary = random_atoms()
    truth = np.broadcast_to(np.array([0.8, 0.5, 0.2], np.float32), (*VIEWS, 12, 12, 3))
    psi = random_psi(1, VIEWS, (12, 12), stored=3)
    losses = []
    for favour in (1, 8):
        chosen = SparseSettings(
            stride=6, flat_favour=favour, solver=BPDNSettings(smallest_penalty=0.05)
        )
        found = solved(psi, truth, dictionary, chosen).light_field
        losses.append(np.abs(found.mean(axis=(0, 1, 2, 3)) - [0.8, 0.5, 0.2]).max())
    assert losses[1] < 0.3 * losses[0]


def test_pixels_that_sum_samples_are_resolved(random_psi, scene):
    dictionary, truth = scene
    psi = random_psi(4, VIEWS, truth.shape[2:4], stored=1, binning=2)
    result = solved(psi, truth, dictionary)
    assert psnr_db(result.light_field, truth) > 40


def test_saturated_pixels_are_left_out_whatever_they_read(random_psi, scene):
    dictionary, truth = scene
    psi = random_psi(2, VIEWS, truth.shape[2:4])
    frames = psi.forward(truth)
    usable = np.random.default_rng(0).uniform(size=frames.shape) > 0.15
    clean = reconstruct_sparse(psi, even_frames(frames, 0.0, usable), dictionary, settings())
    broken = np.where(usable, frames, np.nan)
    again = reconstruct_sparse(psi, even_frames(broken, 0.0, usable), dictionary, settings())
    np.testing.assert_array_equal(clean.light_field, again.light_field)
    assert psnr_db(clean.light_field, truth) > 35


def test_a_patch_without_usable_pixels_says_nothing(random_psi, scene):
    dictionary, truth = scene
    psi = random_psi(1, VIEWS, truth.shape[2:4])
    usable = np.ones(psi.frames_shape, dtype=bool)
    usable[:, 6:12, 6:12] = False
    result = solved(psi, truth, dictionary, usable=usable)
    assert result.status == "incomplete"
    assert "patches without a usable pixel: 1; samples left at 0: 36" in result.advice
    assert not result.light_field[:, :, 6:12, 6:12].any()
    kept = np.ones(truth.shape[2:4], dtype=bool)
    kept[6:12, 6:12] = False
    assert psnr_db(result.light_field[:, :, kept], truth[:, :, kept]) > 35


def test_patches_of_equal_sensing_share_one_dictionary(random_psi, scene):
    dictionary, truth = scene
    rng = np.random.default_rng(0)
    tile = rng.uniform(size=(1, *VIEWS, 6, 1, 6)).astype(np.float32)
    weights = np.tile(tile, (1, 1, 1, 4, 1, 5))
    colour = np.tile(rng.integers(0, 3, (1, 6, 6), dtype=np.uint8), (1, 4, 5))
    psi = Psi(weights, colour)
    shared = solved(psi, truth, dictionary)
    assert shared.parameters["classes"] == 1
    nudged = weights * (1 + 1e-6 * rng.uniform(size=weights.shape)).astype(np.float32)
    apart = solved(Psi(nudged, colour), truth, dictionary)
    assert apart.parameters["classes"] == 20
    np.testing.assert_allclose(shared.light_field, apart.light_field, atol=1e-3)


def test_the_same_frames_give_the_same_bits(random_psi, scene):
    dictionary, truth = scene
    psi = random_psi(1, VIEWS, truth.shape[2:4])
    chosen = SparseSettings(stride=2)
    first, second = (solved(psi, truth, dictionary, chosen, noise=0.01) for _ in "ab")
    np.testing.assert_array_equal(first.light_field, second.light_field)


def test_a_step_limit_is_reported_with_advice(random_psi, scene):
    dictionary, truth = scene
    psi = random_psi(1, VIEWS, truth.shape[2:4])
    solver = BPDNSettings(max_steps=1)
    result = solved(psi, truth, dictionary, SparseSettings(stride=6, solver=solver))
    assert result.status == "incomplete"
    assert "raise max_steps" in result.advice


def test_progress_counts_the_patches(random_psi, scene):
    dictionary, truth = scene
    psi = random_psi(1, VIEWS, truth.shape[2:4])
    reported = []
    solved(psi, truth, dictionary, on_step=reported.append)
    assert reported[-1].step == reported[-1].total == 20
    assert [p.step for p in reported] == sorted(p.step for p in reported)


def test_patches_are_coded_with_one_blas_thread(random_psi, scene):
    """As many threads code patches as there are cores; with two of BLAS each they take 4 times."""
    dictionary, truth = scene
    psi = random_psi(1, VIEWS, truth.shape[2:4])
    given = checked_inputs(psi, even_frames(psi.forward(truth), 0.01))
    threads = set()

    def note(_):
        blas = (item for item in threadpool_info() if item["user_api"] == "blas")
        threads.update(item["num_threads"] for item in blas)

    with threadpool_limits(2, "blas"):
        estimate_patches(psi, given, dictionary, SparseSettings(), note)
    assert threads == {1}


def test_what_does_not_fit_is_refused(random_psi, scene):
    dictionary, truth = scene
    psi = random_psi(1, VIEWS, truth.shape[2:4])
    frames = psi.forward(truth)
    with pytest.raises(ReconstructionError, match="frames of shape"):
        reconstruct_sparse(psi, even_frames(frames[:, 1:], 0.0), dictionary)
    with pytest.raises(DictionaryError, match="2x2 views"):
        reconstruct_sparse(psi, even_frames(frames, 0.0), random_atoms(views=(2, 2)))
    small = random_psi(1, VIEWS, (5, 30))
    with pytest.raises(ReconstructionError, match="do not fit"):
        reconstruct_sparse(small, even_frames(np.zeros(small.frames_shape), 0.0), dictionary)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name, method in METHODS.items() if method.package is None]
)
def test_every_method_runs_by_its_name_and_says_so(random_psi, scene, name):
    dictionary, truth = scene
    psi = random_psi(2, VIEWS, truth.shape[2:4])
    chosen = MethodSettings(sparse=SparseSettings(stride=6))
    result = reconstruct(name, psi, even_frames(psi.forward(truth), 0.001), dictionary, chosen)
    assert result.method == name
    assert psnr_db(result.light_field, truth) > 15
    method = find_method(name)
    assert method.title
    assert method.assumes
    assert method.cost
    assert method.when


def test_a_missing_dictionary_says_how_to_make_one(random_psi):
    psi = random_psi()
    with pytest.raises(ReconstructionError, match="give lambertian"):
        reconstruct("dict-admm", psi, even_frames(np.zeros(psi.frames_shape), 0.0))

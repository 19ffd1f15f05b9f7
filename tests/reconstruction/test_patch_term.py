"""The patch term: against the paper's patch extraction P as an explicit sparse matrix."""

import numpy as np
import pytest
from scipy import sparse
from variation import from_patches

from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.tv import TVSettings, reconstruct_tv

SHAPE = (2, 3, 7, 9, 3)
REGULAR = [(y, x, 4, 4) for y in (0, 2, 3) for x in (0, 2, 4, 5)]
IRREGULAR = [(0, 0, 4, 4), (3, 1, 2, 6), (1, 2, 5, 3), (6, 8, 1, 1), (0, 0, 7, 9)]
SPARSE = [(1, 1, 2, 2), (4, 5, 3, 3)]
TWICE = [*SPARSE, *SPARSE, *REGULAR]


def collection(places, seed=0):
    """Return positions, patches and a weight for each place (y, x, rows, columns)."""
    rng = np.random.default_rng(seed)
    positions = [place[:2] for place in places]
    patches = [rng.random((*SHAPE[:2], *place[2:], 3)).astype(np.float32) for place in places]
    return positions, patches, list(rng.random(len(places)) + 0.1)


def extraction(places, weights):
    """Return P, each patch's rows times the root of its weight, as a sparse matrix."""
    numbers = np.arange(np.prod(SHAPE)).reshape(SHAPE)
    columns, scales = [], []
    for (y, x, rows, columns_), weight in zip(places, weights, strict=True):
        seen = numbers[:, :, y : y + rows, x : x + columns_]
        columns.append(seen.ravel())
        spread = np.broadcast_to(np.asarray(weight)[..., None], seen.shape)
        scales.append(np.sqrt(spread).ravel())
    column, scale = np.concatenate(columns), np.concatenate(scales)
    rows = np.arange(column.size)
    return sparse.csr_array((scale, (rows, column)), shape=(column.size, numbers.size))


@pytest.mark.parametrize("places", [REGULAR, IRREGULAR, SPARSE, TWICE])
@pytest.mark.parametrize("weighted", [False, True])
def test_the_term_is_that_of_the_extracted_patches_but_for_a_constant(places, weighted):
    positions, patches, weights = collection(places)
    used = weights if weighted else np.ones(len(places))
    term = from_patches(positions, patches, weights if weighted else None, SHAPE)
    extract = extraction(places, used)
    estimates = extract @ np.zeros(np.prod(SHAPE))
    start = 0
    for patch, weight in zip(patches, used, strict=True):
        estimates[start : start + patch.size] = np.sqrt(weight) * patch.ravel()
        start += patch.size
    rng = np.random.default_rng(1)
    light_fields = [rng.standard_normal(SHAPE) for _ in range(3)]
    constants = [
        0.5 * np.sum((extract @ field.ravel() - estimates) ** 2) - term.value(field)
        for field in light_fields
    ]
    np.testing.assert_allclose(constants, constants[0], rtol=1e-5, atol=1e-5)
    covers = (extract.T @ extract).diagonal().reshape(SHAPE)
    np.testing.assert_allclose(np.broadcast_to(term.weight[..., None], SHAPE), covers, rtol=1e-6)
    pulled = (extract.T @ estimates).reshape(SHAPE)
    np.testing.assert_allclose(term.weight[..., None] * term.target, pulled, atol=1e-5)
    largest = sparse.linalg.norm(extract.T @ extract, np.inf)
    assert term.weight.max() == pytest.approx(largest, rel=1e-6)


def test_patches_may_be_weighted_sample_by_sample():
    positions, patches, _ = collection(REGULAR)
    window = np.outer([0, 1, 1, 0.5], [0.5, 1, 1, 0.25]).astype(np.float32)
    term = from_patches(positions, patches, [window] * len(patches), SHAPE)
    extract = extraction(REGULAR, [window] * len(patches))
    covers = (extract.T @ extract).diagonal().reshape(SHAPE)
    np.testing.assert_allclose(term.weight, covers[0, 0, :, :, 0], rtol=1e-6)


def test_samples_that_no_patch_covers_have_no_weight_and_no_influence():
    term = from_patches(*collection(SPARSE), SHAPE)
    covered = np.zeros(SHAPE[2:4], dtype=bool)
    for y, x, rows, columns in SPARSE:
        covered[y : y + rows, x : x + columns] = True
    np.testing.assert_array_equal(term.weight > 0, covered)
    light_field = np.random.default_rng(2).random(SHAPE)
    changed = light_field.copy()
    changed[:, :, ~covered] = 77
    assert term.value(changed) == term.value(light_field)


def test_a_large_rho_gives_the_patches_and_none_ignores_them(coded_psi):
    psi = coded_psi("rggb", 1, 1, (4, 6), (2, 2))
    truth = 0.2 + 0.5 * np.random.default_rng(0).random(psi.light_field_shape)
    frames = psi.forward(truth)
    term = from_patches([(0, 0)], [truth], None, truth.shape)
    near = reconstruct_tv(psi, even_frames(frames, 0.01), TVSettings(rho=1e4), patch_term=term)
    np.testing.assert_allclose(near.light_field, truth, atol=1e-3)
    ignored = reconstruct_tv(psi, even_frames(frames, 0.01), TVSettings(rho=0), patch_term=term)
    alone = reconstruct_tv(psi, even_frames(frames, 0.01))
    np.testing.assert_array_equal(ignored.light_field, alone.light_field)
    assert (near.method, ignored.method) == ("tv-patch", "tv")


def test_a_light_field_that_explains_everything_stays(coded_psi):
    """A constant light field, its frames and itself as patches: nothing pulls at it."""
    for order in (1, 2, 3):
        psi = coded_psi("rggb", 2, 2, (6, 8), (2, 3))
        grey = np.full(psi.light_field_shape, 0.4, np.float32)
        term = from_patches([(0, 0)], [grey], None, grey.shape)
        settings = TVSettings(order=order, mu=1e-3, max_steps=20)
        found = reconstruct_tv(psi, even_frames(psi.forward(grey), 0.01), settings, patch_term=term)
        np.testing.assert_allclose(found.light_field, 0.4, atol=1e-5)
        assert found.method == ("tv-patch", "dv2-patch", "dv3-patch")[order - 1]

"""The patch term: against the paper's patch extraction P as an explicit sparse matrix."""

import numpy as np
import pytest
from full_splitting import from_patches
from scipy import sparse

from reconstruction.errors import ReconstructionError
from reconstruction.patch_term import PatchTerm
from reconstruction.tv import TVSettings, reconstruct_tv

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


@pytest.mark.parametrize(
    ("target", "weight", "complaint"),
    [
        (np.zeros((2, 3, 4, 5)), np.ones((4, 5)), "a patch target of shape"),
        (np.zeros((2, 3, 4, 5, 3)), np.ones((5, 4)), r"patch weights of shape \(5, 4\)"),
        (np.zeros((2, 3, 4, 5, 3)), np.full((4, 5), -0.1), "must be at least 0"),
        (np.zeros((2, 3, 4, 5, 3)), np.full((4, 5), np.inf), "weights hold values that are not"),
        (np.full((2, 3, 4, 5, 3), np.nan), np.ones((4, 5)), "target has values that are not"),
    ],
)
def test_a_term_that_makes_no_sense_is_refused(target, weight, complaint):
    with pytest.raises(ReconstructionError, match=complaint):
        PatchTerm(target.astype(np.float32), weight.astype(np.float32))


def test_pixels_of_several_samples_need_one_weight_each(coded_psi):
    psi = coded_psi(binning=2)
    frames = np.full(psi.frames_shape, 0.3, np.float32)
    shape = psi.light_field_shape
    whole = from_patches([(2, 4)], [np.full((*shape[:2], 4, 2, 3), 0.3)], None, shape)
    once = TVSettings(max_steps=1)
    assert reconstruct_tv(psi, frames, 0.01, once, patch_term=whole).steps == 1
    uneven = from_patches([(1, 4)], [np.full((*shape[:2], 4, 2, 3), 0.3)], None, shape)
    with pytest.raises(ReconstructionError, match="corners and sizes that are multiples of 2"):
        reconstruct_tv(psi, frames, 0.01, once, patch_term=uneven)


def test_patches_and_starts_of_another_size_are_refused(coded_psi):
    psi = coded_psi()
    frames = np.full(psi.frames_shape, 0.3, np.float32)
    other = np.zeros((2, 3, 6, 9, 3))
    with pytest.raises(ReconstructionError, match="patches for a light field of shape"):
        reconstruct_tv(
            psi,
            frames,
            0.01,
            patch_term=PatchTerm(other.astype(np.float32), np.ones((6, 9), np.float32)),
        )
    with pytest.raises(ReconstructionError, match="a start of shape"):
        reconstruct_tv(psi, frames, 0.01, start=other)
    with pytest.raises(ReconstructionError, match="the start holds values that are not finite"):
        reconstruct_tv(psi, frames, 0.01, start=np.full(psi.light_field_shape, np.nan))

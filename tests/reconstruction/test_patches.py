"""Patches: they cover the light field, and see of Psi and the frames what lies in them."""

import numpy as np
import pytest

from emmc_rig.model.frames import even_frames
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.patches import (
    overlap_add,
    padded,
    regular_grid,
    selected_atoms,
    sense_atoms,
    sense_patches,
)


def test_the_papers_patches_number_19824():
    assert len(regular_grid((593, 840), (9, 9), 5)) == 19_824


@pytest.mark.parametrize(
    ("size", "patch", "stride", "binning"),
    [
        ((9, 9), (9, 9), 5, 1),
        ((23, 31), (9, 9), 5, 1),
        ((24, 32), (8, 8), 4, 2),
        ((9, 20), (4, 7), 4, 1),
    ],
)
def test_every_sample_lies_in_a_patch_and_no_patch_lies_outside(size, patch, stride, binning):
    grid = regular_grid(size, patch, stride, binning)
    covered = np.zeros(size, dtype=int)
    for y, x in grid.corners:
        assert y + patch[0] <= size[0]
        assert x + patch[1] <= size[1]
        assert y % binning == 0
        assert x % binning == 0
        covered[y : y + patch[0], x : x + patch[1]] += 1
    assert covered.min() >= 1
    assert len(np.unique(grid.corners, axis=0)) == len(grid)


@pytest.mark.parametrize(
    ("size", "patch", "stride", "binning", "line"),
    [
        ((8, 40), (9, 9), 5, 1, "do not fit"),
        ((40, 40), (9, 9), 0, 1, "stride"),
        ((40, 40), (9, 9), 10, 1, "stride"),
        ((40, 40), (9, 9), 4, 2, "multiples of 2"),
        ((40, 40), (8, 8), 5, 2, "multiples of 2"),
    ],
)
def test_patches_that_cannot_be_are_refused(size, patch, stride, binning, line):
    with pytest.raises(ReconstructionError, match=line):
        regular_grid(size, patch, stride, binning)


@pytest.mark.parametrize("stored", [1, 3])
@pytest.mark.parametrize("shots", [1, 2])
@pytest.mark.parametrize(("binning", "patch"), [(1, (5, 4)), (2, (4, 6)), (3, (6, 6))])
def test_sensed_atoms_are_what_psi_makes_of_the_atoms_there(
    random_psi, stored, shots, binning, patch
):
    psi = random_psi(shots, stored=stored, binning=binning)
    rng = np.random.default_rng(1)
    atoms = rng.normal(size=(3, 2, 3, *patch, 3)).astype(np.float32)
    corners = np.array([[0, 0], [6, 12], [6, 6]])
    usable = rng.uniform(size=psi.frames_shape) > 0.2
    frames = rng.normal(size=psi.frames_shape)
    found = sense_patches(psi, even_frames(frames, 0.0, usable), corners, patch)
    pixels = patch[0] * patch[1] // binning**2
    for i, (y, x) in enumerate(corners):
        seen = np.zeros((1, 3, padded(shots * pixels)), dtype=np.float32)
        for shot in range(shots):
            colours = None
            if psi.colour is not None:
                colours = psi.colour[shot, y : y + patch[0], x : x + patch[1]].ravel()
            selected = selected_atoms(atoms, colours, binning)
            sense_atoms(selected, found.weights[shot][:, i : i + 1], shot, seen)
        cut = np.s_[
            :, y // binning : (y + patch[0]) // binning, x // binning : (x + patch[1]) // binning
        ]
        for j, atom in enumerate(atoms):
            light_field = np.zeros(psi.light_field_shape, dtype=np.float32)
            light_field[:, :, y : y + patch[0], x : x + patch[1]] = atom
            expected = psi.forward(light_field)[cut].ravel()
            np.testing.assert_allclose(seen[0, j, : expected.size], expected, atol=1e-5)
            assert not seen[0, j, expected.size :].any()
        np.testing.assert_allclose(
            found.data[i, : pixels * shots], (frames * usable)[cut].ravel(), rtol=1e-6
        )
        np.testing.assert_array_equal(found.usable[i], usable[cut].ravel())


def test_true_patches_put_together_are_the_light_field():
    rng = np.random.default_rng(0)
    light_field = rng.uniform(size=(2, 3, 20, 23, 3)).astype(np.float32)
    grid = regular_grid((20, 23), (6, 5), 4)
    patches = np.stack([light_field[:, :, y : y + 6, x : x + 5] for y, x in grid.corners])
    share = rng.uniform(0.5, 1, len(grid)).astype(np.float32)
    total, weight = np.zeros_like(light_field), np.zeros((20, 23), np.float32)
    overlap_add(grid.corners, patches, share, total, weight)
    assert weight.min() > 0
    np.testing.assert_allclose(total / weight[:, :, None], light_field, atol=1e-6)

"""Psi in PyTorch against Psi in NumPy and dense matrices; gradients of every operation."""

from dataclasses import replace

import numpy as np
import pytest

import emmc_rig as emmc
from emmc_rig.model.sensing import Psi

torch = pytest.importorskip("torch", reason="needs the extra `torch`")

KINDS = [(1, 1, 1), (3, 1, 1), (2, 3, 2)]
"""Shots, stored colours, binning."""


def random_psi(shots, stored, binning, size=(4, 6), dtype="f8"):
    """Return a Psi of 2x3 views of random weights, of pixels that see random colours."""
    rng = np.random.default_rng(0)
    weights = rng.uniform(0, 1, (shots, 2, 3, size[0], stored, size[1])).astype(dtype)
    colour = rng.integers(0, 3, (shots, *size), dtype=np.uint8) if stored == 1 else None
    return Psi(weights, colour, binning)


def random_arrays(psi, batch=(), seed=1):
    """Return a random light field and random frames, tensors of Psi's type."""
    rng = np.random.default_rng(seed)
    return (
        torch.tensor(rng.standard_normal((*batch, *shape)).astype(psi.weights.dtype))
        for shape in (psi.light_field_shape, psi.frames_shape)
    )


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_is_seen_and_sent_back_as_by_psi_in_numpy(kind):
    psi = random_psi(*kind)
    in_torch = psi.to_torch()
    light_fields, frames = random_arrays(psi, (2,))
    for light_field, seen in zip(light_fields, in_torch(light_fields), strict=True):
        np.testing.assert_allclose(seen, psi.forward(light_field.numpy()), rtol=1e-12, atol=1e-12)
    for readings, back in zip(frames, in_torch.adjoint(frames), strict=True):
        np.testing.assert_allclose(back, psi.adjoint(readings.numpy()), rtol=1e-12, atol=1e-12)
    expected = psi.gram.transpose(2, 3, 0, 1)
    np.testing.assert_allclose(in_torch.gram, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["rgbw-bayer-3shots", "rgbw-mono", "scenario-ii-cfa"])
def test_the_adjoint_of_cameras_is_exact_to_1e_6(name):
    psi = emmc.camera(name).psi((32, 48))
    in_torch = psi.to_torch()
    light_field, frames = random_arrays(psi)
    seen, back = in_torch(light_field), in_torch.adjoint(frames)
    gap = (seen * frames).sum() - (light_field * back).sum()
    assert abs(gap) < 1e-6 * seen.norm() * frames.norm()


@pytest.mark.parametrize("kind", KINDS)
def test_every_operation_has_the_gradients_of_its_input_and_of_the_weights(kind):
    psi = random_psi(*kind, size=(2, 4))
    light_field, frames = random_arrays(psi)
    in_torch = psi.to_torch()

    def check(operation, *given):
        weights = in_torch.weights.clone().requires_grad_()
        inputs = [array.clone().requires_grad_() for array in given]
        torch.autograd.gradcheck(
            lambda w, *arrays: operation(replace(in_torch, weights=w), *arrays), (weights, *inputs)
        )

    check(lambda at, x: at(x), light_field)
    check(lambda at, y: at.adjoint(y), frames)
    check(lambda at, y, ridge: at.solve(y, ridge), frames, torch.rand(frames.shape).double() + 0.1)
    check(lambda at, y: at.pseudo_inverse(y), frames)


@pytest.mark.parametrize("kind", KINDS)
def test_solve_and_pseudo_inverse_are_those_of_the_dense_matrix(kind):
    psi = random_psi(*kind)
    weights = psi.weights.copy()
    weights[-1] = weights[0]  # shots repeat each other
    weights[:, :, :, :2, :, :2] = 0  # pixels see nothing
    colour = psi.colour
    if colour is not None:
        colour[-1] = colour[0]
    psi = replace(psi, weights=weights, colour=colour)
    dense, in_torch = psi.to_scipy().toarray(), psi.to_torch()
    _, frames = random_arrays(psi)
    ridge = np.random.default_rng(2).uniform(0.1, 1, frames.shape)
    expected = np.linalg.solve(dense @ dense.T + np.diag(ridge.ravel()), frames.ravel())
    np.testing.assert_allclose(in_torch.solve(frames, ridge).ravel(), expected, rtol=1e-9)
    expected = np.linalg.pinv(dense, rcond=1e-9) @ frames.numpy().ravel()
    found = in_torch.pseudo_inverse(frames).ravel()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_repeated_shots_of_float32_do_not_amplify_noise():
    psi = random_psi(1, 3, 1, dtype="f4")
    twice = replace(psi, weights=psi.weights.repeat(2, axis=0)).to_torch()
    frames = torch.rand(twice.frames_shape)
    expected = psi.to_torch().pseudo_inverse(frames.mean(0, keepdim=True))
    np.testing.assert_allclose(twice.pseudo_inverse(frames), expected, rtol=1e-4, atol=1e-6)


def test_blocks_follow_weights_that_are_learned():
    psi = random_psi(2, 1, 1).to_torch()
    learned = replace(psi, weights=psi.weights.clone().requires_grad_())
    before = learned.gram.detach().clone()
    with torch.no_grad():
        learned.weights.mul_(2)
    torch.testing.assert_close(learned.gram.detach(), 4 * before)


def test_readings_that_are_not_usable_count_for_nothing():
    psi = random_psi(2, 1, 2)
    _, frames = random_arrays(psi)
    usable = np.ones(psi.frames_shape, bool)
    usable[1, 0, 2] = False
    kept = psi.to_torch().of_usable(usable)
    wrong = frames.clone()
    wrong[1, 0, 2] = 1e3
    torch.testing.assert_close(kept.pseudo_inverse(wrong), kept.pseudo_inverse(frames))
    assert (kept(torch.ones(psi.light_field_shape).double())[1, 0, 2] == 0).item()


def test_another_shape_is_refused_in_one_line():
    psi = random_psi(1, 1, 1).to_torch()
    for operation in (psi, psi.adjoint, psi.pseudo_inverse, psi.of_usable):
        with pytest.raises(emmc.ERRORS, match=r"of shape \(3, 4\) given, Psi needs"):
            operation(torch.zeros(3, 4))

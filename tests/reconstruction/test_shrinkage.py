"""Shrinkage of like blocks: against SciPy and a plain NumPy twin, and what it is for."""

import numpy as np
import pytest
from numba import njit
from scipy.fft import dctn, idctn
from scipy.linalg import hadamard

from emmc_rig.model.lightfield import OPPONENT, psnr_db
from emmc_rig.reconstruction.adaptive.shrinkage import ALIKE, denoised
from emmc_rig.reconstruction.adaptive.stacks import (
    CELL,
    SIDE,
    STACK,
    add_block,
    cells_apart,
    shrink_stack,
    stack_block,
)


@njit
def stacks_block(picture, at, wide, stack, number):
    stack_block(picture, at, wide, stack, number)


@njit
def adds_block(stack, number, share, picture, at, wide):
    add_block(stack, number, share, picture, at, wide)


@njit
def shrinks_stack(stack, count, least):
    return shrink_stack(stack, count, least)


@njit
def squares_apart(guide, own, first, wide, squares, at, height, vectors):
    cells_apart(guide, own, first, wide, squares, at, height, vectors)


def places_alike(guide, y, x, sigma, reach):
    """Where the blocks most like that at (y, x) begin: a power of two of them, itself first."""
    block = guide[y : y + SIDE, x : x + SIDE]
    found = []
    for yy in range(max(0, y - reach), min(guide.shape[0] - SIDE, y + reach) + 1):
        for xx in range(max(0, x - reach), min(guide.shape[1] - SIDE, x + reach) + 1):
            apart = np.square(guide[yy : yy + SIDE, xx : xx + SIDE] - block).sum()
            if (yy, xx) != (y, x) and apart < ALIKE * sigma**2 * SIDE**2:
                found.append((apart, yy, xx))
    places = [(y, x), *(at[1:] for at in sorted(found))][:STACK]
    return places[: 2 ** int(np.log2(len(places)))]


def plainly_denoised(picture, guide, sigma, step, first, threshold, chroma, reach):
    """What `denoised` does, block by block."""
    mixing = OPPONENT if len(picture) == 3 else np.eye(1)
    opponent = np.einsum("oc,cyx->oyx", mixing, picture)
    luminance = np.einsum("c,cyx->yx", mixing[0], guide)
    total, weight = np.zeros(opponent.shape), np.zeros(opponent.shape)
    starts = [
        sorted({0, length - SIDE, *range(first % step, length - SIDE + 1, step)})
        for length in picture.shape[1:]
    ]
    for y in starts[0]:
        for x in starts[1]:
            places = places_alike(luminance, y, x, sigma, reach)
            likeness = hadamard(len(places)) / np.sqrt(len(places))
            for c, plane in enumerate(opponent):
                blocks = np.stack([plane[a : a + SIDE, b : b + SIDE] for a, b in places])
                waves = np.asarray(dctn(blocks, axes=(1, 2), norm="ortho"))
                seen = np.einsum("kl,lij->kij", likeness, waves)
                cut = threshold * sigma * (chroma if c else 1)
                kept = np.where(np.abs(seen) < cut, 0, seen)
                share = 1 / (1 + np.count_nonzero(kept))
                kept[0, 0, 0] = seen[0, 0, 0]
                waves = np.einsum("kl,lij->kij", likeness, kept)
                clean = np.asarray(idctn(waves, axes=(1, 2), norm="ortho"))
                for (a, b), block in zip(places, clean, strict=True):
                    total[c, a : a + SIDE, b : b + SIDE] += share * block
                    weight[c, a : a + SIDE, b : b + SIDE] += share
    return np.einsum("oc,oyx->cyx", mixing, total / weight)


@pytest.mark.parametrize(
    ("colours", "first", "reach", "step"), [(3, 0, 5, 4), (3, 3, 9, 4), (1, 1, 0, 4), (3, 2, 7, 6)]
)
def test_pictures_are_denoised_as_block_by_block(colours, first, reach, step):
    rng = np.random.default_rng(first)
    y, x = np.indices((21, 30))
    picture = (y // 5 + x // 7) % 2 * 0.5 + 0.06 * rng.normal(size=(colours, 21, 30))
    guide = picture + 0.03 * rng.normal(size=picture.shape)
    settings = 0.07, step, first, 2.1, 1.4, reach
    found = denoised(picture.astype(np.float32), guide.astype(np.float32), *settings)
    expected = plainly_denoised(picture, guide, *settings)
    assert np.abs(expected - picture).max() > 0.05
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_blocks_are_analysed_by_the_orthonormal_cosine_transform_and_put_back():
    picture = np.random.default_rng(5).normal(size=(12, 19)).astype(np.float32)
    top, left, number = 3, 10, 2
    stack = np.full(4 * SIDE**2, -1, np.float32)
    stacks_block(picture.ravel(), top * 19 + left, 19, stack, number)
    block = picture[top : top + SIDE, left : left + SIDE]
    by_block = stack.reshape(4, SIDE, SIDE)
    # Rows and columns of the coefficients may be exchanged.
    expected = np.asarray(dctn(block, norm="ortho"))
    np.testing.assert_allclose(by_block[number].T, expected, atol=1e-5)
    assert (np.delete(by_block, number, axis=0) == -1).all()
    found = picture.copy()
    adds_block(stack, number, np.float32(0.5), found.ravel(), top * 19 + left, 19)
    expected = picture.copy()
    expected[top : top + SIDE, left : left + SIDE] *= 1.5
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 4, 8, 16])
def test_stacks_are_shrunk_across_their_blocks_all_but_their_mean(count):
    stack = np.random.default_rng(count).normal(size=(STACK, SIDE, SIDE)).astype(np.float32)
    stack[:, 0, 0] *= 0.01
    found = stack.ravel().copy()
    kept = shrinks_stack(found, count, np.float32(0.8))
    across = hadamard(count) / np.sqrt(count)
    seen = np.einsum("kl,lij->kij", across, stack[:count])
    left = np.where(np.abs(seen) < 0.8, 0, seen)
    assert kept == np.count_nonzero(left)
    left[0, 0, 0] = seen[0, 0, 0]
    expected = stack.copy()
    expected[:count] = np.einsum("kl,lij->kij", across, left)
    np.testing.assert_allclose(found.reshape(stack.shape), expected, atol=1e-5)


def test_squares_of_how_far_cells_are_apart_are_those_of_their_differences():
    guide = np.random.default_rng(7).normal(size=(9, 30)).astype(np.float32)
    (own_y, own_x), (top, left), (height, vectors) = (1, 5), (2, 3), (3, 2)
    squares = np.full(height * vectors * SIDE + 3, -1, np.float32)
    own, first = own_y * 30 + own_x, top * 30 + left
    squares_apart(guide.ravel(), own, first, 30, squares, 2, height, vectors)
    cell = guide[own_y : own_y + CELL, own_x : own_x + CELL]
    others = np.lib.stride_tricks.sliding_window_view(guide, cell.shape)
    expected = np.square(others - cell).sum(axis=(2, 3))
    expected = expected[top : top + height, left : left + vectors * SIDE]
    np.testing.assert_allclose(squares[2:-1].reshape(expected.shape), expected, rtol=1e-5)
    assert (squares[:2] == -1).all()
    assert squares[-1] == -1


def test_what_repeats_is_kept_and_noise_is_removed():
    size, sigma = (48, 56), 0.08
    flat = np.full((3, *size), 0.4, np.float32)
    np.testing.assert_allclose(denoised(flat, flat, sigma), flat, atol=1e-5)
    y, x = np.indices(size)
    stripes = np.repeat((0.3 + 0.4 * ((x + y) // 6 % 2))[None], 3, axis=0).astype(np.float32)
    noisy = stripes + sigma * np.random.default_rng(4).normal(size=stripes.shape)
    clean = denoised(noisy.astype(np.float32), noisy.astype(np.float32), sigma)
    assert psnr_db(clean, stripes) > psnr_db(noisy, stripes) + 8

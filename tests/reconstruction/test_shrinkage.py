"""Shrinkage of like blocks: against SciPy and a plain NumPy twin, and what it is for."""

import numpy as np
import pytest
from scipy.fft import dctn, idctn
from scipy.linalg import hadamard

from emmc_rig.model.lightfield import OPPONENT, psnr_db
from emmc_rig.reconstruction.adaptive.shrinkage import ALIKE, denoised
from emmc_rig.reconstruction.adaptive.stacks import SIDE, STACK


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


def test_what_repeats_is_kept_and_noise_is_removed():
    size, sigma = (48, 56), 0.08
    flat = np.full((3, *size), 0.4, np.float32)
    np.testing.assert_allclose(denoised(flat, flat, sigma), flat, atol=1e-5)
    y, x = np.indices(size)
    stripes = np.repeat((0.3 + 0.4 * ((x + y) // 6 % 2))[None], 3, axis=0).astype(np.float32)
    noisy = stripes + sigma * np.random.default_rng(4).normal(size=stripes.shape)
    clean = denoised(noisy.astype(np.float32), noisy.astype(np.float32), sigma)
    assert psnr_db(clean, stripes) > psnr_db(noisy, stripes) + 8

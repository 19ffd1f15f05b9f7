"""The mean of several light fields, each weighted by how well it predicts readings kept from all.

No one model holds everywhere: surfaces fail at glass, gloss, and occlusions finer than the pixels,
and how closely a texture should follow the readings depends on how wrong its disparity is. The mean
square residual of held-out readings y near a place, E_k = mean((y - Psi L_k)^2 - noise), shows how
good model k is there. The mean of the models, weighted by w_k ~ E_k^-2, is returned:

    L = sum_k w_k L_k,    sum_k w_k = 1.

For two models with independent errors E_k^-1 is the mean of least error; their errors are alike
where both are good, and then the better one deserves more. E_k is a mean over few readings, so it
is drawn towards that of the whole picture (empirical Bayes), and noise's own chance is its floor.

How far the models differ from their mean, place by place, says where it is in doubt.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_views

Array = NDArray[np.floating]
WINDOW_PX = 12.0
"""Deviation of the window, in pixels: some 36 of the held-out readings, of 2 %. Eight costs or
gains at most 0.1 dB, six 0.2 dB, on four crops (fish, dice, buttercup, begonia). 2x +0.01, 0.5x
-0.04 dB."""
POWER = 2.0
"""Of 1 / E: 1 and 3 cost or gain at most 0.15 dB on these four. 2x +0.07, 0.5x +0.03 dB."""
PATCHES_WINDOW_PX, PATCHES_POWER = 20.0, 4.0
"""Instead of these between surfaces and patches, which differ by more: where surfaces fail, they do
in whole objects. On 64x80 middles, three shots: window 12 and power 2 lose 0.2 dB in the mean."""
HIDDEN, PATCHES_CHANCE = 1.2, 0.25
"""Square error of surfaces over what held-out readings show of it, beside that of patches: a wrong
disparity errs in both directions among the rays of a pixel. Of buttercup, dice, fish and
deep-occlusions, three shots, 0.9 to 1.5. And the weight of patches where both errors are noise: in
antinous they are 2 dB worse there. Group A, 96x96, two to six shots: a chance of 1 loses 0.1 dB in
the mean (antinous 1.0), 0.1 loses 0.03 (buttercup 0.2); HIDDEN 1 loses 0.02, 1.5 0.04."""
LEVELS = 65535
"""Number of steps of stored values in [0, 1]."""


def shares_of(
    residuals: Sequence[Array], noise: Array, held: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the weight of every model at every pixel, (model, pixel_y, pixel_x); their sum is 1.

    residuals: the frames less what each model predicts; noise: variance of the readings; held:
    those kept from every fit, at least one, all (shot, pixel_y, pixel_x).
    """
    return _shares(residuals, noise, held, WINDOW_PX, POWER)


def _shares(
    residuals: Sequence[Array],
    noise: Array,
    held: NDArray[np.bool_],
    window_px: float,
    power: float,
    hidden: Sequence[float] = (),
    chances: Sequence[float] = (),
) -> NDArray[np.float32]:
    """Return the weights w_k of `shares_of`, for a window and a power.

    Over the n held-out readings y in the window around a pixel, of noise variance s, with factors
    h_k on what readings show of an error and p_k on the weight (default 1):

        E_k = max(h_k sum((y - Psi L_k)^2 - s) / n, sqrt(2 / n) mean(s))
        w_k = p_k E_k^-power / sum_j p_j E_j^-power
    """
    # The whole picture's mean square counts as one more reading at every place.
    readings = _around(held.astype(np.float64), window_px) + 1
    excess = []
    for residual in residuals:
        square = np.where(held, np.square(residual, dtype=np.float64) - noise, 0)
        whole = max(float(square.sum() / held.sum()), 0.0)
        excess.append((_around(square, window_px) + whole) / readings)
    allowed = np.where(held, noise, 0)
    whole = allowed.sum() / held.sum()
    typical = (_around(allowed, window_px) + whole) / readings
    # A mean of n squares of Gaussian noise is off by sqrt(2 / n) of it.
    floor = typical * np.sqrt(2 / readings) + 1e-20
    shown, weights = (
        np.reshape(factors or np.ones(len(residuals)), (-1, 1, 1)) for factors in (hidden, chances)
    )
    inverse = weights * np.maximum(shown * np.array(excess), floor) ** -power
    return (inverse / inverse.sum(axis=0)).astype(np.float32)


def beside_patches(
    residuals: Sequence[Array], noise: Array, held: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return what `shares_of` does where the last model is sparse patches, the others surfaces.

    Surfaces err alike, so they are averaged first, and their mean with the patches.
    """
    of_surfaces = shares_of(residuals[:-1], noise, held)
    weighted = [share * residual for share, residual in zip(of_surfaces, residuals, strict=False)]
    surfaces = np.sum(weighted, axis=0)
    pair = [surfaces, residuals[-1]]
    rule = PATCHES_WINDOW_PX, PATCHES_POWER, (HIDDEN, 1.0), (1.0, PATCHES_CHANCE)
    of_pair = _shares(pair, noise, held, *rule)
    return np.concatenate([of_pair[:1] * of_surfaces, of_pair[1:]])


def excess(residual: Array, noise: Array, held: NDArray[np.bool_]) -> float:
    """Return the mean square of the held-out residuals beyond noise, at least noise's own chance.

    residual, noise (a variance), held: (shot, pixel_y, pixel_x).
    """
    allowed = float(noise[held].mean(dtype=np.float64))
    square = float(np.square(residual[held], dtype=np.float64).mean())
    return max(square - allowed, allowed * (2 / held.sum()) ** 0.5)


def _around(values: Array, window_px: float) -> NDArray[np.float64]:
    """Return sums over all shots and a window, (pixel_y, pixel_x), of values (shot, ...)."""
    flat = values.sum(axis=0, dtype=np.float64)
    mean = cv2.GaussianBlur(flat, (0, 0), window_px, borderType=cv2.BORDER_REFLECT_101)
    # A Gaussian window weighs its n readings unevenly: as 4 pi window_px^2 pixels of equal weight.
    return np.asarray(4 * np.pi * window_px**2 * mean, dtype=np.float64)


def stored(light_field: Array) -> NDArray[np.uint16]:
    """Return a light field (v, u, y, x, c) in [0, 1] as 16 bits: to 8e-6, in half the memory.

    The mean needs all models at its end, and the first models stay in memory during later fits.
    """
    levels: NDArray[np.uint16] = np.empty(light_field.shape, dtype=np.uint16)

    def work(at: tuple[int, int]) -> None:
        levels[at] = np.rint(light_field[at] * np.float32(LEVELS))

    in_views(work, light_field.shape[:2])
    return levels


def values(levels: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Return what was stored."""
    return np.multiply(levels, np.float32(1 / LEVELS), dtype=np.float32)


def averaged(
    models: Sequence[NDArray[np.uint16]],
    shares: Array,
    binning: int,
    other: NDArray[np.uint16],
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the mean of light fields (v, u, y, x, c), and how they differ.

    Second, the variance of the models about it, and third, the squared difference between the mean
    and another light field; both (v, u, y, x), averaged over colours.

    models: as `stored`. shares: see `shares_of`. other: the light field that the mean is compared
    with, stored.
    """
    *views, rows, columns, colours = models[0].shape
    alone = [share.repeat(binning, axis=0).repeat(binning, axis=1) for share in shares]
    # As wide as lines of samples: a share for each value.
    wide = [np.repeat(share, colours, axis=1) for share in alone]
    mean = np.empty(models[0].shape, dtype=np.float32)
    spread: NDArray[np.float32] = np.empty((*views, rows, columns), dtype=np.float32)
    apart = np.empty_like(spread)

    def square(first: Array, second: Array) -> Array:
        difference = (first - second).reshape(rows, columns, colours)
        return np.einsum("yxc,yxc->yx", difference, difference) / np.float32(colours)

    def work(at: tuple[int, int]) -> None:
        seen = [values(model[at]).reshape(rows, -1) for model in models]
        of_view = mean[at].reshape(rows, -1)
        np.multiply(wide[0], seen[0], out=of_view)
        for share, model in zip(wide[1:], seen[1:], strict=True):
            of_view += share * model
        spread[at] = alone[0] * square(seen[0], of_view)
        for share, model in zip(alone[1:], seen[1:], strict=True):
            spread[at] += share * square(model, of_view)
        apart[at] = square(values(other[at]).reshape(rows, -1), of_view)

    in_views(work, mean.shape[:2])
    return mean, spread, apart

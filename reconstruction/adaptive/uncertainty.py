"""How far off a reconstruction is: a deviation per sample, calibrated on held-out readings.

Some readings are kept from the fit. What a texture may be wrong by is the noise that its last fit
let in or left in, and more where it is steep: by a blur that is the same for all views, and by a
wrong disparity, which counts more in views further from the centre. How much of the last two the
held-out readings tell: their misses are Gaussian with the variance of the noise and of these parts
(maximum likelihood, with heavy tails for what is wild).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.joint import Scene
from reconstruction.adaptive.refine import slopes

Array = NDArray[np.floating]
HELD_SHARE, MOST_SHARE = 0.02, 0.06
SMOOTH_PX = 2.0
CORRELATED_PX = 0.6
"""Errors of a texture are alike over about so far, exp(-r / it)."""
LET_IN, LEFT_IN = 6.0, 3.0
"""Variance of the texture over that of the noise which its last step let in; and, everywhere, over
that of a reading: what smoothing made of noise looks like texture. With these, on 14 captures (nine
real crops, five built-in scenes, one shot) 51 to 77 % of the errors lie within one deviation, 68 %
on average; without the second 45 to 79 %."""
SURE_PX = 0.05
"""Deviation of a disparity that the patches agree on."""
WITHIN_ONE = 0.6827
LEAST_SCALE = 0.25
APART = 0.55
"""Total variation: its light field's variance over what the readings' misfit is if its errors were
independent from ray to ray, 0.45 to 0.70 on four captures where it is better than surfaces (wide
disparities, glass, gloss)."""
FEWEST = 50
"""Held-out readings below which nothing is fitted."""


def held_out(
    usable: NDArray[np.bool_], share: float = HELD_SHARE, seed: int = 0
) -> NDArray[np.bool_]:
    """Return which usable readings (shot, pixel_y, pixel_x) to keep from the fit.

    A pixel is kept with all its shots: what it read in one would tell what it reads in another, and
    nothing of how well the light field is known in between. More than the share where there are
    few, so that a deviation can be fitted to them.
    """
    share = min(max(share, 2 * FEWEST / max(int(usable.sum()), 1)), MOST_SHARE)
    return usable & (np.random.default_rng(seed).random(usable.shape[1:]) < share)


@dataclass(frozen=True, eq=False)
class Deviation:
    """sigma: (v, u, y, x), of a value of any colour there. held: how many readings were kept from
    the fit. blur, slip: the fitted weights of squared slopes, alike in all views, and of those
    along the parallax: the square of a length in pixels, and a factor on the disparity's variance.
    """

    sigma: Array
    held: int
    blur: float
    slip: float


def _parts(scene: Scene, doubt: Array, noise_variance: float) -> Array:
    """Return the variance's parts, (3, v, u, y, x): noise, slopes, those by parallax."""
    let_in = np.square(scene.texture[0] - scene.clean[0]).mean(axis=0)
    steep = np.square(slopes(scene.clean[0])).mean(axis=1)
    smooth = [cv2.GaussianBlur(part, (0, 0), SMOOTH_PX) for part in (let_in, *steep)]
    both = np.stack([np.stack(smooth)] * 2).astype(np.float32)
    seen = np.maximum(scene.surfaces.light_field(both), 0)
    views_v, views_u = seen.shape[:2]
    v = (np.arange(views_v, dtype=np.float32) - views_v // 2)[:, None, None, None]
    u = (np.arange(views_u, dtype=np.float32) - views_u // 2)[None, :, None, None]
    noise, along_y, along_x = (seen[..., i] for i in range(3))
    parts = np.empty((3, *noise.shape), dtype=np.float32)
    np.multiply(noise, np.float32(LET_IN), out=parts[0])
    parts[0] += np.float32(LEFT_IN * noise_variance)
    np.add(along_y, along_x, out=parts[1])
    np.multiply(v**2, along_y, out=parts[2])
    parts[2] += u**2 * along_x
    parts[2] *= doubt + np.float32(SURE_PX**2)
    return parts


def _gathered(scene: Scene, parts: Array, held: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return what the parts add to the variance of the held-out readings, (part, reading)."""
    psi = scene.surfaces.psi
    k = psi.binning
    shot, pixel_y, pixel_x = np.nonzero(held)
    steps = np.indices(parts.shape[1:3]).reshape(2, -1).T
    apart = np.linalg.norm((steps[:, None] - steps[None]).astype(np.float64), axis=-1)
    out = np.zeros((len(parts), len(shot)))
    for sub_y in range(k):
        for sub_x in range(k):
            y, x = pixel_y * k + sub_y, pixel_x * k + sub_x
            weights = psi.weights[shot, :, :, y, :, x].astype(np.float64)
            weights = weights.reshape(len(shot), len(steps), -1)
            disparity = np.abs(scene.centre[y, x])
            alike = np.exp(-disparity[:, None, None] * apart / CORRELATED_PX)
            gain = np.einsum("hac,hab,hbc->h", weights, alike, weights, optimize=True)
            share = np.square(weights).sum(axis=-1)
            share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-30)
            for part, values in enumerate(parts):
                rays = values[:, :, y, x].reshape(len(steps), -1).T
                out[part] += gain * (share * rays).sum(axis=1)
    return out


def deviation(
    scene: Scene,
    doubt: Array,
    frames: Array,
    noise: Array,
    held: NDArray[np.bool_],
) -> Deviation | None:
    """Return the standard deviation of the scene's light field; None with too few readings held.

    doubt: (y, x), variance of the disparity. frames, their variance `noise`, held: (shot, pixel_y,
    pixel_x).
    """
    count = int(held.sum())
    if count < FEWEST:
        return None
    of_readings = noise[held].astype(np.float64)
    parts = _parts(scene, doubt, float(np.median(of_readings)))
    missed = (frames - scene.surfaces.forward(scene.texture))[held].astype(np.float64)
    let_in, blur, slip = _gathered(scene, parts, held)
    base = of_readings + let_in + 1e-12

    def surprise(logs: NDArray[np.float64]) -> float:
        variance = base + np.exp(logs[0]) * blur + np.exp(logs[1]) * slip
        # Student's t of 4 degrees: a few wild readings (occlusions) must not set the scale.
        return float(np.sum(np.log(variance) + 5 * np.log1p(missed**2 / (4 * variance))))

    found = minimize(surprise, np.log([0.1, 1.0]), method="Nelder-Mead").x
    weights = np.exp(found)
    predicted = let_in + weights[0] * blur + weights[1] * slip
    # The scale at which 68 % of the held-out readings lie within one deviation, noise included.
    beyond = np.maximum(np.square(missed) - of_readings, 0) / np.maximum(predicted, 1e-20)
    scale = max(float(np.quantile(beyond, WITHIN_ONE)), LEAST_SCALE)
    variance = np.tensordot(np.array([scale, *(scale * weights)], np.float32), parts, axes=1)
    return Deviation(np.sqrt(variance), count, *map(float, weights))


def plain_deviation(
    psi: ImagingMatrix, missed: Array, noise: Array, held: NDArray[np.bool_], share: Array
) -> float:
    """Return the standard deviation of total variation's light field, where it has a share.

    missed: what it misses of the frames, noise: their variance, held: the readings kept from the
    fit, all (shot, pixel_y, pixel_x); share: (pixel_y, pixel_x).
    """
    weight = np.where(held, share, 0).astype(np.float64)
    rows = np.einsum("ssyx->syx", psi.gram)
    excess = float((weight * (np.square(missed) - noise)).sum())
    return float(np.sqrt(APART * max(excess, 0.0) / max(float((weight * rows).sum()), 1e-12)))

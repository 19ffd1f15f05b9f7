"""The standard deviation of a reconstruction, per sample, calibrated on held-out readings.

Some readings are kept from every fit. The variance of a sample of the light field is modelled as

    sigma^2 = s (N + b B + e E):

N, the noise that the last fit let into the texture or left in it; B, the squared slopes of the
texture, for errors of position that all views share; E, the spread between the models of the mean
(`mixture`), which is large where they disagree, at wrong disparities and occlusions.

Each part predicts a variance of the held-out residuals r = I - Psi L, if errors are correlated
along the texture: rays of one pixel that meet it far apart err independently. b and e maximise the
likelihood of r, of a Student t since some residuals are wild. The scale s then makes a share
WITHIN_ONE of them lie within one deviation: a split conformal calibration (Vovk et al. 2005) on
readings instead of samples, which needs no true light field.

Errors that the rays of a pixel average out stay unseen, as at a wrong disparity. A second estimate,
total variation's, shows them: were its errors independent, the squared difference would
be the sum of both squared errors. It is shared out as the held-out residuals' mean squares are,
unless one plane is the whole scene: its disparity is known.

What this misses on average is taken from captures of known truth: FEATURES of a capture foretell by
how many dB its mean square error, and the square below which WITHIN_ONE of its errors lie, exceed
that variance. The latter scales sigma. The former is the PSNR stated, and how far captures of
scenes that were not fitted to lie from it is its interval (conformal, as Wen et al. 2025, arXiv
2505.09528; of scenes rather than captures, as those of one scene err alike).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_views
from emmc_rig.model.lightfield import sum_of_squares
from emmc_rig.reconstruction.adaptive.joint import FittedScene
from emmc_rig.reconstruction.adaptive.refine import slopes
from emmc_rig.reconstruction.adaptive.search import Moments
from emmc_rig.reconstruction.result import SCALE, TAILS

Array = NDArray[np.floating]
HELD_SHARE, MOST_SHARE = 0.02, 0.06
SMOOTH_PX = 2.0
"""Deviation of the blur of every part, in pixels. For E alone, 1 and 0.7 change the scatter of the
coverage over group A by less than 0.005."""
CORRELATED_PX = 0.6
"""Errors of a texture are correlated as exp(-r / CORRELATED_PX) at a distance r."""
LET_IN, LEFT_IN = 6.0, 3.0
"""Variance of the texture over that of the noise which its last step let in; and, everywhere, over
that of a reading: what smoothing made of noise looks like texture. Fitted on 14 captures (nine real
crops, five built-in scenes, one shot): without the second the coverage scatters twice as much."""
WITHIN_ONE = 0.6827
FREEDOM = 4.0
"""Of the Student t of the residuals."""
LEAST_SCALE = 0.1
FEWEST = 50
"""Held-out readings below which no deviation is stated."""


def held_out(
    usable: NDArray[np.bool_], share: float = HELD_SHARE, seed: int = 0
) -> NDArray[np.bool_]:
    """Return which usable readings (shot, pixel_y, pixel_x) to keep from the fit.

    A pixel is kept with all its shots: each ray would predict the others, whether or not the light
    field is right between the rays. More than the share where there are few readings, so that a
    deviation can be fitted to them.
    """
    share = min(max(share, 2 * FEWEST / max(int(usable.sum()), 1)), MOST_SHARE)
    return usable & (np.random.default_rng(seed).random(usable.shape[1:]) < share)


@dataclass(frozen=True, eq=False)
class _Parts:
    """let_in, steep, spread: (v, u, y, x). N is the first plus left_in, B and E are the others."""

    let_in: Array
    steep: Array
    spread: Array
    left_in: float

    def of_rays(self, y: NDArray[np.intp], x: NDArray[np.intp]) -> Iterator[NDArray[np.float64]]:
        """Yield N, B and E of samples, (reading, ray)."""
        rays = self.spread.shape[0] * self.spread.shape[1]
        for part, more in ((self.let_in, self.left_in), (self.steep, 0.0), (self.spread, 0.0)):
            yield part[:, :, y, x].reshape(rays, -1).T.astype(np.float64) + more

    def weighted(self, weights: Sequence[float]) -> NDArray[np.float32]:
        """Return the sum of N, B and E, so many times each, in place of the spread."""
        let_in, steep, spread = (np.float32(weight) for weight in weights)

        def work(at: tuple[int, int]) -> None:
            out = self.spread[at]
            out *= spread
            out += let_in * self.let_in[at] + let_in * np.float32(self.left_in)
            out += steep * self.steep[at]

        in_views(work, self.spread.shape[:2])
        return self.spread


def _parts(scene: FittedScene, scale: float, noise_variance: float, spread: Array) -> _Parts:
    """Return the parts of every sample; the spread is blurred in place."""
    let_in = np.float32(LET_IN) * np.square(scene.texture - scene.clean).mean(axis=0)
    steep = np.square(slopes(scene.clean)).mean(axis=1).sum(axis=0)
    smooth = np.stack([blurred(part) for part in (let_in, steep)])
    # Cubic weights may overshoot below 0.
    smooth *= np.float32(scale**2)
    seen = scene.surfaces.light_field(smooth)
    np.maximum(seen, 0, out=seen)
    blur_views(spread)
    return _Parts(seen[..., 0], seen[..., 1], spread, LEFT_IN * noise_variance)


def blurred(part: Array) -> Array:
    """Return one picture (y, x), blurred by SMOOTH_PX."""
    return np.asarray(cv2.GaussianBlur(part, (0, 0), SMOOTH_PX), dtype=np.float32)


def blur_views(values: NDArray[np.float32]) -> None:
    """Blur every view of (v, u, y, x), in place."""

    def work(at: tuple[int, int]) -> None:
        values[at] = blurred(values[at])

    in_views(work, values.shape[:2])


def _of_readings(scene: FittedScene, parts: _Parts, held: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return what N, B and E add to the variance of the held-out readings, (part, reading).
    The rays of a pixel meet the texture |disparity| apart per view step.
    """
    psi = scene.surfaces.psi
    k = psi.binning
    shot, pixel_y, pixel_x = np.nonzero(held)
    steps = np.indices(psi.views).reshape(2, -1).T
    apart = np.linalg.norm((steps[:, None] - steps[None]).astype(np.float64), axis=-1)
    out = np.zeros((3, len(shot)))
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
            for part, rays in enumerate(parts.of_rays(y, x)):
                out[part] += gain * (share * rays).sum(axis=1)
    return out


def variance_of_mean(
    scene: FittedScene,
    scale: float,
    spread: Array,
    residual: Array,
    noise: Array,
    held: NDArray[np.bool_],
) -> NDArray[np.float32] | None:
    """Return the variance of a mean of models, of a value of any colour, (v, u, y, x).

    None with too few readings held out. It takes the place of the spread.

    scene: the last fit, of a light field over `scale`. spread: variance (v, u, y, x) between
    the models. residual: of the mean; noise: variance of the readings; held: those kept from the
    fits, all (shot, pixel_y, pixel_x).
    """
    if held.sum() < FEWEST:
        return None
    allowed = noise[held].astype(np.float64)
    square = np.square(residual[held], dtype=np.float64)
    parts = _parts(scene, scale, float(np.median(allowed)), spread)
    of_readings = _of_readings(scene, parts, held)
    least = 1e-6 * float(square.mean()) + 1e-30

    def predicted(logs: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.append(1, np.exp(logs)) @ of_readings

    def surprise(logs: NDArray[np.float64]) -> float:
        variance = allowed + predicted(logs) + least
        tails = (FREEDOM + 1) * np.log1p(square / (FREEDOM * variance))
        return float(np.sum(np.log(variance) + tails))

    from scipy.optimize import minimize  # loads for 0.1 s, which listings do not need

    logs = minimize(surprise, np.log([0.1, 1.0]), method="Nelder-Mead").x
    over = np.maximum(square - allowed, 0) / np.maximum(predicted(logs), least)
    scale = max(float(np.quantile(over, WITHIN_ONE)), LEAST_SCALE)
    blur, apart = (float(value) for value in np.exp(logs))
    return parts.weighted((scale, scale * blur, scale * apart))


class Foretold(NamedTuple):
    """What a feature adds per unit, within what was fitted, to the dB of the mean square error over
    the mean variance, and of the square of the deviation over the variance."""

    error_db: float
    deviation_db: float
    lowest: float
    highest: float


FEATURES = {
    "apart": Foretold(1.265, 0.290, -1.62, 2.99),
    "disparity": Foretold(2.868, 1.416, -3.12, -0.98),
    "spread": Foretold(0.0, 1.018, -3.18, 0.35),
    "contrast": Foretold(0.0, -1.584, -1.72, -0.22),
}
"""Printed by `benchmarks/stated.py --fit`, as what follows: 95 trusted captures of group A and the
built-in scenes, 96x96, one to three shots, noise 0.003 and 0.01."""
SEARCH_MISSES = 1.2
"""By how much disparity is missed, over what searches expect of its error. Of 23 captures of group
A and of built-in scenes, 96x96, one and three shots, 77 % of the disparities (median) are within
one deviation and 95 % within two; without the factor 71 and 93 %, with 1.5 86 and 98 %."""
ERROR_DB, DEVIATION_DB = 6.29, 1.89
WITHIN_DB, EVEN_DECIDED = 5.63, 0.5
"""The true PSNR lies within WITHIN_DB (EVEN_DECIDED + u) of the one stated, u of the patches being
undecided. With EVEN_DECIDED 0.3 intervals are 0.5 dB narrower in the median, and two of six other
captures of the built-in scenes (`adaptive-fast`, 48x64) lie outside; with 1, 0.9 dB wider."""


def disparity_deviation(disparity: Array, searches: Sequence[Moments]) -> NDArray[np.float32]:
    """Return the deviation (y, x) of a disparity that was fitted to what searches believe.

    Of a search with mean m and variance s^2 the expected square of the error of the disparity d is
    s^2 + (m - d)^2, so that a search that believes in another surface counts as a gross error. The
    larger of two searches counts.
    """
    squares = [known.variance + np.square(known.mean - disparity) for known in searches]
    return np.float32(SEARCH_MISSES) * np.sqrt(np.max(squares, axis=0))


def features(
    variance: float, apart: float, spread: float, disparity_sigma: Array, of: Array
) -> dict[str, float]:
    """Return the FEATURES of a capture, all natural logarithms.

    variance: the samples' mean, as here without them; over it are those of apart, the mean squared
    difference of the two estimates, and spread, the mean variance between the models.
    disparity_sigma (y, x): median, in pixels. of: the light field, its standard deviation over its
    mean.
    """
    whole = max(variance, 1e-30)
    sums = np.zeros((2, *of.shape[:2]))

    def work(at: tuple[int, int]) -> None:
        sums[:, *at] = sum_of_squares(of[at]), of[at].sum(dtype=np.float64)

    in_views(work, of.shape[:2])
    square, mean = sums.reshape(2, -1).sum(axis=1) / of.size
    mean = max(float(mean), 1e-30)
    values = {
        "apart": apart / whole,
        "disparity": np.median(disparity_sigma),
        "spread": spread / whole,
        "contrast": max(float(square) / mean**2 - 1, 0.0) ** 0.5,
    }
    return {name: float(np.log(max(float(value), 1e-30))) for name, value in values.items()}


def foretold_db(of: Mapping[str, float]) -> tuple[float, float]:
    """Return the dB of the mean square error over the mean variance, and of the square of the
    deviation over the variance, for a capture of these FEATURES."""
    error_db, deviation_db = ERROR_DB, DEVIATION_DB
    for name, feature in FEATURES.items():
        value = min(max(of[name], feature.lowest), feature.highest)
        error_db += feature.error_db * value
        deviation_db += feature.deviation_db * value
    return error_db, deviation_db


def stated(of: Mapping[str, float]) -> tuple[np.float32, dict[str, float]]:
    """Return the square of the deviation over the variance, and what to report, for FEATURES."""
    error_db, deviation_db = foretold_db(of)
    reported = {f"stated_{name}": value for name, value in of.items()}
    reported |= {TAILS: error_db - deviation_db, SCALE: deviation_db}
    return np.float32(10 ** (deviation_db / 10)), reported


def within_db(decided: float | None) -> float:
    """Return how far the true PSNR lies from the one stated, in 9 of 10 captures at most.

    decided: share of the textured patches that prefer some disparity; None without any.
    """
    return WITHIN_DB * (EVEN_DECIDED + 1 - (1.0 if decided is None else decided))

"""What the variational methods minimise, and what the data choose in it: the paper's eq. 9.

min over L of 1/2 |Psi L - I|^2 + mu DV_K(L) + rho/2 |P L - Lhat|^2, over the usable pixels. The
last term, for patches of any sizes, places and weights w (Section VI-B), is rho/2 sum_(y, x) W
|L - M|^2 + const: W(y, x) sums the weights of the patches that cover a sample, M is their weighted
mean. So L needs no patches any more.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import Psi, rows_of_colours
from emmc_rig.reconstruction.colour import coloured
from emmc_rig.reconstruction.differences import norm_squared, planar_variation

Array = NDArray[np.floating]
SMALLEST_RELATIVE_MU = 2e-5
"""Of mu for a brightness of 1 and no noise, see `relative_mu`."""
DARK = 0.1
"""Share of the light that a mask passes, below which settings follow from those of a brighter."""
BLUR_SAMPLES = 4.0
"""Deviation of the blur of the smooth guess, times the binning."""


def colour_metric(chroma_weight: float) -> NDArray[np.float64]:
    """Return what turns R, G, B into weighted opponent colours, (3, 3)."""
    return np.diag([1, chroma_weight, chroma_weight]) @ OPPONENT


@dataclass(frozen=True, eq=False)
class PatchTerm:
    """What patch estimates ask of a light field.

    target: M, (v, u, y, x, c) float32. weight: W, (y, x) float32, 0 where nothing is known, the
    same for all samples of a pixel.
    """

    target: NDArray[np.float32]
    weight: NDArray[np.float32]

    def value(self, light_field: Array) -> float:
        """Return 1/2 sum W |L - M|^2 of a light field (v, u, y, x, c), without rho."""
        total = 0.0
        for view in np.ndindex(self.target.shape[:2]):
            square = np.square(light_field[view] - self.target[view], dtype=np.float64)
            total += float(np.sum(self.weight * square.sum(axis=-1)))
        return total / 2


@dataclass(frozen=True, eq=False)
class Problem:
    """The objective's terms.

    frames, usable: (shot, pixel_y, pixel_x), readings 0 where not usable. order: K of DV_K. metric:
    (3, 3) of Psi's type, by which colours are multiplied before differences are taken.
    """

    psi: Psi
    frames: Array
    usable: NDArray[np.bool_]
    mu: float
    order: int
    metric: Array
    patch_term: PatchTerm | None = None
    rho: float = 0.0

    def value(self, light_field: Array) -> float:
        """Return the objective at a light field (v, u, y, x, c), fastest if stored (v, u, y, c, x).

        That of the patches leaves out what no light field changes.
        """
        misfit = (self.psi.forward(light_field) - self.frames)[self.usable]
        planar = np.ascontiguousarray(rows_of_colours(light_field))
        variation = planar_variation(planar, self.order, self.metric)
        value = 0.5 * np.sum(np.square(misfit, dtype=np.float64)) + self.mu * variation
        if self.patch_term is not None:
            value += self.rho * self.patch_term.value(light_field)
        return float(value)

    def pixel_weight(self) -> NDArray[np.float64]:
        """Return rho W of the samples of each pixel, (pixel_y, pixel_x)."""
        if self.patch_term is None:
            return np.zeros(self.psi.frames_shape[1:])
        k = self.psi.binning
        return self.rho * self.patch_term.weight[::k, ::k].astype(np.float64)


def choose_mu(psi: Psi, frames: Array, noise_sigma: float, order: int = 1) -> float:
    """Return mu for frames (of usable pixels), see `relative_mu`.

    That was fitted where masks pass half the light. Psi, frames and noise c times as small are the
    same problem with mu c^2 times as small: so it is taken for masks darker than DARK.
    """
    passed = psi.light_efficiency()
    brightness = max(float(np.mean(frames)) / max(passed, 1e-12), 1e-12)
    views_v, views_u = psi.light_field_shape[:2]
    spread = np.sqrt(psi.shots) / (views_v * views_u * psi.binning)
    dark = min(1.0, max(passed, 1e-12) / DARK)
    return brightness * dark**2 * relative_mu(noise_sigma / dark / brightness, spread, order)


def relative_mu(noise: float, spread: float, order: int) -> float:
    """Return mu for a brightness of 1: 0.68 spread noise^1.5, and never quite 0.

    noise: its deviation over the mean brightness. spread: sqrt(shots) / (views binning).
    Scaling readings and noise together scales mu with them, and so the light field. Every view
    adds its own variation to DV_1 for one reading, hence 1 / views. The other exponents and the
    factor were fitted to the best mu of 191 runs on the built-in scenes (2x2 to 7x7 views, Bayer
    and monochrome, one to three shots, k = 1 and 2, noise of 1-9 % of the mean brightness): the
    loss against the best was 0.05 dB on average and 0.4 dB at most, and the same in 94 runs with
    a chrominance weight of 2. Without noise the minimiser tends to the least variation that
    explains the frames, reached at a small mu.
    """
    return max(SMALLEST_RELATIVE_MU, 0.68 * spread * noise**1.5)


def choose_primal_step(contrast: float, mu: float, chroma_weight: float, order: int = 1) -> float:
    """Return gamma: the light field's contrast over mu, as `contrast` measures it.

    For higher orders less, by the norms of their derivatives: the dual variable moves that much
    the light field. Of factors 0.01, 0.03, 0.1 and 0.3 on crops of two real light fields, 0.1 to
    0.3 led after 200 steps for K = 2 (here 0.32) and 0.03 to 0.1 for K = 3 (here 0.11).
    """
    endless = (None,) * 4
    stretch = np.sqrt(norm_squared(order, endless) / norm_squared(1, endless))
    return float(0.18 * contrast / mu / max(1.0, chroma_weight) / stretch)


def contrast(guess: Array) -> float:
    """Return the deviation of a smooth picture (y, x, c), or 5 % of its peak, and never quite 0."""
    return max(float(guess.std()), 0.05 * float(np.abs(guess).max()), 1e-12)


def smooth_guess(psi: Psi, frames: Array, usable: NDArray[np.bool_]) -> Array:
    """Return a blurred picture (y, x, c) that explains the frames' local means, float32.

    Every colour is the ratio of blurred back-projections, as if all views were equal; without
    colour filters that ratio is grey, and colours follow from the masks (`colour`).
    """
    readings = np.where(usable, frames, 0).astype(np.float32)
    of_white = psi.forward_picture(np.ones((*psi.size, 3), dtype=np.float32)) * usable

    def blurred(image: Array) -> Array:
        back = psi.adjoint_picture(image).astype(np.float32)
        return cv2.GaussianBlur(back, (0, 0), BLUR_SAMPLES * psi.binning)

    light, white = blurred(readings), blurred(of_white)
    picture = np.maximum(light, 0) / np.maximum(white, 1e-3 * float(white.mean()))
    return picture if psi.colour is not None else coloured(psi, readings, usable, picture)


def first_light_field(psi: Psi, guess: Array, patch_term: PatchTerm | None) -> Array:
    """Return a light field to begin with: the patches where there are any, else the guess."""
    everywhere = np.broadcast_to(guess, psi.light_field_shape)
    if patch_term is None:
        return everywhere
    return np.where((patch_term.weight > 0)[..., None], patch_term.target, everywhere)

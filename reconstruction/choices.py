"""What the data choose where the settings do not: mu, the primal step, where to begin."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.reconstruction.colour import coloured
from emmc_rig.reconstruction.differences import norm_squared
from emmc_rig.reconstruction.problem import PatchTerm

Array = NDArray[np.floating]
SMALLEST_RELATIVE_MU = 2e-5
DARK = 0.1
"""Share of the light that a mask passes, below which settings follow from those of a brighter."""
BLUR_SAMPLES = 4.0
"""Deviation of the blur of the smooth guess, times the binning."""


def darkness(psi: ImagingMatrix) -> float:
    """Return how much darker Psi is than the darkest for which settings were fitted; else 1."""
    return min(1.0, max(psi.light_efficiency(), 1e-12) / DARK)


def choose_mu(psi: ImagingMatrix, frames: Array, noise_sigma: float, order: int = 1) -> float:
    """Return mu for frames (of usable pixels), see `relative_mu`.

    That was fitted where masks pass half the light. Psi, frames and noise c times as small are the
    same problem with mu c^2 times as small: so it is taken for masks darker than DARK.
    """
    passed = psi.light_efficiency()
    brightness = max(float(np.mean(frames)) / max(passed, 1e-12), 1e-12)
    views_v, views_u = psi.light_field_shape[:2]
    spread = np.sqrt(psi.shots) / (views_v * views_u * psi.binning)
    dark = darkness(psi)
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


def smooth_guess(psi: ImagingMatrix, frames: Array, usable: NDArray[np.bool_]) -> Array:
    """Return a blurred picture (y, x, c) that explains the frames' local means, float32.

    Every colour is the ratio of blurred back-projections, as if all views were equal; without
    colour filters that ratio is grey, and colours follow from the masks (`colour`).
    """
    kept = np.where(usable, frames, 0).astype(np.float32)
    seen = psi.forward_picture(np.ones((*psi.size, 3), dtype=np.float32)) * usable
    deviation = BLUR_SAMPLES * psi.binning
    blurred = [
        cv2.GaussianBlur(psi.adjoint_picture(image).astype(np.float32), (0, 0), deviation)
        for image in (kept, seen)
    ]
    floor = 1e-3 * float(blurred[1].mean())
    picture = np.maximum(blurred[0], 0) / np.maximum(blurred[1], floor)
    return picture if psi.colour is not None else coloured(psi, kept, usable, picture)


def first_light_field(psi: ImagingMatrix, guess: Array, patch_term: PatchTerm | None) -> Array:
    """Return a light field to begin with: the patches where there are any, else the guess."""
    found = np.broadcast_to(guess, psi.light_field_shape)
    if patch_term is None:
        return found
    return np.where((patch_term.weight > 0)[..., None], patch_term.target, found)

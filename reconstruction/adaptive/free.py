"""Where no surface explains the frames: 4D total variation, where readings kept from both say so.

Readings that neither was fitted to are missed by the one less than by the other: averaged over a
window, beyond chance, that tells which is nearer to the light field there (glass, gloss, occlusions
finer than the pixels). The two are joined softly.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]
WINDOW_PX = 16.0
"""Deviation of the window, in pixels: some 60 readings of those kept."""
PROOF = 0.5
"""Standard errors by which total variation must miss less."""
SOFT_PX = 4.0
"""Deviation of the change from the one to the other, in pixels."""
APART = 0.55
"""The light field's variance over what the readings' misfit is if its errors were independent from
ray to ray: 0.45 to 0.70 on four captures where total variation is better (wide disparities, glass,
gloss)."""


@dataclass(frozen=True, eq=False)
class Freedom:
    """share: (y, x), of total variation at every sample, 0 to 1. variance: of its light field where
    it has a share."""

    share: NDArray[np.float32]
    variance: float


def freedom(
    psi: ImagingMatrix, surfaces: Array, plain: Array, noise: Array, held: NDArray[np.bool_]
) -> Freedom:
    """Return where total variation is to be preferred to surfaces.

    surfaces, plain: what each misses of the frames, noise: their variance, held: the readings kept
    from both, all (shot, pixel_y, pixel_x).
    """
    gain = np.where(held, np.square(surfaces, dtype=np.float64) - np.square(plain), 0)
    mean = cv2.GaussianBlur(gain.sum(axis=0), (0, 0), WINDOW_PX)
    # The squared window is one of a deviation less by sqrt(2), and of a smaller sum.
    squares = cv2.GaussianBlur(np.square(gain).sum(axis=0), (0, 0), WINDOW_PX / np.sqrt(2))
    error = np.sqrt(np.maximum(squares, 0) / (4 * np.pi * WINDOW_PX**2))
    better = (mean > PROOF * error).astype(np.float32)
    share = cv2.GaussianBlur(better, (0, 0), SOFT_PX).clip(0, 1)
    weight = np.where(held, share, 0)
    total = float(weight.sum(dtype=np.float64))
    variance = 0.0
    if total > 0:
        rows = np.einsum("ssyx->syx", psi.gram)
        excess = float((weight * (np.square(plain) - noise)).sum(dtype=np.float64))
        variance = APART * max(excess, 0.0) / max(float((weight * rows).sum()), 1e-12)
    k = psi.binning
    return Freedom(share.repeat(k, axis=0).repeat(k, axis=1).astype(np.float32), variance)

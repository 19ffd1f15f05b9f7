"""Where no surface explains the frames: 4D total variation, drawn to the surfaces where they do.

Readings that the surfaces miss by more than noise tell how far the light field may be from them:
its deviation s there gives the patch term of the paper's functional the weight noise^2 / s^2, and
total variation decides what the frames alone leave open (glass, gloss, occlusions misplaced).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.patch_term import PatchTerm
from reconstruction.tv import TVSettings, reconstruct_tv

Array = NDArray[np.floating]
WINDOW_PX = 3.0
"""Deviation of the window within which misfit is averaged."""
ACCEPTED = 1.5
"""Times the noise's variance that is not yet called misfit."""
ALIKE = 15.0
"""The light field's variance over what the readings' misfit is if its errors were independent from
ray to ray; they are alike, so more hides in a reading than it shows."""
APART = 0.55
"""The same of total variation where surfaces fail, from readings kept from its fit: 0.45 to 0.70 on
four such captures (wide disparities, glass, gloss)."""
SURE = 0.01
"""Deviation of the light field where nothing is missed."""
STEPS = 40
LEAST_NOISE = 1e-3
"""Readings are not trusted further than this."""


def misfit(
    psi: ImagingMatrix, missed: Array, noise: Array, usable: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the variance of the light field that the missed part of the readings speaks for.

    missed: frames less those of the estimate, noise: their variance, both (shot, pixel_y, pixel_x).
    Returns (pixel_y, pixel_x), 0 where the readings are missed by noise alone.
    """
    rows = np.einsum("ssyx->syx", psi.gram)
    counted = usable & (rows > 0)
    safe = np.where(counted, rows, 1)
    excess = (np.square(missed) - ACCEPTED * noise) / safe
    total = np.where(counted, excess, 0).sum(axis=0)
    blurred = [
        cv2.GaussianBlur(part.astype(np.float32), (0, 0), WINDOW_PX)
        for part in (total, counted.sum(axis=0))
    ]
    return np.maximum(blurred[0], 0) / np.maximum(blurred[1], 1e-3)


def missed_variance(
    psi: ImagingMatrix, missed: Array, noise: Array, held: NDArray[np.bool_]
) -> float:
    """Return the mean variance of the light field that the missed part of held-out readings shows.

    missed: (reading,), of those held; noise: variance, held: (shot, pixel_y, pixel_x).
    """
    excess = np.square(missed, dtype=np.float64).mean() - float(noise[held].mean())
    rows = np.einsum("ssyx->syx", psi.gram)[held].mean()
    return float(APART * max(excess, 0.0) / max(rows, 1e-12))


def freed(
    psi: ImagingMatrix,
    frames: Array,
    noise_sigma: float,
    usable: NDArray[np.bool_],
    light_field: NDArray[np.float32],
    variance: NDArray[np.float32],
    scale: float = 1.0,
) -> NDArray[np.float32]:
    """Return the light field (v, u, y, x, c), free where the variance (pixel_y, pixel_x) is large.

    light_field: of the surfaces. scale: of its values, 1 where they are of order 1. The weight of
    total variation is chosen as always (`choices`).
    """
    k = psi.binning
    noise = max(noise_sigma, LEAST_NOISE * scale)
    share = noise**2 / ((SURE * scale) ** 2 + ALIKE * variance.repeat(k, axis=0).repeat(k, axis=1))
    rho = float(share.max())
    term = PatchTerm(light_field, (share / rho).astype(np.float32))
    settings = TVSettings(rho=rho, max_steps=STEPS)
    return reconstruct_tv(psi, frames, noise_sigma, settings, usable, patch_term=term).light_field

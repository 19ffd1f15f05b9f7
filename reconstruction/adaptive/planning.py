"""Which further shot would help most: the error to be expected with each, before it is taken.

A patch of known disparity and kind of texture is Gaussian (see `evidence`), so that its expected
error given any shots follows from their Psi alone: prior variance less what the readings explain,
K - K Psi^T (Psi K Psi^T + noise)^-1 Psi K. It is averaged over patches spread over the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.errors import ReconstructionError
from reconstruction.problem import OPPONENT

Array = NDArray[np.floating]
SIDE = 8
PATCHES = 24
TARGETS = 4
"""Samples a side, in the middle of a patch, whose error counts."""


def patch_error(
    psi: ImagingMatrix,
    corner: tuple[int, int],
    disparity: float,
    amplitude: float,
    chroma: float,
    variance: float,
    prior: TexturePrior,
) -> float:
    """Return the expected squared error of a value in the middle of a patch.

    corner: (y, x), in samples, of SIDE x SIDE samples in pixels of k x k. amplitude: variance of
    luminance; chroma: that of a chrominance over it. variance: of a reading.
    """
    k = psi.binning
    rows, columns = (slice(at, at + SIDE) for at in corner)
    part = psi.window(rows, columns)
    views_v, views_u = part.light_field_shape[:2]
    v, u, y, x = (axis.ravel() for axis in np.indices((views_v, views_u, SIDE, SIDE)))
    at = np.stack([y - disparity * (v - views_v // 2), x - disparity * (u - views_u // 2)], axis=1)
    first = (SIDE - TARGETS) // 2
    inner = (np.minimum(y, x) >= first) & (np.maximum(y, x) < first + TARGETS)
    alike = prior.covariance(np.square(at[:, None] - at[None]).sum(axis=-1))
    rays = np.zeros((psi.shots, SIDE // k, SIDE // k, 3, at.shape[0]))
    for shot in range(psi.shots):
        for kind in range(part.weights.shape[4]):
            weights = part.weights[shot, v, u, y, kind, x]
            colour = kind if part.colour is None else part.colour[shot, y, x]
            rays[shot, y // k, x // k, colour, np.arange(at.shape[0])] = weights
    opponent = np.einsum("oc,mcr->omr", OPPONENT, rays.reshape(-1, 3, at.shape[0]))
    variances = amplitude * np.array([1, chroma, chroma])
    seen = [axis @ alike for axis in opponent]
    covariance = sum(
        size * near @ axis.T for size, near, axis in zip(variances, seen, opponent, strict=True)
    )
    factor = cho_factor(covariance + variance * np.eye(opponent.shape[1]))
    error = 0.0
    for size, near in zip(variances, seen, strict=True):
        cross = size * near[:, inner]
        error += size - float(np.mean(np.sum(cross * cho_solve(factor, cross), axis=0)))
    return error / 3


def expected_errors(
    candidates: Sequence[ImagingMatrix],
    disparity: Array,
    kinds: Array,
    brightness: Array,
    variance: float,
    patches: int = PATCHES,
) -> NDArray[np.float64]:
    """Return the mean squared error to be expected with each candidate's shots, (candidate,).

    candidates: Psi of all shots taken and one more, each. disparity, brightness: (y, x) of the
    centre view. kinds: (y, x) indices of the textures in TexturePrior.kinds. Raises
    ReconstructionError for light fields smaller than a patch.
    """
    prior = TexturePrior()
    rows, columns = disparity.shape
    if min(rows, columns) < SIDE or SIDE % candidates[0].binning:
        raise ReconstructionError(
            f"a light field of {rows}x{columns} in pixels of {candidates[0].binning} samples "
            f"holds no patch of {SIDE}x{SIDE}"
        )
    across = max(1, round((patches * columns / rows) ** 0.5))
    down = max(1, patches // across)
    k = candidates[0].binning
    corners = [
        (int(y) // k * k, int(x) // k * k)
        for y in np.linspace(0, rows - SIDE, down)
        for x in np.linspace(0, columns - SIDE, across)
    ]
    errors = np.zeros(len(candidates))
    for corner in corners:
        middle = corner[0] + SIDE // 2, corner[1] + SIDE // 2
        amplitude, chroma = prior.kinds[int(kinds[middle])]
        for number, psi in enumerate(candidates):
            errors[number] += patch_error(
                psi,
                corner,
                float(disparity[middle]),
                amplitude * float(brightness[middle]) ** 2,
                chroma,
                variance,
                prior,
            )
    return errors / len(corners)

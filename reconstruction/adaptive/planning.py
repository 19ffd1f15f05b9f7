"""Which further shot would help most: the error to be expected with each, before it is taken.

A patch of one kind of texture is Gaussian (see `evidence`), and what its disparity is in doubt by
moves it along its slopes from view to view. So its expected error given any shots follows from
their Psi alone: prior variance less what the readings explain, K - K Psi^T (Psi K Psi^T + noise)^-1
Psi K. It is averaged over patches spread over the scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.adaptive.evidence import TexturePrior
from reconstruction.errors import ReconstructionError

Array = NDArray[np.floating]
SIDE = 8
PATCHES = 24
MOST_DOUBT_PX = 1.0
"""Further off a texture is another one, and its slopes say nothing."""
TARGETS = 4
"""Samples a side, in the middle of a patch, whose error counts."""


def patch_errors(
    psi: ImagingMatrix,
    choices: Sequence[Sequence[int]],
    disparity: float,
    amplitude: float,
    chroma: float,
    variance: float,
    prior: TexturePrior,
    doubt: float = 0.0,
    slopes: Array | None = None,
) -> NDArray[np.float64]:
    """Return the expected squared error of a value in the middle of a patch, (choice,).

    psi: of the patch, SIDE x SIDE samples in pixels of k x k. choices: indices of shots, each.
    amplitude: variance of luminance; chroma: that of a chrominance over it. variance: of a reading.
    doubt: variance of the disparity; slopes: of the centre view, down and right (2, y, x, c).
    """
    k, readings = psi.binning, (SIDE // psi.binning) ** 2
    views_v, views_u = psi.light_field_shape[:2]
    v, u, y, x = (axis.ravel() for axis in np.indices((views_v, views_u, SIDE, SIDE)))
    at = np.stack([y - disparity * (v - views_v // 2), x - disparity * (u - views_u // 2)], axis=1)
    first = (SIDE - TARGETS) // 2
    inner = (np.minimum(y, x) >= first) & (np.maximum(y, x) < first + TARGETS)
    alike = prior.covariance(cdist(at, at, "sqeuclidean"))
    ray = np.arange(len(at))
    pixel = y // k * (SIDE // k) + x // k
    opponent = [sparse.csr_array((psi.shots * readings, len(at))) for _ in OPPONENT]
    for shot in range(psi.shots):
        for kind in range(psi.weights.shape[4]):
            weights = psi.weights[shot, v, u, y, kind, x]
            colour = np.full_like(y, kind) if psi.colour is None else psi.colour[shot, y, x]
            for axis, mixed in enumerate(OPPONENT):
                opponent[axis] += sparse.csr_array(
                    (weights * mixed[colour], (shot * readings + pixel, ray)),
                    shape=opponent[axis].shape,
                )
    variances = amplitude * np.array([1, chroma, chroma])
    seen = [axis @ alike for axis in opponent]
    steps = np.stack([v - views_v // 2, u - views_u // 2])
    moved = np.zeros((3, len(at)))
    if slopes is not None:
        moved = OPPONENT @ np.einsum("sr,src->cr", steps, slopes[:, y, x])
    shifted = np.zeros(psi.shots * readings)
    covariance = np.zeros((len(shifted), len(shifted)))
    for size, near, axis, part in zip(variances, seen, opponent, moved, strict=True):
        shifted += axis @ part
        covariance += size * (axis @ near.T)
    covariance += doubt * np.outer(shifted, shifted)
    errors = np.zeros(len(choices))
    for number, shots in enumerate(choices):
        rows = np.concatenate([shot * readings + np.arange(readings) for shot in shots])
        factor = cho_factor(covariance[np.ix_(rows, rows)] + variance * np.eye(len(rows)))
        for size, near, part in zip(variances, seen, moved[:, inner], strict=True):
            cross = size * near[np.ix_(rows, inner)] + doubt * np.outer(shifted[rows], part)
            explained = np.sum(cross * cho_solve(factor, cross), axis=0)
            errors[number] += np.mean(size + doubt * part**2 - explained)
    return errors / 3


def expected_errors(
    psi: ImagingMatrix,
    choices: Sequence[Sequence[int]],
    disparity: Array,
    doubt: Array,
    kinds: Array,
    picture: Array,
    variance: float,
    patches: int = PATCHES,
) -> NDArray[np.float64]:
    """Return the mean squared error to be expected with each choice of shots, (choice,).

    psi: of all shots there may be. choices: indices of shots, each. disparity, doubt: (y, x), in
    pixels, its own and its standard deviation. kinds: (y, x) indices of the textures in
    TexturePrior.kinds. picture: the centre view (y, x, c). variance: of a reading. Raises
    ReconstructionError for light fields smaller than a patch.
    """
    prior = TexturePrior()
    rows, columns = disparity.shape
    k = psi.binning
    if min(rows, columns) < SIDE or SIDE % k:
        raise ReconstructionError(
            f"a light field of {rows}x{columns} in pixels of {k} samples "
            f"holds no patch of {SIDE}x{SIDE}"
        )
    across = max(1, round((patches * columns / rows) ** 0.5))
    down = max(1, patches // across)
    corners = [
        (int(y) // k * k, int(x) // k * k)
        for y in np.linspace(0, rows - SIDE, down)
        for x in np.linspace(0, columns - SIDE, across)
    ]
    exact = np.asarray(picture, dtype=np.float64)
    slopes = np.stack([np.gradient(exact, axis=axis) for axis in (0, 1)])
    errors = np.zeros(len(choices))
    for y, x in corners:
        middle = y + SIDE // 2, x + SIDE // 2
        patch = np.s_[y : y + SIDE, x : x + SIDE]
        amplitude, chroma = prior.kinds[int(kinds[middle])]
        errors += patch_errors(
            psi.window(*patch),
            choices,
            float(disparity[middle]),
            amplitude * float(np.mean(picture[middle])) ** 2,
            chroma,
            variance,
            prior,
            min(float(doubt[middle]), MOST_DOUBT_PX) ** 2,
            slopes[:, *patch],
        )
    return errors / len(corners)

"""The disparity of every patch given its own evidence and its neighbours': belief propagation.

A grid of patches, one of L disparities each. Neighbours differ as d - d' is Laplace distributed,
or, with a small probability, not related (another object). Messages are passed along rows and
columns, forth and back, some rounds (sum-product): 8 p L^2 operations a round for p patches.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
RARE_PX = 2.0
"""Disparity that half as many objects have as have none. Without it undecided patches of a smooth
scene agreed on -6.5 px; with it group A loses 0.00 to 0.03 dB on average. 2x -0.01, 0.5x 0.00 dB.
"""


def compatibility(
    disparities: NDArray[np.floating],
    slope_px: float,
    jump: float,
    spacing_px: float | NDArray[np.floating] = 1.0,
) -> Array:
    """Return the joint prior of two neighbours' disparities, (L, L), symmetric, not normalised.

    slope_px: mean difference of neighbours on one object. jump: probability of another object,
    whose disparity is the rarer the larger. spacing_px: between disparities, if it varies.
    """
    apart = np.abs(disparities[:, None] - disparities[None])
    same = np.exp(-apart / slope_px)
    same /= same.sum(axis=1).max()
    common = spacing_px / (1 + np.abs(disparities) / RARE_PX)
    common = common / common.sum()
    return (1 - jump) * same + jump * len(disparities) * np.outer(common, common)


def _normalised(beliefs: Array) -> Array:
    return beliefs / np.maximum(beliefs.sum(axis=-1, keepdims=True), 1e-30)


def posteriors(evidence: Array, pairs: Array, rounds: int = 3, floor: float = 1e-4) -> Array:
    """Return the probability of each label at each patch, (row, column, L), float32.

    evidence: (row, column, L) log-likelihoods. pairs: (L, L), see `compatibility`. floor: the
    probability that a patch's evidence is worth nothing (its texture is none on a plane).
    """
    own = np.exp((evidence - evidence.max(axis=-1, keepdims=True)).astype(np.float32))
    own = np.float32(1 - floor) * _normalised(own) + np.float32(floor / own.shape[-1])
    pairs = pairs.astype(np.float32)
    rows, columns, labels = own.shape
    messages = np.ones((4, rows, columns, labels), dtype=np.float32)
    for _ in range(rounds):
        for into, axis, reverse in ((0, 1, False), (1, 1, True), (2, 0, False), (3, 0, True)):
            length = own.shape[axis]
            order = range(length - 1, 0, -1) if reverse else range(length - 1)
            ahead = -1 if reverse else 1
            back = into ^ 1
            for at in order:
                here = (at, slice(None)) if axis == 0 else (slice(None), at)
                there = (at + ahead, slice(None)) if axis == 0 else (slice(None), at + ahead)
                belief = own[here].copy()
                for other in range(4):
                    if other != back:
                        belief *= messages[other][here]
                # Of mean 1: the product of four must not be too small for float32.
                messages[into][there] = labels * _normalised(_normalised(belief) @ pairs)
    return _normalised(own * messages.prod(axis=0))

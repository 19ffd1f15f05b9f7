"""The order in which the views of a Psi lie, told from frames: by the evidence of patches.

A Psi measured with the aperture's axes exchanged, or a light field whose files are named so, has
views that no surface fits (`emmc_rig.model.view_order`). The evidence of a few patches, over all
disparities alike, is compared among the orders. Patches differ in how much they tell, so the sum of
their log ratios is compared with the root of the sum of their squares.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.view_order import ViewOrder, others
from reconstruction.adaptive import search
from reconstruction.adaptive.evidence import EvidencePatches, TexturePrior

COUNTS = 24, 96, 384, 768
"""Patches looked at: few, and more where they hint at another order."""
HINT, PROOF = 1.0, 6.0
"""Ratio of sum to root of squares from which more patches are asked, and another order is taken."""
LEAST = 50.0
"""Log-likelihood that another order must gain."""
COMPARED_PX = (-8.0, -6.0, -4.0, -3.0, -2.0, -1.5, -1.0, -0.75, -0.5, -0.25, 0.0,
               0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)  # fmt: skip


def in_order(psi: ImagingMatrix, order: ViewOrder) -> ImagingMatrix:
    """Return a Psi with its views as they lie."""
    if order == ViewOrder.AS_NAMED:
        return psi
    # Weights are (shot, v, u, ...).
    return replace(psi, weights=order.arranged(psi.weights, axis=1))


def order_by_evidence(data: search.Data, prior: TexturePrior) -> ViewOrder:
    """Return how the views of `data.psi` lie; as named unless the evidence is plain.

    Of the prior's lengths the first alone is asked.
    """
    prior = replace(prior, finer_px=())
    side = search.reading_side(data.psi.shots)
    pixels = data.psi.frames_shape[1:]
    if min(pixels) < side:
        return ViewOrder.AS_NAMED
    patches = EvidencePatches(side, side)
    corners = _spread(patches, pixels)
    gains = {order: np.empty(0) for order in others(data.psi.light_field_shape[:2])}
    for first, last in pairwise((0, *COUNTS)):
        more = corners[first:last]
        if not gains or not len(more):
            break
        own = _evidence(data, patches, more, prior, ViewOrder.AS_NAMED)
        for order in gains:
            gain = _evidence(data, patches, more, prior, order) - own
            gains[order] = np.append(gains[order], gain)
        best = max(gains, key=lambda order: gains[order].sum())
        if _ratio(gains[best]) > PROOF and gains[best].sum() > LEAST:
            return best
        gains = {order: gain for order, gain in gains.items() if _ratio(gain) > HINT}
    return ViewOrder.AS_NAMED


def _ratio(gain: NDArray[np.float64]) -> float:
    return float(gain.sum() / np.sqrt(max(np.square(gain).sum(), 1e-20)))


def _spread(patches: EvidencePatches, pixels: tuple[int, int]) -> NDArray[np.int64]:
    """Return as many corners (patch, 2) as are looked at, any first few spread over all."""
    rows, columns = patches.grid(pixels)
    every = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    # Steps of the golden ratio fill a line evenly however many of them are taken.
    turn = np.arange(len(every)) * (5**0.5 - 1) / 2 % 1
    return every[np.argsort(turn, kind="stable")][: COUNTS[-1]]


def _evidence(
    data: search.Data,
    patches: EvidencePatches,
    corners: NDArray[np.int64],
    prior: TexturePrior,
    order: ViewOrder,
) -> NDArray[np.float64]:
    """Return each patch's log-likelihood, (patch,), over COMPARED_PX alike."""
    arranged = replace(data, psi=in_order(data.psi, order))
    each = search.evidence_at(arranged, patches, corners, np.array(COMPARED_PX), prior)
    return np.logaddexp.reduce(each.log_likelihood.astype(np.float64), axis=-1)

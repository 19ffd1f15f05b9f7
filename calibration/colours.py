"""Crosstalk of a colour filter: what its pixels see of the other colours, and Psi in three of them.

Under a lamp of one colour after another, the whiteboard without masks tells the share K[f, c] that
pixels behind filter f see of colour c. A mask of transmittances T_c then looks to them like
sum_c K[f, c] T_c, which is what a fit under white light needs; and a coefficient of Psi has the
share K[f, c] T_c of that in colour c.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibration.boards import BoardSet
from calibration.defects import mask_with_losses
from calibration.errors import CalibrationError
from calibration.parametric import Stages, psi_at
from calibration.shadow import Shadow, ShadowMask
from calibration.whiteboard import LAMP_COLOURS, Calibration
from emmc_rig.model.sensing import ImagingMatrix

if TYPE_CHECKING:
    from calibration.routes import Parametric

Array = NDArray[np.floating]
LEAST_CROSSTALK = 2e-3
LEAST_SHARE = 5e-4
LEAST_SUM = 1e-6
MEDIAN_DEVIATION = 1.2533
"""Of a median of normal values, over that of their mean."""


@dataclass(frozen=True, eq=False)
class Crosstalk:
    """What every filter sees of the lamps' colours, (filter, colour): rows of sum 1, and their
    deviations.
    """

    seen: NDArray[np.float64]
    deviation: NDArray[np.float64]

    @property
    def largest(self) -> float:
        """The largest share of a filter's light that is of other colours."""
        return float(1 - np.diag(self.seen).min())


def crosstalk(
    boards: BoardSet, channels: NDArray[np.uint8], good: NDArray[np.bool_]
) -> Crosstalk | None:
    """Return what every filter sees of the lamps' colours.

    None without whiteboards under coloured lamps, and where it is too little to matter.
    """
    references = [boards.references.get((0, lamp)) for lamp in LAMP_COLOURS]
    if any(one is None for one in references) or channels.max() >= len(LAMP_COLOURS):
        return None
    seen, deviation = (np.empty((len(LAMP_COLOURS), len(LAMP_COLOURS))) for _ in range(2))
    for colour, one in enumerate(references):
        assert one is not None
        rate = (one.mean_dn - boards.dark_at(one.exposure_s).mean_dn) / one.exposure_s
        for f in range(len(LAMP_COLOURS)):
            pixels = rate[good & (channels == f)]
            if pixels.size == 0:
                return None
            level = float(np.median(pixels))
            seen[f, colour] = max(level, 0.0)
            spread = 1.4826 * float(np.median(np.abs(pixels - level)))
            deviation[f, colour] = MEDIAN_DEVIATION * spread / np.sqrt(pixels.size)
    total = seen.sum(axis=1, keepdims=True)
    seen, deviation = seen / total, deviation / total
    seen[seen < LEAST_SHARE] = 0
    found = Crosstalk(seen / seen.sum(axis=1, keepdims=True), np.where(seen > 0, deviation, 0))
    return found if found.largest > LEAST_CROSSTALK else None


def mixing(mask: ShadowMask, filters: Crosstalk) -> ShadowMask:
    """Return the mask as pixels see it whose filters let other colours through."""
    cells = mask.cells.copy()
    cells[..., :3] = mask.cells[..., :3] @ filters.seen.T.astype(np.float32)
    return replace(mask, cells=cells)


def colour_shares(
    known: Parametric,
    plain: ShadowMask,
    crosstalk: Crosstalk,
    design: ImagingMatrix,
    stages: Stages,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the share of every coefficient in each colour, (shot, v, u, y, colour, x), and the
    deviation of a coefficient that the model's misfit makes of it.

    plain: the mask as designed. Raises CalibrationError where a pixel sums several samples.
    """
    if design.binning != 1 or design.colour is None:
        raise CalibrationError("crosstalk is told on sensors whose pixels are samples")
    at = known.fit.placement
    lost = None if known.defects is None else known.defects.lost
    mask = plain if lost is None else mask_with_losses(plain, at, lost)
    layout = design.layout
    shots, v, u, y, _, x = layout.shape
    three = replace(layout, shape=(shots, v, u, y, 3, x), colour=None)
    through = 3 * psi_at(Shadow(mask, at), three, stages).weights
    filters, unsure = (
        np.moveaxis(matrix[design.colour], -1, 2)[:, None, None].astype(np.float32)
        for matrix in (crosstalk.seen, crosstalk.deviation)
    )
    each = np.maximum(filters * through, 0)
    total = each.sum(axis=4, keepdims=True)
    shares = np.where(total > LEAST_SUM, each / np.maximum(total, LEAST_SUM), filters)
    own = np.arange(3)[:, None] == design.colour[:, None, None, :, None, :]
    misfit = np.zeros((v, u)) if known.misfit is None else known.misfit
    others = np.where(own, 0, filters) * misfit[None, :, :, None, None, None].astype(np.float32)
    more = np.where(own, np.sqrt(np.square(others).sum(axis=4, keepdims=True)), others)
    more = np.sqrt(np.square(more) + np.square(unsure * through))
    return shares.astype(np.float32), more.astype(np.float32)


def in_three_colours(known: Calibration, shares: Array, spread: Array) -> Calibration:
    """Return a calibration of one colour a pixel in three: see `colour_shares`."""
    weights = (known.psi.weights * shares).astype(np.float32)
    deviation = np.sqrt(np.square(known.deviation * shares) + np.square(spread))
    psi = replace(known.psi, weights=weights, colour=None)
    return replace(known, psi=psi, deviation=deviation.astype(np.float32))

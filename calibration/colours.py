"""Crosstalk of the colour filters: the other colours that pixels see, and Psi in three colours.

Under a lamp of one colour after another, the whiteboard without masks gives the share K[f, c] that
pixels behind filter f see of colour c. A mask of transmittances T_c then looks to them like
sum_c K[f, c] T_c, which is what a fit under white light needs; and a coefficient of Psi has the
part K[f, c] T_c in colour c. The parts in other colours than the pixel's own are the model's; its
own part is the coefficient measured less the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import BoardSet
from emmc_rig.calibration.defects import mask_with_losses
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.glare import Glare
from emmc_rig.calibration.parametric import Parametric, Stages, psi_at
from emmc_rig.calibration.robust import deviation_of
from emmc_rig.calibration.shadow import Shadow, ShadowMask
from emmc_rig.calibration.whiteboard import LAMP_COLOURS, Calibration
from emmc_rig.model.sensing import PsiLayout

Array = NDArray[np.floating]
LEAST_CROSSTALK = 2e-3
"""Of a filter's light, from which on Psi has three colours: 1 % makes Psi 1.4 % wrong."""
LEAST_SHARE = 5e-4
"""Of a filter's light in another colour: less counts as none."""
LEAST_OWN = 0.5
"""Of a filter's light that is of its own colour."""
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
    boards: BoardSet, channels: NDArray[np.uint8], good: NDArray[np.bool_], glare: float = 0.0
) -> Crosstalk | None:
    """Return what every filter sees of the lamps' colours.

    glare: share of all electrons that is spread over the picture behind the filters, which is no
    crosstalk. None without whiteboards under coloured lamps, and where it is too little to matter.
    Raises CalibrationError where pixels see another colour than their own.
    """
    found = lamp_shares(boards, channels, good, glare)
    if found is None:
        return None
    seen, deviation = np.maximum(found.seen, 0), found.deviation
    if seen.diagonal().min() < LEAST_OWN:
        f = int(np.argmin(seen.diagonal()))
        raise CalibrationError(
            f"pixels behind the {LAMP_COLOURS[f]} filter see {seen[f, f]:.0%} {LAMP_COLOURS[f]}: "
            "these whiteboards are of another camera, whose colour filters lie otherwise, or the "
            "lamp did not change its colour"
        )
    seen[seen < LEAST_SHARE] = 0
    found = Crosstalk(seen / seen.sum(axis=1, keepdims=True), np.where(seen > 0, deviation, 0))
    return found if found.largest > LEAST_CROSSTALK else None


def lamp_shares(
    boards: BoardSet, channels: NDArray[np.uint8], good: NDArray[np.bool_], glare: float = 0.0
) -> Crosstalk | None:
    """Return `crosstalk` however little it is; None without whiteboards under coloured lamps."""
    references = [boards.references.get((0, lamp)) for lamp in LAMP_COLOURS]
    if any(reference is None for reference in references) or channels.max() >= len(LAMP_COLOURS):
        return None
    seen, deviation = (np.empty((len(LAMP_COLOURS), len(LAMP_COLOURS))) for _ in range(2))
    for colour, reference in enumerate(references):
        assert reference is not None
        rate = (
            reference.mean_dn - boards.dark_at(reference.exposure_s).mean_dn
        ) / reference.exposure_s
        rate = (rate - glare * rate[good].mean()) / (1 - glare)
        for f in range(len(LAMP_COLOURS)):
            pixels = rate[good & (channels == f)]
            if pixels.size == 0:
                return None
            level = float(np.median(pixels))
            seen[f, colour] = level
            spread = deviation_of(pixels - level)
            deviation[f, colour] = MEDIAN_DEVIATION * spread / np.sqrt(pixels.size)
    total = seen.sum(axis=1, keepdims=True)
    return Crosstalk(seen / total, deviation / total)


def mixing(mask: ShadowMask, seen: Array) -> ShadowMask:
    """Return the mask as pixels see it whose filters see (filter, colour) of the colours."""
    cells = mask.cells.copy()
    cells[..., :3] = mask.cells[..., :3] @ np.asarray(seen, np.float32).T
    return replace(mask, cells=cells)


@dataclass(frozen=True, eq=False)
class OtherColours:
    """What of every coefficient is in other colours than the pixel's own, and how sure.

    weights, deviation: (shot, v, u, y, colour, x), 0 in a pixel's own colour, which `own` marks.
    """

    weights: NDArray[np.float32]
    deviation: NDArray[np.float32]
    own: NDArray[np.bool_]


def other_colours(
    known: Parametric,
    plain: ShadowMask,
    crosstalk: Crosstalk,
    layout: PsiLayout,
    stages: Stages,
    glare: Glare | None = None,
) -> OtherColours:
    """Return what the model says of the colours that a pixel's filter lets through beside its own.

    plain: the mask as designed. glare: brings light of other colours to every pixel. Raises
    CalibrationError where a pixel sums several samples.
    """
    if layout.binning != 1 or layout.colour is None:
        raise CalibrationError(
            "crosstalk is measured only where a pixel is one sample (binning 1): leave "
            "the colours out"
        )
    at = known.fit.placement
    lost = None if known.defects is None else known.defects.lost
    mask = plain if lost is None else mask_with_losses(plain, at, lost)
    shots, v, u, y, _, x = layout.weights_shape
    three = PsiLayout((shots, v, u, y, 3, x), None, camera_json=layout.camera_json)
    through = 3 * psi_at(Shadow(mask, at), three, stages).weights
    own = np.arange(3)[:, None] == layout.colour[:, None, None, :, None, :]
    share, unsure = (
        np.moveaxis(matrix[layout.colour], -1, 2)[:, None, None]
        for matrix in (crosstalk.seen, crosstalk.deviation)
    )
    weights = (share * through).astype(np.float32)
    if glare is not None:
        weights = glare.put_in(weights)
    missed = np.zeros_like(through)
    if known.misfit is not None:
        for shot, row, column, colour in np.ndindex(shots, v, u, 3):
            plane = through[shot, row, column, :, colour]
            missed[shot, row, column, :, colour] = known.misfit[row, column].variance(plane)
    deviation = np.sqrt(share**2 * missed + (unsure * through) ** 2).astype(np.float32)
    weights, deviation = (np.where(own, np.float32(0), each) for each in (weights, deviation))
    return OtherColours(weights, deviation, own)


def in_three_colours(known: Calibration, others: OtherColours) -> Calibration:
    """Return a calibration of one colour a pixel in three."""
    mine = known.psi.weights - others.weights.sum(axis=4, keepdims=True)
    weights = np.where(others.own, np.maximum(mine, 0), others.weights).astype(np.float32)
    spread = np.square(others.deviation)
    own = np.square(known.deviation) + spread.sum(axis=4, keepdims=True)
    deviation = np.sqrt(np.where(others.own, own, spread))
    psi = replace(known.psi, weights=weights, colour=None)
    return replace(known, psi=psi, deviation=deviation.astype(np.float32))

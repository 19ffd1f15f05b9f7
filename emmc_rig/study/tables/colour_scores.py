"""Scores of an estimate: of all values, of brightness and of colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.lightfield import psnr_db, replicate_centre, ssim

Array = NDArray[np.floating]
OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])


@dataclass(frozen=True)
class Scores:
    """psnr_db, ssim: peak 1, all views, pixels and colours.

    luma_psnr_db, chroma_psnr_db: PSNR of the first and of the two other orthonormal opponent
    colours; their squared errors add up to the whole. chroma_share: regression of the estimate's
    chrominance on the true one; below 1 the colours are duller than they are.
    """

    psnr_db: float
    ssim: float
    luma_psnr_db: float
    chroma_psnr_db: float
    chroma_share: float
    replicate_psnr_db: float


def scored(estimate: Array, truth: Array) -> Scores:
    """Return the scores of an estimate (v, u, y, x, c) of a light field."""
    squares = np.zeros(3)
    along = energy = 0.0
    matrix = OPPONENT.T.astype(np.float32)
    for view in np.ndindex(truth.shape[:2]):
        true, found = truth[view] @ matrix, estimate[view] @ matrix
        squares += np.square(found - true, dtype=np.float64).sum(axis=(0, 1))
        along += float(np.vdot(found[..., 1:], true[..., 1:]))
        energy += float(np.vdot(true[..., 1:], true[..., 1:]))
    samples = truth.size / 3
    return Scores(
        psnr_db(estimate, truth),
        ssim(estimate, truth),
        _psnr(squares[0] / samples),
        _psnr(squares[1:].sum() / (2 * samples)),
        along / energy if energy > 0 else 1.0,
        psnr_db(replicate_centre(truth), truth),
    )


def _psnr(mean_square: float) -> float:
    return float(-10 * np.log10(mean_square)) if mean_square > 0 else float("inf")

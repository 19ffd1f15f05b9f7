"""Scores of an estimate: PSNR and SSIM of its views, parallax, disparity."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.lightfield import psnr_db, replicate_centre, shear, ssim

Array = NDArray[np.floating]
STEP_PX, MARGIN_PX = 0.1, 0.5
WINDOW_PX = 5
BAD_PX = 0.3


@dataclass(frozen=True)
class Scores:
    """psnr_db, ssim: peak 1, all views, pixels and colours. angular_db: see `angular_snr_db`.

    replicate_psnr_db: of the true centre view in place of every view. disparity_mae_px: mean error
    of `swept_disparity` on the estimate; floor_mae_px: the same on the truth itself, what the
    sweep cannot do. bad_share: of pixels more than BAD_PX off. own_disparity_mae_px: of the map
    that the method itself returned. None where the true disparity is not known.
    """

    psnr_db: float
    ssim: float
    angular_db: float
    replicate_psnr_db: float
    disparity_mae_px: float | None = None
    floor_mae_px: float | None = None
    bad_share: float | None = None
    own_disparity_mae_px: float | None = None


def scored(
    estimate: Array,
    truth: Array,
    disparity_px: Array | None = None,
    own_disparity_px: Array | None = None,
) -> Scores:
    """Return the scores of an estimate (v, u, y, x, c) of a light field.

    disparity_px: (y, x), the truth's, if known. own_disparity_px: (y, x), the method's, if it
    found one.
    """
    scores = Scores(
        psnr_db(estimate, truth),
        ssim(estimate, truth),
        angular_snr_db(estimate, truth),
        psnr_db(replicate_centre(truth), truth),
    )
    if disparity_px is None:
        return scores
    low, high = float(disparity_px.min()), float(disparity_px.max())
    edge = inner(truth.shape, max(abs(low), abs(high)))
    found, floor = (
        np.abs(swept_disparity(item, low, high) - disparity_px)[edge] for item in (estimate, truth)
    )
    own = None
    if own_disparity_px is not None and own_disparity_px.shape == disparity_px.shape:
        own = float(np.abs(own_disparity_px - disparity_px)[edge].mean())
    return replace(
        scores,
        disparity_mae_px=float(found.mean()),
        floor_mae_px=float(floor.mean()),
        bad_share=float((found > BAD_PX).mean()),
        own_disparity_mae_px=own,
    )


def angular_snr_db(estimate: Array, truth: Array) -> float:
    """Return how well the differences between neighbouring views are met.

    10 log10(|D L|^2 / |D L' - D L|^2), D the differences along u in horizontal epipolar images
    and along v in vertical ones: the angular part of the EPI gradients by which Jin et al. (AAAI
    2020, "Learning Light Field Angular Super-Resolution via a Geometry-Aware Network") judge
    consistency, relative to the truth's. 0 dB is what any picture copied to every view scores;
    below, the parallax is worse than none. NaN for a truth without parallax.
    """
    signal = error = 0.0
    for axis in (0, 1):
        true, found = np.diff(truth, axis=axis), np.diff(estimate, axis=axis)
        signal += float(np.square(true, dtype=np.float64).sum())
        error += float(np.square(found - true, dtype=np.float64).sum())
    if signal == 0:
        return math.nan
    return 10 * math.log10(signal / error) if error > 0 else math.inf


def swept_disparity(light_field: Array, low_px: float, high_px: float) -> NDArray[np.float32]:
    """Return the disparity (y, x) of the centre view at which the views agree best.

    A plane sweep, the same for every method: the views are sheared to disparities from
    low - 0.5 to high + 0.5 in steps of 0.1 px, their variance is averaged over 5x5 pixels and
    colours, and the least one wins (Collins 1996). It has no notion of occlusion or of regions
    without texture: its error on the true light field is the floor to compare with.
    """
    count = round((high_px - low_px + 2 * MARGIN_PX) / STEP_PX) + 1
    candidates = np.linspace(low_px - MARGIN_PX, high_px + MARGIN_PX, count, dtype=np.float32)
    best = np.full(light_field.shape[2:4], np.inf, dtype=np.float32)
    found = np.zeros(light_field.shape[2:4], dtype=np.float32)
    for candidate in candidates:
        spread = shear(light_field, float(candidate)).var(axis=(0, 1)).mean(axis=-1)
        cost = cv2.blur(spread, (WINDOW_PX, WINDOW_PX))
        closer = cost < best
        best[closer] = cost[closer]
        found[closer] = candidate
    return found


def inner(shape: tuple[int, ...], largest_px: float) -> tuple[slice, slice]:
    """Return the rows and columns that every view sees; the middle half where there are none.

    shape: (v, u, y, x, c). largest_px: the largest disparity there is, as a magnitude.
    """
    kept = []
    for views, length in zip(shape[:2], shape[2:4], strict=True):
        margin = min(math.ceil(largest_px * (views // 2)) + WINDOW_PX // 2, length // 4)
        kept.append(slice(margin, length - margin))
    return kept[0], kept[1]

"""Which Psi to trust: the surest one that predicts every kind of whiteboard to the noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.errors import CalibrationError
from calibration.shadow import Shadow
from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]
AT_THE_NOISE = 1.5
"""Mean squared residual over the variance: what is left is less than the noise."""
ROUTES = ("combined", "parametric", "mixed", "free")
"""The surest first, then from the simplest to the freest."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """How one description predicts a whiteboard that it has not seen.

    chi2: mean squared residual over its variance, all usable pixels. trimmed: without the worst
    1 % of them. whiteness: correlation of neighbours' residuals. residual: (pixel_y, pixel_x), in
    deviations, 0 where not usable. brightness: of the whiteboard, over what is predicted. groups:
    chi2 by kind of whiteboard; all else is of the worst.
    """

    route: str
    chi2: float
    trimmed: float
    whiteness: float
    relative_error: float
    residual: NDArray[np.float32]
    brightness: float = 1.0
    groups: Mapping[str, float] = field(default_factory=dict)


def worst(judged: Mapping[str, HeldOut]) -> HeldOut:
    """Return the judgement of the kind of whiteboards that a description predicts worst."""
    groups = {name: one.chi2 for name, one in judged.items()}
    return replace(judged[max(groups, key=lambda name: groups[name])], groups=groups)


def predicted_by_shadow(shadow: Shadow, board: Board) -> Array:
    """Return what a placement predicts of a whiteboard, (pixel_y, pixel_x)."""
    pixels = np.argwhere(np.ones(board.reading.shape, dtype=bool))
    read = shadow.readings(
        pixels, board.channels.ravel(), board.views_open, board.stage_um, board.shot
    )
    return read.reshape(board.reading.shape)


def predicted_by_psi(psi: ImagingMatrix, board: Board) -> Array:
    """Return what a measured Psi predicts of a whiteboard at its shot's position, white lamp."""
    return _by_pixel(psi.weights, board, psi.binning, lambda plane: plane)


def prediction_variance(deviation: Array, board: Board, binning: int) -> Array:
    """Return the variance of `predicted_by_psi` from the deviation of its coefficients."""
    # The samples of a pixel were measured as one: their deviations add up.
    return _by_pixel(deviation, board, binning, np.square) * binning**2


def _by_pixel(
    coefficients: Array, board: Board, binning: int, change: Callable[[Array], Array]
) -> Array:
    """Return changed coefficients summed over samples, open views and colours, (pixel_y, pixel_x).

    One plane is held at a time.
    """
    rows, columns = board.reading.shape
    total = np.zeros((rows, columns))
    for v, u in np.argwhere(board.views_open):
        for plane in np.moveaxis(coefficients[board.shot, v, u], 1, 0):
            changed = change(plane.astype(np.float64))
            total += changed.reshape(rows, binning, columns, binning).sum(axis=(1, 3))
    return total


def judge(
    route: str, board: Board, predicted: Array, predicted_variance: Array | float = 0.0
) -> HeldOut:
    """Return how a prediction (pixel_y, pixel_x) fits a held-out whiteboard."""
    usable = board.usable
    if not usable.any():
        raise CalibrationError(f"{board.name}: no usable pixel to judge by")
    deviation = np.sqrt(board.variance.astype(np.float64) + predicted_variance)
    residual = np.where(usable, board.reading - predicted, 0)
    scaled = np.where(usable, residual / deviation, 0)
    squares = scaled[usable] ** 2
    limit = np.quantile(squares, 0.99)
    level = float(np.sqrt(np.mean(board.reading[usable].astype(np.float64) ** 2)))
    return HeldOut(
        route,
        float(squares.mean()),
        float(squares[squares <= limit].mean()),
        neighbour_correlation(scaled, usable),
        float(np.sqrt(np.mean(residual[usable] ** 2))) / level,
        scaled.astype(np.float32),
        float(np.sum(board.reading[usable]) / max(float(np.sum(predicted[usable])), 1e-9)),
    )


def neighbour_correlation(residual: Array, usable: NDArray[np.bool_]) -> float:
    """Return the correlation of residuals two pixels apart along rows and columns: 0 if white.

    Two, so that neighbours see the same colour of a Bayer mosaic.
    """
    limit = 5 * max(float(np.median(np.abs(residual[usable]))) * 1.4826, 1e-12)
    values = np.clip(residual, -limit, limit)
    product = squares = 0.0
    for axis in (0, 1):
        a, b = (np.moveaxis(values, axis, 0)[part] for part in (slice(None, -2), slice(2, None)))
        m, n = (np.moveaxis(usable, axis, 0)[part] for part in (slice(None, -2), slice(2, None)))
        both = m & n
        product += float((a[both] * b[both]).sum())
        squares += float((0.5 * (a[both] ** 2 + b[both] ** 2)).sum())
    return product / max(squares, 1e-12)


def choose(judged: Sequence[HeldOut], limit: float = AT_THE_NOISE) -> tuple[HeldOut, str]:
    """Return the description to use, and why in words.

    Raises CalibrationError with none to choose from.
    """
    if not judged:
        raise CalibrationError("no description of Psi to choose from")
    known = sorted(judged, key=lambda one: ROUTES.index(one.route))
    for one in known:
        if one.chi2 <= limit:
            return one, (
                f"{one.route}: every kind of whiteboard lies at the noise (the worst, "
                f"{_worst_name(one)}, has {one.chi2:.2f} of it, limit {limit:g})"
            )
    best = min(known, key=lambda one: one.chi2)
    return best, (
        f"{best.route}: none reaches the noise on every kind of whiteboard; this one comes nearest "
        f"({_worst_name(best)} has {best.chi2:.2f} of it, limit {limit:g}), and its deviations "
        "count what is missed"
    )


def _worst_name(one: HeldOut) -> str:
    return max(one.groups, key=lambda name: one.groups[name]) if one.groups else "held out"

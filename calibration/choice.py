"""Which Psi to trust: of those that predict every kind of whiteboard to the noise the surest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.frames import bands
from emmc_rig.calibration.shadow import Shadow
from emmc_rig.model.sensing import Psi

Array = NDArray[np.floating]
OPEN = "open aperture"
"""The kind of held-out whiteboards that judges every route."""
LARGEST_CHI2 = 1.5
"""Mean squared residual over the variance: what is left is less than the noise."""
LARGEST_STATED = 0.05
"""Of Psi, relative: less costs a reconstruction below 0.5 dB (`benchmarks/mismatch.py`)."""
ROUTES = ("parametric", "mixed", "combined", "free")
"""From the simplest to the freest."""
SURE, LEAST_EXCESS = 5.0, 0.05
"""Deviations, and share of the noise's variance, by which residuals exceed it by chance."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """How well a route's Psi predicts a held-out whiteboard.

    chi2: mean squared residual over its variance, all usable pixels. residual: (pixel_y, pixel_x),
    in deviations, 0 where not usable. brightness: of the whiteboard, over what is predicted.
    groups: chi2 by kind of whiteboard; all else is of the worst.
    """

    route: str
    chi2: float
    relative_error: float
    residual: NDArray[np.float32]
    brightness: float = 1.0
    groups: Mapping[str, float] = field(default_factory=dict)


def worst(judged: Mapping[str, HeldOut]) -> HeldOut:
    """Return the judgement of the kind of whiteboards that a description predicts worst."""
    groups = {name: held.chi2 for name, held in judged.items()}
    return replace(judged[max(groups, key=lambda name: groups[name])], groups=groups)


def predicted_by_shadow(shadow: Shadow, board: Board) -> Array:
    """Return what a placement predicts of a whiteboard, (pixel_y, pixel_x)."""
    pixels = np.argwhere(np.ones(board.reading.shape, dtype=bool))
    read = shadow.readings(pixels, board.channels.ravel(), *board.opening)
    return read.reshape(board.reading.shape)


def predicted_by_psi(psi: Psi, board: Board) -> Array:
    """Return what a measured Psi predicts of a whiteboard at its shot's position, white lamp."""
    return _sum_over_views(psi.weights, board, psi.binning, lambda plane: plane)


def prediction_variance(deviation: Array, board: Board, binning: int) -> Array:
    """Return the variance of `predicted_by_psi` from the deviation of its coefficients."""
    # The samples of a pixel were measured as one: their deviations add up.
    return _sum_over_views(deviation, board, binning, np.square) * binning**2


def _sum_over_views(
    coefficients: Array, board: Board, binning: int, change: Callable[[Array], Array]
) -> Array:
    """Return changed coefficients summed over samples, open views and colours, (pixel_y, pixel_x).

    One plane is held at a time.
    """
    total = np.zeros(board.reading.shape)
    for v, u in np.argwhere(board.views_open):
        total += _sum_by_pixel(change(coefficients[board.shot, v, u].astype(np.float64)), binning)
    return total


def _sum_by_pixel(view: Array, binning: int) -> Array:
    """Return what a view's coefficients (y, stored colour, x) sum to, (pixel_y, pixel_x)."""
    rows, colours, columns = view.shape
    shape = (rows // binning, binning, colours, columns // binning, binning)
    return view.reshape(shape).sum(axis=(1, 2, 4))


def white_by_view(psi: Psi, shot: int) -> Iterator[Array]:
    """Yield what pixels read of a white board before each view in turn, (pixel_y, pixel_x)."""
    for v, u in np.ndindex(psi.light_field_shape[:2]):
        yield _sum_by_pixel(psi.weights[shot, v, u].astype(np.float64), psi.binning)


def judge(
    route: str,
    board: Board,
    predicted: Array,
    predicted_variance: Array | float = 0.0,
    unsteady: float = 0.0,
) -> HeldOut:
    """Return how a prediction (pixel_y, pixel_x) fits a held-out whiteboard.

    unsteady: by which whiteboards differ in brightness among themselves, relative (standard
    deviation): the likeliest difference of this one is taken out.
    """
    usable = board.usable
    if not usable.any():
        raise CalibrationError(f"{board.name}: no usable pixel to judge by; expose it otherwise")
    spread = np.broadcast_to(predicted_variance, usable.shape)
    scaled = np.empty(usable.shape, dtype=np.float32)
    missed = power = light = expected = 0.0
    brighter = 1 + _likeliest_excess(board, predicted, spread, unsteady)
    for rows in bands(scaled):
        good = usable[rows]
        reading, prediction = (
            np.where(good, plane[rows], np.float64(0)) for plane in (board.reading, predicted)
        )
        residual = reading - brighter * prediction
        variance = board.variance[rows].astype(np.float64) + spread[rows]
        scaled[rows] = residual / np.sqrt(np.where(good, variance, 1.0))
        missed, power = missed + float((residual**2).sum()), power + float((reading**2).sum())
        light, expected = light + float(reading.sum()), expected + float(prediction.sum())
    return HeldOut(
        route,
        float(np.mean(scaled[usable] ** 2, dtype=np.float64)),
        float(np.sqrt(missed / power)),
        scaled,
        light / max(expected, 1e-9),
    )


def _likeliest_excess(board: Board, predicted: Array, spread: Array, unsteady: float) -> float:
    """Return by which share a whiteboard is likeliest brighter than predicted."""
    if unsteady == 0:
        return 0.0
    light = light2 = 0.0
    for rows in bands(board.reading):
        good = board.usable[rows]
        weight = 1 / (board.variance[rows].astype(np.float64) + spread[rows])[good]
        prediction = predicted[rows][good]
        light += float((weight * prediction * (board.reading[rows][good] - prediction)).sum())
        light2 += float((weight * prediction**2).sum())
    return light / (light2 + unsteady**-2)


def choose(judged: Sequence[HeldOut], stated: Mapping[str, float]) -> HeldOut:
    """Return the description to use.

    No method has fitted the open whiteboard. Among the methods whose residual there is noise, the
    method of the least stated error is chosen. stated: relative error that each states of its Psi,
    by route. Raises CalibrationError with none to choose from.
    """
    if not judged:
        raise CalibrationError("no calibration method gave a Psi: capture whiteboards")
    known = sorted(judged, key=lambda held: (stated[held.route], ROUTES.index(held.route)))
    good = [held for held in known if held.chi2 <= LARGEST_CHI2]
    if not good:
        return min(known, key=lambda held: held.chi2)
    # Of n normal residuals the mean square is 1 to a deviation of sqrt(2 / n).
    chance = SURE * np.sqrt(2 / max(int(np.count_nonzero(good[0].residual)), 1))
    sure = [held for held in good if held.groups.get(OPEN, held.chi2) < 1 + chance + LEAST_EXCESS]
    return (sure or good)[0]


def explain(chosen: HeldOut, error: float) -> str:
    """Return how good the chosen description is, in words; error: relative, stated of its Psi."""
    residual, stated = _state_residual(chosen), f"error stated {error:.2%}"
    if chosen.chi2 > LARGEST_CHI2:
        return f"calibration doubtful: {residual}, {stated}, which includes the residual"
    if error > LARGEST_STATED:
        return f"calibration imprecise: {residual}, {stated} (limit {LARGEST_STATED:.0%})"
    return f"calibration good: {residual}, {stated}"


def _state_residual(held: HeldOut) -> str:
    """Return the square residual over the noise's variance, of the worst whiteboard, in words."""
    kind = max(held.groups, key=lambda name: held.groups[name], default="")
    worst = f", worst: {kind}" if len(held.groups) > 1 else ""
    return (
        f"residual {held.chi2:.2f} x noise variance (limit {LARGEST_CHI2:g}{worst}), "
        f"calibration method {held.route}"
    )

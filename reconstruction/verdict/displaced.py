"""What may be wrong with masks and sensor: causes that compete on the same readings.

Every cause changes the masks' modulation m of readings in its own way, to first order. The residual
of the readings beyond Psi's own modulation is regressed on one cause at a time, beside a shift:

    offset: - m / level, so that dark places lose more than bright ones;
    gamma: (1 + m) log(1 + m), so that dark cells change otherwise than bright ones;
    contrast: - m, whatever the level;
    blur, distance, vignetting: as the masks' shadow changes by the camera's design.

A Psi without a design has the blur of its own shadow. Displacements are also measured by tiles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import Camera, camera_of, draw_plates, seen_of_white
from emmc_rig.model.errors import ModelError, SensingError
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.verdict.shadow import (
    LEAST_RELIEF,
    SMOOTH_PX,
    Relief,
    averaged,
    channels,
    predicted_relief,
    tile_edges,
)

Array = NDArray[np.floating]
STEP_PX = 0.25
"""Step of the finite differences."""
DISTANCE_STEP = 0.1
VIGNETTING_STEP = 0.3
BLURS_PX = 0.5, 0.7, 1.0, 1.4, 2.0
"""Deviations of the blurs that a Psi without a design is compared with."""
DIMMEST = 0.05
"""Level over the mean reading, and light through the masks over the level, that causes are divided
by at least."""
ALIKE = 0.5
"""Correlation below which the design says nothing about a Psi. 2x flags two broken results fewer of
13."""
FEWEST, MOST_CONDITION = 20, 1e8
"""Readings for each value that a regression determines, and the condition of its matrix."""
DECOYS_PX = (36, 12), (-24, 48), (36, -36), (-24, -24)
"""Displacements (y, x) that make derivatives meaningless: further than masks correlate, and by
whole tiles of colour filters of 2, 3, 4 and 6 pixels."""
DECOY = 0.2
"""Correlation with the derivatives themselves above which moved ones still mean something: those of
periodic masks."""


@dataclass(frozen=True)
class Change:
    """A possible deviation of masks or readings from Psi, as if no other were present.

    value, deviation: of the change. gain: by how much it lowers the weighted squared residual.
    """

    value: float
    deviation: float
    gain: float


@dataclass(frozen=True, eq=False)
class Displaced:
    """By how much the masks' shadow lies off Psi's, in pixels, and what else may be wrong.

    size_px: root mean square over tiles, beyond what the deviations make, and beyond what
    derivatives elsewhere make of the same readings (a placebo: what a wrong picture adds to both).
    None if no design determines shifts.
    changes: of `distance`, relative; `blur`, variance in px^2; `vignetting`, what the outermost
    rays lose; `offset`, added to the readings, over their mean; `gamma`, power of the light less 1;
    `contrast`, what the masks' modulation loses everywhere, relative.
    """

    size_px: float | None
    changes: dict[str, Change]


@dataclass(frozen=True, eq=False)
class _Design:
    """shifts: derivatives of the masks' shadow (y, x). changes: by name, for a change of 1."""

    shifts: tuple[Array, Array]
    changes: dict[str, Array]


def moved_masks(camera: Camera, dy_um: float, dx_um: float, distance: float) -> Camera:
    """Return the camera with the masks near its sensor moved, and further by a factor."""
    near = near_masks(camera)
    shots = []
    for shot in camera.shots:
        offsets = dict(shot.offset_um)
        for name in near:
            x, y = offsets.get(name, (0.0, 0.0))
            offsets[name] = (x + dx_um, y + dy_um)
        shots.append(shot.model_copy(update={"offset_um": offsets}))
    masks = {
        name: mask.model_copy(update={"distance_mm": mask.distance_mm * distance})
        if name in near
        else mask
        for name, mask in camera.masks.items()
    }
    return camera.model_copy(update={"shots": tuple(shots), "masks": masks})


def known_camera(psi: Psi) -> Camera | None:
    """Return the camera of a Psi, None where it is not known or has no mask near the sensor."""
    try:
        camera = camera_of(psi)
    except SensingError:
        return None
    fits = len(camera.shots) == psi.shots and camera.views == psi.light_field_shape[:2]
    return camera if near_masks(camera) and fits else None


def near_masks(camera: Camera) -> list[str]:
    """Return the names of the masks nearer to the sensor than to the lens."""
    half_mm = 0.5 * camera.lens.distance_mm
    return [name for name, mask in camera.masks.items() if mask.distance_mm < half_mm]


def displaced(psi: Psi, relief: Relief) -> Displaced:
    """Return by how much the masks lie off, and every cause alone."""
    design = _design(psi, relief)
    shifts = () if design is None else design.shifts
    others = _blurs(psi, relief) if design is None else design.changes.items()
    changes: dict[str, Change] = {}
    # One cause at a time: together, correlated as they are, no cause could be estimated.
    for name, cause in (*_of_readings(psi, relief), *others):
        fit = _regressed([cause, *shifts], relief.seen - relief.masks, relief.weight)
        if fit is not None and not (name in changes and changes[name].gain > fit.gain):
            (value, *_), (deviation, *_) = fit.values[0], fit.deviations[0]
            changes[name] = Change(float(value), float(deviation), fit.gain)
    if design is None or (tiled := _tiled(relief, *design.shifts)) is None:
        return Displaced(None, changes)
    decoys = (_tiled(relief, *moved) for moved in _decoys(*design.shifts, relief.good))
    placebo = [decoy.excess for decoy in decoys if decoy is not None]
    excess = tiled.excess - (float(np.mean(placebo)) if placebo else 0.0)
    return Displaced(float(np.sqrt(max(excess, 0))), changes)


def _tiled(relief: Relief, shift_y: Array, shift_x: Array) -> _Regression | None:
    """Return the shifts that each tile's readings ask for, None where no tile determines any."""
    return _regressed([relief.masks, shift_y, shift_x], relief.seen, relief.weight, tiles=True)


def _design(psi: Psi, relief: Relief) -> _Design | None:
    """Return the changes of the masks' shadow by the camera's design; None for a Psi of another
    design."""
    camera = known_camera(psi)
    good = relief.good
    if camera is None or not good.any():
        return None
    pixel_um = camera.sensor.sample_pitch_um * psi.binning

    def drawn(dy_px: float, dx_px: float, distance: float = 1.0) -> Array:
        moved = moved_masks(camera, dy_px * pixel_um, dx_px * pixel_um, distance)
        plates = draw_plates(moved, psi.size) if distance != 1 else roomy
        return predicted_relief(psi, seen_of_white(moved, psi.size, plates), relief.picture)[1]

    try:
        # Masks with room for all moves are drawn once.
        step_um = STEP_PX * pixel_um
        roomy = draw_plates(moved_masks(camera, step_um, step_um, 1), psi.size)
        own = drawn(0, 0)
        up, down = drawn(STEP_PX, 0), drawn(-STEP_PX, 0)
        right, left = drawn(0, STEP_PX), drawn(0, -STEP_PX)
        further = drawn(0, 0, 1 + DISTANCE_STEP)
    except ModelError:
        return None
    designed, measured = own[good], relief.masks[good]
    norms = [float(np.sqrt(np.mean(np.square(shadow)))) for shadow in (designed, measured)]
    alike = float(np.mean(designed * measured)) >= ALIKE * norms[0] * norms[1]
    if min(norms) < LEAST_RELIEF or not alike:
        return None
    darker = predicted_relief(psi, _vignetted(psi, VIGNETTING_STEP), relief.picture)[1]
    return _Design(
        ((up - down) / (2 * STEP_PX), (right - left) / (2 * STEP_PX)),
        {
            "distance": (further - own) / DISTANCE_STEP,
            # A blur of variance s adds s/2 times the second derivatives.
            "blur": (up + down + right + left - 4 * own) / (2 * STEP_PX**2),
            "vignetting": (darker - relief.masks) / VIGNETTING_STEP,
        },
    )


def _of_readings(psi: Psi, relief: Relief) -> Iterator[tuple[str, Array]]:
    """Yield what a wrong black level or a tone curve makes of the masks' modulation, by name."""
    if float(np.mean(np.square(relief.masks))) < LEAST_RELIEF**2:
        return
    passed = 1 + relief.masks
    mean = float(np.mean((relief.level * passed)[relief.good]))
    yield "offset", -relief.masks * mean / np.maximum(relief.level, DIMMEST * mean)
    power = passed * np.log(np.maximum(passed, DIMMEST))
    around = averaged(power, relief.good, channels(psi), SMOOTH_PX)
    yield "gamma", power - passed * around
    yield "contrast", -relief.masks


def _blurs(psi: Psi, relief: Relief) -> Iterator[tuple[str, Array]]:
    """Yield what each of BLURS_PX changes of Psi's own shadow, over its variance."""
    if float(np.mean(np.square(relief.masks))) < LEAST_RELIEF**2:
        return
    for blur_px in BLURS_PX:
        blurred = averaged(relief.masks, relief.good, channels(psi), blur_px)
        yield "blur", (blurred - relief.masks) / blur_px**2


@dataclass(frozen=True, eq=False)
class _Regression:
    """Of the tiles that determine it: values and deviations of the base, (tile, term).

    gain: fall of the mean weighted square.
    """

    values: NDArray[np.float64]
    deviations: NDArray[np.float64]
    gain: float

    @property
    def excess(self) -> float:
        """Mean square of the shifts, y and x added, less what the deviations make."""
        shifts, errors = self.values[:, -2:], self.deviations[:, -2:]
        squares = np.square(shifts) - np.square(errors)
        return float(np.average(squares, axis=0, weights=1 / np.square(errors)).sum())


def _regressed(
    base: Sequence[Array], seen: Array, weight: Array, tiles: bool = False
) -> _Regression | None:
    """Return the weighted regression of the observed on the base, tile by tile.

    With the columns of B the terms, W the weights and y the observed values of a tile:
        values     = (B^T W B)^-1 B^T W y,  e = y - B values
        deviations = sqrt(diag((B^T W B)^-1 (sum of (W B e)^T (W B e)) (B^T W B)^-1))
    the second for errors of unequal size. tiles: of about TILE_PX; else the whole picture is a
    tile. None where no tile determines it.
    """
    shape = weight.shape[1:]
    rows, columns = (tile_edges(n) if tiles else np.array([0, n]) for n in shape)
    weight = weight.astype(np.float64)
    base = [term.astype(np.float64) for term in base]

    def summed(values: NDArray) -> NDArray:
        by_rows = np.add.reduceat(values.sum(axis=0), rows[:-1], axis=0)
        return np.add.reduceat(by_rows, columns[:-1], axis=1).ravel()

    def products(terms: Sequence[Array], others: Sequence[Array]) -> Array:
        sums = [[summed(term * other) for other in others] for term in terms]
        return np.moveaxis(np.array(sums), 2, 0)

    weighted = [weight * term for term in base]
    matrix = products(weighted, base)
    known = np.flatnonzero(summed(weight > 0) >= FEWEST * len(base))
    known = known[np.linalg.cond(matrix[known]) <= MOST_CONDITION]
    if not known.size:
        return None
    inverse = np.zeros_like(matrix)
    inverse[known] = np.linalg.inv(matrix[known])
    values = (inverse @ products(weighted, [seen]))[..., 0]
    left = seen.astype(np.float64)
    for term, of_tiles in zip(base, values.T, strict=True):
        by_tile = of_tiles.reshape(len(rows) - 1, len(columns) - 1)
        left -= term * by_tile.repeat(np.diff(rows), 0).repeat(np.diff(columns), 1)
    scores = [term * left for term in weighted]
    spread = inverse @ products(scores, scores) @ inverse
    errors = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    gain = float((weight * (np.square(seen, dtype=np.float64) - left**2))[weight > 0].mean())
    return _Regression(values[known], errors[known], gain)


def _decoys(
    shift_y: Array, shift_x: Array, good: NDArray[np.bool_]
) -> Iterator[tuple[Array, Array]]:
    """Yield the derivatives moved by each of DECOYS_PX, but for those that still correlate."""
    for by in DECOYS_PX:
        moved = np.roll(shift_y, by, axis=(1, 2)), np.roll(shift_x, by, axis=(1, 2))
        pairs = zip((shift_y, shift_x), moved, strict=True)
        if all(_correlation(own[good], other[good]) < DECOY for own, other in pairs):
            yield moved


def _correlation(own: Array, other: Array) -> float:
    """Return |correlation| of two arrays around 0."""
    squares = np.mean(np.square(own)) * np.mean(np.square(other))
    return abs(float(np.mean(own * other))) / max(float(np.sqrt(squares)), 1e-12)


def _vignetted(psi: Psi, lost: float) -> Array:
    """Return the sum of Psi's weights over the views, (shot, y, stored colour, x), the outermost
    views darker by a share, those between by its square law."""
    v, u = (np.arange(n) - (n - 1) / 2 for n in psi.views)
    square = np.square(v)[:, None] + np.square(u)
    passed = 1 - lost * square / max(float(square.max()), 1e-12)
    total = np.zeros((psi.shots, *psi.weights_shape[3:]))
    for v, u in np.ndindex(psi.views):
        total += passed[v, u] * psi.weights[:, v, u]
    return total

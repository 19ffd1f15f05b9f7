"""Displacements of the masks' shadow, estimated from the readings and the camera's design.

The design predicts how the masks' modulation changes when they move or their distance differs. The
residual of the readings beyond Psi's own modulation is regressed on these changes, tile by tile.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.camera import Camera, build_imaging_matrix, camera_of
from emmc_rig.model.errors import ModelError, SensingError
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.verdict.shadow import LEAST_RELIEF, Relief, relief_of, tiles

Array = NDArray[np.floating]
STEP_PX = 0.25
"""Step of the finite differences."""
DISTANCE_STEP = 0.1
VIGNETTING_STEP = 0.3
ALIKE = 0.5
"""Correlation below which the design says nothing about a Psi. 2x flags two broken results fewer of
13."""
DECOYS_PX = (36, 12), (-24, 48), (36, -36), (-24, -24)
"""By how much derivatives are moved (y, x) so that they mean nothing: further than masks correlate,
and by whole tiles of colour filters of 2, 3, 4 and 6 pixels."""
DECOY = 0.2
"""Correlation with the derivatives themselves above which moved ones still mean something: those of
periodic masks."""


@dataclass(frozen=True)
class Change:
    """One way in which the masks may be otherwise than Psi says, if it is the only one.

    value, deviation: of the change. gain: by how much it lowers the weighted squared residual.
    """

    value: float
    deviation: float
    gain: float


@dataclass(frozen=True, eq=False)
class Displaced:
    """By how much the masks' shadow lies off Psi's, in pixels.

    shift: (y, x), the weighted mean over tiles. size_px: their root mean square beyond what the
    deviations make, and beyond what derivatives elsewhere make of the same readings (a placebo:
    what a wrong picture adds to both). changes: of `distance`, relative; `blur`, variance in px^2;
    `vignetting`, what the outermost rays lose.
    """

    shift: tuple[float, float]
    size_px: float
    changes: dict[str, Change]


def _moved(camera: Camera, dy_um: float, dx_um: float, distance: float) -> Camera:
    """Return the camera with the masks near its sensor moved, and further by a factor."""
    near = [n for n, m in camera.masks.items() if m.distance_mm < 0.5 * camera.lens.distance_mm]
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


def _design(psi: ImagingMatrix) -> Camera | None:
    """Return the camera of a Psi, None where it is not known or has no mask near the sensor."""
    try:
        camera = camera_of(psi)
    except SensingError:
        return None
    near = [m for m in camera.masks.values() if m.distance_mm < 0.5 * camera.lens.distance_mm]
    fits = len(camera.shots) == psi.shots and camera.views == psi.light_field_shape[:2]
    return camera if near and fits else None


def displaced(psi: ImagingMatrix, found: Relief) -> Displaced | None:
    """Return by how much the masks lie off; None where the design does not determine it."""
    camera = _design(psi)
    if camera is None:
        return None
    pixel_um = camera.sensor.sample_pitch_um * psi.binning

    def drawn(dy_px: float, dx_px: float, distance: float = 1.0) -> Array:
        moved = _moved(camera, dy_px * pixel_um, dx_px * pixel_um, distance)
        return relief_of(build_imaging_matrix(moved, psi.size), found.picture)[1]

    try:
        own = drawn(0, 0)
        up, down = drawn(STEP_PX, 0), drawn(-STEP_PX, 0)
        right, left = drawn(0, STEP_PX), drawn(0, -STEP_PX)
        further = drawn(0, 0, 1 + DISTANCE_STEP)
    except ModelError:
        return None
    good = found.good
    both = own[good], found.masks[good]
    norms = [float(np.sqrt(np.mean(np.square(one)))) for one in both] if good.any() else [0.0]
    if min(norms) < LEAST_RELIEF or float(np.mean(both[0] * both[1])) < ALIKE * norms[0] * norms[1]:
        return None
    shift_y, shift_x = (up - down) / (2 * STEP_PX), (right - left) / (2 * STEP_PX)
    darker = relief_of(_vignetted(psi, VIGNETTING_STEP), found.picture)[1]
    changes = {
        "distance": (further - own) / DISTANCE_STEP,
        # A blur of variance s adds s/2 times the second derivatives.
        "blur": (up + down + right + left - 4 * own) / (2 * STEP_PX**2),
        "vignetting": (darker - found.masks) / VIGNETTING_STEP,
    }
    tiled = _tiled(found, shift_y, shift_x)
    if tiled is None:
        return None
    placebo = [
        one.beyond
        for one in (_tiled(found, *moved) for moved in _decoys(shift_y, shift_x, good))
        if one is not None
    ]
    beyond = tiled.beyond - (float(np.mean(placebo)) if placebo else 0.0)
    # One at a time: they are so correlated that together none could be estimated.
    beyond_psi = found.seen - found.masks
    alone = {
        name: _regressed([one, shift_y, shift_x], beyond_psi, found.weight)
        for name, one in changes.items()
    }
    return Displaced(
        tiled.mean,
        float(np.sqrt(max(beyond, 0))),
        {
            name: Change(float(fit.values[0]), float(fit.deviations[0]), fit.gain)
            for name, fit in alone.items()
            if fit is not None
        },
    )


@dataclass(frozen=True, eq=False)
class _Tiled:
    """shifts, errors: (tile, 2), by which the shadow lies off (y, x), and deviations. beyond: mean
    square of the shifts, y and x added, less what the deviations make."""

    shifts: NDArray[np.float64]
    errors: NDArray[np.float64]

    @property
    def mean(self) -> tuple[float, float]:
        y, x = np.average(self.shifts, axis=0, weights=1 / np.square(self.errors))
        return float(y), float(x)

    @property
    def beyond(self) -> float:
        squares = np.square(self.shifts) - np.square(self.errors)
        return float(np.average(squares, axis=0, weights=1 / np.square(self.errors)).sum())


def _tiled(found: Relief, shift_y: Array, shift_x: Array) -> _Tiled | None:
    """Return the shifts that each tile's readings ask for, None where no tile determines any."""
    fits = [
        _regressed(
            [one[:, y, x] for one in (found.masks, shift_y, shift_x)],
            found.seen[:, y, x],
            found.weight[:, y, x],
        )
        for y, x in tiles(found.good.shape[1:])
    ]
    known = [fit for fit in fits if fit is not None]
    if not known:
        return None
    return _Tiled(
        np.array([fit.values[1:] for fit in known]), np.array([fit.deviations[1:] for fit in known])
    )


def _decoys(
    shift_y: Array, shift_x: Array, good: NDArray[np.bool_]
) -> Iterator[tuple[Array, Array]]:
    """Yield the derivatives moved by each of DECOYS_PX, but for those that still correlate."""
    for by in DECOYS_PX:
        moved = np.roll(shift_y, by, axis=(1, 2)), np.roll(shift_x, by, axis=(1, 2))
        pairs = zip((shift_y, shift_x), moved, strict=True)
        if all(_correlation(own[good], other[good]) < DECOY for own, other in pairs):
            yield moved


def _correlation(one: Array, other: Array) -> float:
    """Return that of two arrays around 0, its size alone."""
    products = np.mean(one * other), np.mean(np.square(one)) * np.mean(np.square(other))
    return abs(float(products[0])) / max(float(np.sqrt(products[1])), 1e-12)


def _vignetted(psi: ImagingMatrix, lost: float) -> ImagingMatrix:
    """Return Psi with the outermost views darker by a share, those between by its square law."""
    v, u = (np.arange(n) - (n - 1) / 2 for n in psi.light_field_shape[:2])
    square = np.square(v)[:, None] + np.square(u)
    passed = 1 - lost * square / max(float(square.max()), 1e-12)
    weights = psi.weights * passed[:, :, None, None, None].astype(psi.weights.dtype)
    return replace(psi, weights=weights)


@dataclass(frozen=True, eq=False)
class _Fit:
    """values, deviations: of the base's. gain: fall of the mean weighted square."""

    values: NDArray[np.float64]
    deviations: NDArray[np.float64]
    gain: float


def _regressed(base: Sequence[Array], seen: Array, weight: Array) -> _Fit | None:
    """Return the weighted regression of the observed on the base; None where it is undetermined."""
    good = weight > 0
    if good.sum() < 20 * len(base):
        return None
    columns = np.stack([one[good] for one in base], axis=1).astype(np.float64)
    weights, values = weight[good].astype(np.float64), seen[good].astype(np.float64)
    matrix = columns.T @ (columns * weights[:, None])
    if np.linalg.cond(matrix) > 1e8:
        return None
    inverse = np.linalg.inv(matrix)
    found = inverse @ (columns.T @ (weights * values))
    left = values - columns @ found
    scores = columns * (weights * left)[:, None]
    spread = np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse))
    gain = float(np.mean(weights * (values**2 - left**2)))
    return _Fit(found, spread, gain)

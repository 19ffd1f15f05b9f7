"""Whether shots belong together: their brightness, their masks, and whether the picture moved.

Readings over what the smooth picture makes Psi read are the scene's detail, whatever the masks:
from shot to shot they must agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.verdict.shadow import Relief, cross_strength, tiles

Array = NDArray[np.floating]
BLURS_PX = (0.8, 1.5, 4.0)
"""Blurs of the compared pictures: fine ones show small motions, coarse ones large."""
OUTLIERS_PX = 3
"""Side of the window whose median stands for a pixel when motion is measured."""
SAME_VIEWPOINT = 0.1
"""View steps between the mean viewpoints of two shots beyond which parallax passes for motion."""


@dataclass(frozen=True)
class ShotMotion:
    """The worst in any tile between a shot and the first, beyond two deviations.

    size_px: how far. effect: what it changes, over the mean reading. shot; tile: rows, columns.
    """

    size_px: float = 0.0
    effect: float = 0.0
    shot: int = 0
    tile: tuple[slice, slice] = slice(0, 0), slice(0, 0)

    @property
    def place(self) -> tuple[int, int]:
        """Return the middle of the tile, (y, x)."""
        y, x = ((part.start + part.stop) // 2 for part in self.tile)
        return y, x

    def unexplained(self, residual: Array, variance: float, usable: NDArray[np.bool_]) -> float:
        """Return what a light field leaves of the tile's readings in all shots, beyond noise.

        residual, usable: (shot, pixel_y, pixel_x). variance: of a reading. Root mean square, in
        units of the readings.
        """
        within = usable[:, *self.tile]
        square = np.square(residual[:, *self.tile][within], dtype=np.float64)
        return float(np.sqrt(max(square.mean() - variance, 0.0))) if square.size else 0.0


@dataclass(frozen=True, eq=False)
class ShotAgreement:
    """brightness: of every shot over their mean. masks: (read, said), how strongly each shot's
    readings show each shot's masks. motion: None where it cannot be measured.
    """

    brightness: NDArray[np.float64]
    masks: NDArray[np.float64]
    motion: ShotMotion | None


def compared(psi: ImagingMatrix, found: Relief) -> ShotAgreement:
    """Return how the shots agree."""
    kept = np.flatnonzero(found.good.any(axis=(1, 2)))
    common = found.good[kept].all(axis=0)
    ratio = np.ones(psi.shots)
    if common.any():
        for shot in kept:
            level = found.level[shot][common].astype(np.float64)
            read = level * (1 + found.read[shot][common])
            said = level * (1 + found.masks[shot][common])
            ratio[shot] = read.sum() / max(said.sum(), 1e-12)
    motion = None
    if len(kept) > 1 and common.any() and _viewpoints_apart(psi) < SAME_VIEWPOINT:
        detail = (1 + found.read) / np.maximum(1 + found.masks, 0.05)
        detail = np.where(found.good, detail, 1) / np.maximum(ratio, 1e-3)[:, None, None]
        motion = _motion(detail, found, kept)
    return ShotAgreement(
        ratio / ratio[kept].mean() if len(kept) else ratio, cross_strength(found), motion
    )


def _viewpoints_apart(psi: ImagingMatrix) -> float:
    """Return the largest distance between the shots' mean viewpoints, in steps between views."""
    share = psi.weights.sum(axis=(3, 4, 5), dtype=np.float64)
    v, u = (np.arange(n) - (n - 1) / 2 for n in share.shape[1:])
    total = np.maximum(share.sum(axis=(1, 2)), 1e-12)
    middle = np.stack(
        [(share.sum(axis=2) * v).sum(axis=1) / total, (share.sum(axis=1) * u).sum(axis=1) / total],
        axis=1,
    )
    return float(np.linalg.norm(middle[:, None] - middle[None], axis=-1).max())


def _motion(detail: Array, found: Relief, kept: NDArray[np.intp]) -> ShotMotion:
    """Return the worst motion of the detail (shot, y, x) against the first of the shots kept."""
    rows, columns = detail.shape[1:]
    grey = found.picture.mean(axis=-1)
    grey = cv2.resize(grey, (columns, rows), interpolation=cv2.INTER_AREA)
    mean = max(float(grey.mean()), 1e-12)
    worst = ShotMotion()
    # What is saturated in one shot only would leave a spot in the others.
    common = np.asarray(found.good[kept].all(axis=0))
    # A bad pixel stands in every shot, but behind dark cells of the mask it seems far brighter.
    calm = [
        np.asarray(cv2.medianBlur(one, OUTLIERS_PX), dtype=np.float32)
        for one in np.asarray(detail, dtype=np.float32)
    ]
    for blur in BLURS_PX:
        pictures = [_blurred(one, common, blur) * grey for one in calm]
        first = pictures[kept[0]]
        for shot in map(int, kept[1:]):
            slope_y, slope_x = np.gradient((first + pictures[shot]) / 2)
            change = first - pictures[shot]
            for y, x in tiles((rows, columns)):
                size, steepness = _moved(slope_y[y, x], slope_x[y, x], change[y, x], blur)
                if size * steepness / mean > worst.effect:
                    worst = ShotMotion(size, size * steepness / mean, shot, (y, x))
    return worst


def _blurred(values: Array, good: NDArray[np.bool_], blur: float) -> NDArray[np.float32]:
    use = good.astype(np.float32)
    top = cv2.GaussianBlur(use * values.astype(np.float32), (0, 0), blur)
    bottom = np.maximum(cv2.GaussianBlur(use, (0, 0), blur), 1e-6)
    return np.asarray(top / bottom, dtype=np.float32)


def _moved(slope_y: Array, slope_x: Array, change: Array, blur: float) -> tuple[float, float]:
    """Return how far a tile has moved, less two of its deviations, and its root mean square slope.

    By least squares (Lucas & Kanade 1981).
    """
    columns = np.stack([slope_y.ravel(), slope_x.ravel()], axis=1).astype(np.float64)
    matrix = columns.T @ columns
    if np.linalg.cond(matrix) > 1e6:
        return 0.0, 0.0
    inverse = np.linalg.inv(matrix)
    value = inverse @ (columns.T @ change.ravel())
    left = change.ravel() - columns @ value
    # Blurred pixels are alike over 4 pi blur^2 of them.
    alike = 4 * np.pi * blur**2
    deviation = np.sqrt(np.trace(inverse) * np.mean(left**2) * alike)
    steepness = float(np.sqrt(np.mean(np.sum(columns**2, axis=1))))
    return float(np.linalg.norm(value) - 2 * deviation), steepness

"""How strongly the masks' shadow shows in the readings, compared with what Psi predicts.

Psi predicts how the masks modulate the readings around the smooth picture that explains the frames'
local means. The scene's texture is uncorrelated with the masks. So the regression of the measured
modulation on the predicted one has slope 1 where Psi is the camera's, less where the masks are
elsewhere or blurred, and 0 where they are other masks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.frames import local_mean
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.problem import smooth_guess

Array = NDArray[np.floating]
SMOOTH_PX = 4.0
"""Deviation of the window over which readings and masks are averaged."""
LOCAL_PX = 2.0
"""Deviation of the window over which the scene's texture is estimated."""
DIMMEST = 0.05
"""Share of the typical expected reading below which a pixel is left out."""
DIMMEST_CALM = 0.2
"""Brightness of calm places over the smooth picture's, by which readings are divided at least."""
LEAST_RELIEF = 0.02
"""Modulation by the masks, over the readings, below which they are not tested (a coded aperture has
none)."""
TILE_PX = 24
"""Side of the tiles in which the shadow's strength is measured. 2x flags one broken result fewer of
13."""


@dataclass(frozen=True, eq=False)
class Relief:
    """Readings and masks around the smooth picture, (shot, pixel_y, pixel_x) each.

    level: what is expected of evenly grey masks. masks: what the masks add, as a share of it.
    read: what the readings add; seen: that, relative to the calm places around. good: where both
    are known. weight: the texture's inverse variance. picture: the smooth picture, (y, x, c).
    """

    level: NDArray[np.float32]
    masks: NDArray[np.float32]
    read: NDArray[np.float32]
    seen: NDArray[np.float32]
    good: NDArray[np.bool_]
    weight: NDArray[np.float32]
    picture: Array


def channels(psi: Psi) -> NDArray[np.int64]:
    """Return which filter of the sensor each pixel has, (shot, pixel_y, pixel_x)."""
    k = psi.binning
    if psi.colour is None:
        return np.zeros(psi.frames_shape, dtype=np.int64)
    return psi.colour[:, ::k, ::k].astype(np.int64)


def averaged(values: Array, good: NDArray, filters: NDArray[np.int64], deviation: float) -> Array:
    """Return the mean of the good pixels about each, among those with its filter; shots apart."""
    planes = zip(values, good, filters, strict=True)
    return np.stack([local_mean(*plane, deviation) for plane in planes])


def predicted_relief(
    psi: Psi, white: Array, picture: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return what a picture (y, x, c), seen in all views, makes a Psi read.

    First of evenly grey masks, then what the masks add as a share of it, both
    (shot, pixel_y, pixel_x). white: Psi's weights summed over the views, or those of one like it,
    (shot, y, stored colour, x).
    """
    k = psi.binning
    rows, columns = psi.frames_shape[1:]
    white = white.reshape(psi.shots, rows, k, -1, columns, k).sum(axis=(2, 5), dtype=np.float64)
    colours = picture.reshape(rows, k, columns, k, 3).mean(axis=(1, 3))
    filters = channels(psi)
    every = np.ones(psi.frames_shape, dtype=bool)
    expected, level = np.zeros(psi.frames_shape), np.zeros(psi.frames_shape)
    for stored in range(white.shape[2]):
        if psi.colour is None:
            light = np.broadcast_to(colours[..., stored], psi.frames_shape)
        else:
            light = np.take_along_axis(colours[None], filters[..., None], axis=3)[..., 0]
        expected += white[:, :, stored] * light
        level += averaged(white[:, :, stored], every, filters, SMOOTH_PX) * light
    masks = expected / np.maximum(level, 1e-12) - 1
    return level.astype(np.float32), np.where(level > 0, masks, 0).astype(np.float32)


def measured_relief(
    psi: Psi, frames: Array, noise_sigma: float, usable: NDArray[np.bool_]
) -> Relief:
    """Return readings and masks around the smooth picture."""
    picture = np.asarray(smooth_guess(psi, frames, usable), dtype=np.float32)
    white = psi.weights.sum(axis=(1, 2), dtype=np.float64)
    level, masks = predicted_relief(psi, white, picture)
    filters = channels(psi)
    floor = DIMMEST * float(np.median(level))
    good = usable & (level > max(floor, 3 * noise_sigma))
    safe = np.where(good, level, 1)
    masks = np.where(good, masks, 0)
    read = np.where(good, np.where(usable, frames, 0) / safe - 1, 0).astype(np.float32)
    # The smooth picture errs where brightness turns: what is left of the means is taken away.
    seen = read - np.where(good, averaged(read - masks, good, filters, SMOOTH_PX), 0)
    weight = texture_weight(seen - masks, good, filters)
    # Few bright spots make the smooth picture brighter than the calm places that count most.
    calm = averaged(weight * (read - masks), good, filters, SMOOTH_PX) / np.maximum(
        averaged(weight, good, filters, SMOOTH_PX), 1e-12
    )
    seen = np.where(good, (1 + read) / np.maximum(1 + calm, DIMMEST_CALM) - 1, 0)
    return Relief(
        level, masks, read, seen.astype(np.float32), good, weight.astype(np.float32), picture
    )


def texture_weight(texture: Array, good: NDArray[np.bool_], filters: NDArray[np.int64]) -> Array:
    """Return the inverse variance of what the masks do not explain, 0 where it is not known."""
    rough = averaged(np.square(texture), good, filters, LOCAL_PX)
    least = float(np.median(rough[good])) if good.any() else 1.0
    return np.where(good, 1 / np.maximum(rough, 0.3 * least + 1e-12), 0)


def tile_edges(length: int) -> NDArray[np.int64]:
    """Return where tiles of about TILE_PX begin along an axis of so many pixels, and the end."""
    return np.linspace(0, length, max(1, length // TILE_PX) + 1).round().astype(np.int64)


@dataclass(frozen=True, eq=False)
class ShadowStrength:
    """How strongly the masks are seen: 1 where Psi is right.

    strength, error: of every shot, and its standard deviation. relief: root mean square of what
    the masks add.
    """

    strength: NDArray[np.float64]
    error: NDArray[np.float64]
    relief: float


def shadow(relief: Relief) -> ShadowStrength:
    """Return how strongly the masks are seen in the readings."""
    strength, error = zip(
        *(
            _slope(relief.masks[s], relief.seen[s], relief.weight[s])
            for s in range(len(relief.masks))
        ),
        strict=True,
    )
    added = relief.masks[relief.good]
    return ShadowStrength(
        np.array(strength),
        np.array(error),
        float(np.sqrt(np.mean(np.square(added)))) if added.size else 0.0,
    )


def cross_strength(relief: Relief) -> NDArray[np.float64]:
    """Return how strongly each shot's readings show each shot's masks, (read, said)."""
    shots = len(relief.masks)
    return np.array(
        [
            [_slope(relief.masks[t], relief.seen[s], relief.weight[s])[0] for t in range(shots)]
            for s in range(shots)
        ]
    )


def _slope(masks: Array, seen: Array, weight: Array) -> tuple[float, float]:
    """Return the weighted regression of seen on masks and its deviation; NaN if unknown.

    slope = sum(w masks seen) / sum(w masks^2),  e = seen - slope masks
    deviation = sqrt(sum((w masks e)^2)) / sum(w masks^2)
    """
    square = float((weight * np.square(masks, dtype=np.float64)).sum())
    if square <= LEAST_RELIEF**2 * float(weight.sum(dtype=np.float64)):
        return np.nan, np.nan
    slope = float((weight * masks * seen).sum(dtype=np.float64)) / square
    left = np.square(weight * masks * (seen - slope * masks), dtype=np.float64)
    return slope, float(np.sqrt(left.sum())) / square

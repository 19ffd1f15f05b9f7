"""Colour where no pixel has a filter: from how the masks weigh colours from one pixel to the next.

A reading is e t (1 + q . k): e is what a grey picture reads, t the scene's texture, k its two
chrominances over its brightness, and q what they change by Psi. From pixel to pixel q varies, while
t and k hardly do. So the regression of the readings' variation over the nearest pixels on that of q
is k: of the whole picture first, then of smaller windows around it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import Psi

Array = NDArray[np.floating]
NEAREST_PX = 0.7
"""Deviation of the window whose mean is the texture. On 96x96 crops of group A and two built-in
scenes, one shot of `scenario-iii-mono`, 1.0 costs 0.4 dB of the chrominance."""
WINDOWS = (None, 1.0), (16.0, 0.15), (6.0, 0.1)
"""Deviation of the window in pixels, None: the whole picture; and the deviation presumed there of
chrominance over brightness. Twice the latter two cost 0.9 dB, ending at 3 px 2 dB."""
DETAIL = 1.5, 0.07
"""The same of what is finer than these windows: only its remaining amount is estimated."""
ALIKE_PX = 3.0
"""Neighbouring pixels whose textures vary alike: so many make one observation. 1 costs 0.4 dB."""
DIMMEST = 0.05
"""Share of the mean expected reading below which a pixel is left out."""


@dataclass(frozen=True, eq=False)
class Chroma:
    """value: chrominances over luminance by `OPPONENT`, (pixel_y, pixel_x, 2). variance: of both
    together, (pixel_y, pixel_x): the mean over colours, over the squared brightness."""

    value: NDArray[np.float64]
    variance: NDArray[np.float64]


def chroma_of(psi: Psi, frames: Array, usable: NDArray[np.bool_], picture: Array) -> Chroma:
    """Return the chrominance that frames (shot, pixel_y, pixel_x) show.

    With e the reading of the grey picture and q_i that of chrominance i over e, the readings vary
    over the nearest pixels by

        reading / e - mean  =  t (q - mean q) . k + noise,

    and k is estimated window by window, each on what the windows before leave.
    picture: a smooth one (y, x, c) that explains the local means; its colours are ignored.
    """
    grey = np.repeat(picture.mean(axis=-1, keepdims=True), 3, axis=-1)
    level = psi.forward_picture(grey)
    good = usable & (level > DIMMEST * float(level.mean()))
    safe = np.where(good, level, 1)
    near = np.maximum(_blurred(good.sum(axis=0), NEAREST_PX), 1e-6)

    def variation(signal: Array) -> Array:
        share = np.where(good, signal / safe, 0)
        return np.where(good, share - _blurred(share.sum(axis=0), NEAREST_PX) / near, 0)

    left = variation(frames)
    axes = [psi.forward_picture(grey * np.sqrt(3) * axis) for axis in OPPONENT[1:]]
    signs = np.stack([variation(axis) for axis in axes], axis=-1)
    value, posterior = np.zeros((*level.shape[1:], 2)), np.zeros((*level.shape[1:], 2, 2))
    for window, presumed in WINDOWS:
        change, posterior = _regressed(left, signs, good, window, presumed)
        value += change
        left = left - np.einsum("syxi,yxi->syx", signs, change)
    finer = _regressed(left, signs, good, *DETAIL)[1]
    return Chroma(value, np.trace(posterior + finer, axis1=2, axis2=3))


def _regressed(
    left: Array, signs: Array, good: NDArray[np.bool_], window: float | None, presumed: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the chrominance within windows, (pixel_y, pixel_x, 2), and its covariance.

    Least squares with a prior of deviation `presumed`; s the signs, n the mean square left:

        covariance  = (sum(s s^T) w + 1 / presumed^2)^-1,  w = 1 / n of independent pixels
        chrominance = covariance w sum(s left)

    left: variation of the readings not yet explained, (shot, pixel_y, pixel_x). signs: variation by
    a chrominance of 1, (..., 2). window: its deviation in pixels; None: the whole picture.
    """
    size = left.shape[1:]
    square = np.einsum("syxi,syxj->yxij", signs, signs).reshape(*size, 4)
    square = _averaged(square, window)
    product = _averaged(np.einsum("syxi,syx->yxi", signs, left), window)
    count = np.maximum(_averaged(good.sum(axis=0), window), 1e-6)
    noise = _averaged(np.square(left).sum(axis=0), window) / count + 1e-12
    pixels = left[0].size if window is None else min(4 * np.pi * window**2, left[0].size)
    weight = (pixels / ALIKE_PX / noise)[..., None]
    precision = (weight * square).reshape(*size, 2, 2) + np.eye(2) / presumed**2
    covariance = np.linalg.inv(precision)
    change = np.einsum("yxij,yxj->yxi", covariance, weight * product)
    return change, np.asarray(covariance, dtype=np.float64)


def coloured(psi: Psi, frames: Array, usable: NDArray[np.bool_], picture: Array) -> Array:
    """Return the smooth picture (y, x, c) with the colours that the frames show, none below 0."""
    chroma = _of_samples(chroma_of(psi, frames, usable, picture).value, psi.binning)
    grey = picture.mean(axis=-1, keepdims=True)
    return np.maximum(grey * (1 + np.sqrt(3) * chroma @ OPPONENT[1:]), 0).astype(picture.dtype)


def unseen_colour(
    psi: Psi, frames: Array, usable: NDArray[np.bool_], picture: Array
) -> NDArray[np.float64]:
    """Return the variance of a light field's values by colours that frames do not show, (y, x).

    0 where pixels have filters: what their readings miss, others of the frames show.
    """
    if psi.colour is not None:
        return np.zeros(picture.shape[:2])
    variance = _of_samples(chroma_of(psi, frames, usable, picture).variance, psi.binning)
    return np.square(picture.mean(axis=-1, dtype=np.float64)) * variance


def _of_samples(values: Array, binning: int) -> Array:
    return values.repeat(binning, axis=0).repeat(binning, axis=1)


def _blurred(values: Array, deviation: float) -> NDArray[np.float64]:
    blurred = cv2.GaussianBlur(np.asarray(values, np.float64), (0, 0), deviation)
    return np.asarray(blurred, dtype=np.float64)


def _averaged(values: Array, window: float | None) -> NDArray[np.float64]:
    if window is not None:
        return _blurred(values, window)
    return np.asarray(values.mean(axis=(0, 1)), dtype=np.float64) + np.zeros(values.shape)

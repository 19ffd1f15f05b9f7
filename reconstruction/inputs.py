"""What every method is given, checked once: frames that fit Psi, finite where they are used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.errors import ReconstructionError

Array = NDArray[np.floating]
WHITER = 2.0
"""Times the readings of a white scene, on average, that no light field in [0, 1] makes."""


def check_frames(shape: tuple[int, int, int], frames: Array) -> None:
    """Raise ReconstructionError for frames of another shape than Psi's (shot, row, column)."""
    if frames.shape != shape:
        raise ReconstructionError(
            f"frames of shape {frames.shape} given, Psi needs {shape} "
            f"(shot, row, column): {_unlike(frames.shape, shape)}"
        )


def _unlike(given: tuple[int, ...], needed: tuple[int, int, int]) -> str:
    """Return how another shape differs from the one that Psi needs, and what to do."""
    shots, *size = needed
    if list(given) == size:
        return "an axis of shots is missing: frames[None]"
    if len(given) == 3 and list(given[:2]) == size:
        if given[2] == 3 != shots:
            return (
                "a picture of three colours, where Psi is of the sensor's mosaic or of one colour"
            )
        return "the axis of shots comes first: np.moveaxis(frames, -1, 0)"
    if len(given) != 3:
        return f"{len(given)} axes instead of three"
    if list(given[1:]) == size:
        return f"{given[0]} shot(s), Psi is of {shots}: use the Psi measured with these shots"
    if list(given[:0:-1]) == size:
        return "rows and columns are swapped: frames.swapaxes(1, 2)"
    for k in range(2, 17):
        if list(given[1:]) == [k * side for side in size]:
            return f"{k} times as many pixels along each side: bin them, or use a Psi of that size"
        if [k * side for side in given[1:]] == size:
            return f"{k} times fewer pixels along each side: use a Psi of the binned sensor"
    if all(have >= need for have, need in zip(given[1:], size, strict=True)):
        return "more pixels than Psi: cut out the part that Psi is of"
    return "frames of another sensor or part of it: use the Psi measured with it"


def checked_inputs(
    psi: ImagingMatrix, frames: Array, noise_sigma: float, usable: NDArray[np.bool_] | None
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the frames in Psi's type, 0 where not usable, and the mask of usable pixels.

    frames, usable: (shot, pixel_y, pixel_x). Raises ReconstructionError for frames that do not
    fit Psi or are not finite where usable, that are far brighter than a white scene, for a noise
    level that is negative or not finite, and when no pixel is usable.
    """
    if not 0 <= noise_sigma < np.inf:
        raise ReconstructionError(
            f"a noise level of {noise_sigma:g}: it must be finite, at least 0"
        )
    check_frames(psi.frames_shape, frames)
    if usable is None:
        usable = np.ones(psi.frames_shape, dtype=bool)
    if usable.shape != psi.frames_shape:
        raise ReconstructionError(f"the mask of usable pixels has shape {usable.shape}")
    if not usable.any():
        raise ReconstructionError("no usable pixel: every one is saturated or excluded")
    if not np.isfinite(frames[usable]).all():
        raise ReconstructionError("the frames hold values that are not finite: exclude them")
    typical, white = float(np.mean(frames[usable], dtype=np.float64)), psi.light_efficiency()
    if typical > WHITER * white + noise_sigma:
        raise ReconstructionError(
            f"readings of {typical:.3g} on average, where Psi makes {white:.3g} of a white scene: "
            "normalise the frames so that a white board without masks reads 1"
        )
    return np.where(usable, frames, 0).astype(psi.weights.dtype), usable


def checked_noise(
    psi: ImagingMatrix, noise_sigma: float | Array, usable: NDArray[np.bool_] | None
) -> tuple[float, Array]:
    """Return the typical standard deviation of the readings, and the variance of each, float32.

    noise_sigma: one for all, or (shot, pixel_y, pixel_x); the typical one is the root mean square
    of those usable. Readings that are not usable get it too. Raises ReconstructionError for a shape
    that does not fit Psi, and for deviations in use that are negative or not finite.
    """
    if np.ndim(noise_sigma) == 0:
        typical = float(noise_sigma)
        return typical, np.full(psi.frames_shape, typical**2, dtype=np.float32)
    each = np.asarray(noise_sigma)
    if each.shape != psi.frames_shape:
        raise ReconstructionError(
            f"noise levels of shape {each.shape} given, Psi needs {psi.frames_shape} "
            "(shot, row, column), or one for all"
        )
    used = np.ones(psi.frames_shape, dtype=bool) if usable is None else usable
    if not (np.isfinite(each[used]) & (each[used] >= 0)).all():
        raise ReconstructionError(
            "the noise levels hold values that are negative or not finite: exclude these readings"
        )
    mean = float(np.mean(np.square(each[used], dtype=np.float64))) if used.any() else 0.0
    return float(np.sqrt(mean)), np.where(used, np.square(each), mean).astype(np.float32)

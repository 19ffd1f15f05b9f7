"""Frames checked before any method: shapes agree with Psi, used readings are finite."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.errors import ReconstructionError

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
    """Return the difference between a shape and the one that Psi needs, and the remedy."""
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
        return f"shots given: {given[0]}, Psi is of {shots}: use the Psi measured with these shots"
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


def checked_inputs(psi: Psi, frames: Frames) -> Frames:
    """Return frames with readings of Psi's type, 0 at unusable pixels.

    Raises ReconstructionError for frames that do not fit Psi or are not finite where usable, that
    are far brighter than a white scene, for deviations of usable readings that are negative or not
    finite, and when no pixel is usable.
    """
    check_frames(psi.frames_shape, frames.readings)
    usable, used = frames.usable, frames.readings[frames.usable]
    if not used.size:
        raise ReconstructionError(
            "no usable pixel, every one is saturated or excluded: expose shorter"
        )
    deviation = frames.deviation[usable]
    wrong = deviation[~(np.isfinite(deviation) & (deviation >= 0))]
    if wrong.size:
        raise ReconstructionError(
            f"a noise level of {wrong[0]:g}: it must be finite, at least 0, or its reading excluded"
        )
    if not np.isfinite(used).all():
        raise ReconstructionError("the frames hold values that are not finite: exclude them")
    typical, white = float(np.mean(used, dtype=np.float64)), psi.light_efficiency()
    if typical > WHITER * white + frames.noise_sigma:
        raise ReconstructionError(
            f"readings of {typical:.3g} on average, where Psi makes {white:.3g} of a white scene: "
            "normalise the frames so that a white board without masks reads 1"
        )
    readings = np.where(usable, frames.readings, 0).astype(psi.weights.dtype)
    return replace(frames, readings=readings)


@dataclass(frozen=True, eq=False)
class Readings:
    """Psi with its readings as a solver scales them.

    frames, usable: (shot, pixel_y, pixel_x), checked. typical: standard deviation of the readings,
    root mean square. noise: variance of each reading, float32, the mean where it is not usable.
    """

    psi: Psi
    frames: Array
    typical: float
    noise: Array
    usable: NDArray[np.bool_]

    @classmethod
    def of(cls, psi: Psi, frames: Frames) -> Readings:
        """Return the readings of frames; raises ReconstructionError as `checked_inputs` does."""
        frames = checked_inputs(psi, frames)
        typical = frames.noise_sigma
        noise = np.where(frames.usable, np.square(frames.deviation), typical**2)
        return cls(psi, frames.readings, typical, noise.astype(np.float32), frames.usable)

    def over(self, scale: float, of_psi: bool = False) -> Readings:
        """Return the same with readings divided by a scale: of a scene, or of Psi, so much dimmer.

        Psi, frames and noise so many times larger are the same problem.
        """
        if scale == 1:
            return self
        part = self.frames.dtype.type(scale)
        psi = replace(self.psi, weights=self.psi.weights / part) if of_psi else self.psi
        noise = (self.noise / scale**2).astype(np.float32)
        return Readings(psi, self.frames / part, self.typical / scale, noise, self.usable)

    def variance(self, misfit: float) -> Array:
        """Return the variance of the readings, with that of what no model explains."""
        return self.noise + np.float32(misfit**2)

    def precision(self, held: NDArray[np.bool_], misfit: float) -> Array:
        """Return the inverse variance of the readings fitted, 0 of the others."""
        return np.where(self.usable & ~held, 1 / self.variance(misfit), 0).astype(np.float32)

"""Frames of a light field: normalised readings, their standard deviation, which are usable."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.arguments import required
from emmc_rig.model.errors import SensingError


@dataclass(frozen=True)
class Exposure:
    """How a shot was exposed.

    shot: number of the camera's shot, from 0. exposures_s: of its frames, seconds. gain: linear, 1
    at the sensor's base sensitivity. time_s: seconds since the first frame of a film.
    """

    shot: int
    exposures_s: tuple[float, ...]
    gain: float = 1.0
    time_s: float | None = None


@dataclass(frozen=True, eq=False)
class Frames:
    """Normalised readings with their noise; all arrays (shot, pixel_y, pixel_x).

    NumPy takes frames as their readings.

    readings: 1 is the reading of the fully open camera and a white light field. Saturated pixels
    have the reading of their white level, a lower bound; other unusable pixels have 0.
    deviation: standard deviation of each reading, in readings.
    usable: boolean; pixels that are neither saturated nor bad.
    exposures: exposures and gain of each shot; (): unknown.

    Raises:
        SensingError: arrays of different shapes, of other than three axes, `usable` not boolean.
        ArgumentError: no array.
    """

    readings: NDArray[np.floating]
    deviation: NDArray[np.floating]
    usable: NDArray[np.bool_]
    exposures: tuple[Exposure, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        arrays = {"readings": self.readings, "deviation": self.deviation, "usable": self.usable}
        for name, array in arrays.items():
            required(array, np.ndarray, name, "an array (shot, pixel_y, pixel_x)")
        shapes = {array.shape for array in arrays.values()}
        if len(shapes) > 1 or self.readings.ndim != 3 or self.usable.dtype != bool:
            raise SensingError(
                "frames: readings, deviation and usable (boolean) need one shape (shot, pixel_y, "
                f"pixel_x); got {', '.join(f'{n} {a.shape} {a.dtype}' for n, a in arrays.items())}"
            )

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of the axes (shot, pixel_y, pixel_x)."""
        return self.readings.shape

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the readings and of which are usable."""
        digest = hashlib.sha256(np.ascontiguousarray(self.readings).data)
        digest.update(np.ascontiguousarray(self.usable).data)
        return digest.hexdigest()

    @property
    def noise_sigma(self) -> float:
        """Root mean square of the usable readings' deviation; 0 where none is usable.

        Solvers take it as the noise of a typical reading.
        """
        if self.deviation.size and not any(self.deviation.strides):  # one number for all
            return float(self.deviation.flat[0])
        of_usable = self.deviation[self.usable]
        if not of_usable.size:
            return 0.0
        return float(np.sqrt(np.mean(np.square(of_usable, dtype=np.float64))))

    def of_one_deviation(self) -> Frames:
        """Return the same readings, whose deviation is `noise_sigma` throughout."""
        return replace(self, deviation=np.broadcast_to(self.noise_sigma, self.shape))

    def cut(self, part: tuple[slice, ...]) -> Frames:
        """Return some shots, rows and columns."""
        readings, deviation, usable = self.readings[part], self.deviation[part], self.usable[part]
        return Frames(readings, deviation, usable, exposures=self.exposures[part[0]])

    def mean(self, *given: Any, **named: Any) -> Any:
        """Return NumPy's mean of the readings."""
        return self.readings.mean(*given, **named)

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.readings, dtype=dtype, copy=copy)

    def _repr_html_(self) -> str:
        from emmc_rig.model.notebook import figure_html, frame_pictures  # with OpenCV

        return figure_html(repr(self), frame_pictures(self.readings, self.usable))

    def __repr__(self) -> str:
        shots, rows, columns = self.shape
        return (
            f"{type(self).__name__}({shots} shot{'s' * (shots > 1)} of {rows}x{columns} pixels, "
            f"noise {self.noise_sigma:.2g}, {self.usable.mean():.1%} usable)"
        )


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedFrames(Frames):
    """Frames of a simulated exposure; see `Frames` for the other fields.

    frames_dn: raw values, DN. noise_free: readings without noise. Both (shot, pixel_y, pixel_x).
    """

    frames_dn: NDArray[np.uint16]
    noise_free: NDArray[np.floating]


def even_frames(
    readings: NDArray[np.floating], noise_sigma: float, usable: NDArray[np.bool_] | None = None
) -> Frames:
    """Return frames of readings (shot, pixel_y, pixel_x) that all have one standard deviation.

    usable: as `Frames.usable`; by default all are.
    """
    everywhere = np.ones(readings.shape, dtype=bool) if usable is None else usable
    return Frames(readings, np.broadcast_to(float(noise_sigma), readings.shape), everywhere)


def local_mean(
    values: NDArray[np.floating],
    good: NDArray[np.bool_],
    channels: NDArray[np.integer],
    deviation_px: float,
) -> NDArray[np.float32]:
    """Return the Gaussian-weighted mean of the good pixels around each, of its own colour, (y, x).

        mean(p) = sum_q g(p - q) good(q) values(q) / sum_q g(p - q) good(q),

    the sums over the pixels q whose channel is that of p.

    values, good, channels: of a frame, (y, x) each. deviation_px: of the Gaussian g.
    """
    import cv2  # a sixth of a second, which frames alone need not

    found = np.zeros(values.shape, dtype=np.float32)
    for channel in np.unique(channels):
        mine = channels == channel
        use = (mine & good).astype(np.float32)
        top = cv2.GaussianBlur(use * values.astype(np.float32), (0, 0), deviation_px)
        bottom = cv2.GaussianBlur(use, (0, 0), deviation_px)
        found[mine] = (top / np.maximum(bottom, 1e-6))[mine]
    return found

"""Frames of a light field: normalised readings, their standard deviation, which are usable."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Frames:
    """What a reconstruction is given; all arrays (shot, pixel_y, pixel_x).

    readings: 1 is what the fully open camera reads from a white light field; of a saturated pixel
    the least that it can be, of any other that is not usable 0. deviation: the standard deviation
    of each reading. usable: neither saturated nor a bad pixel.
    NumPy takes frames as their readings.
    """

    readings: NDArray[np.floating]
    deviation: NDArray[np.floating]
    usable: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, ...]:
        """(shot, pixel_y, pixel_x)."""
        return self.readings.shape

    @property
    def noise_sigma(self) -> float:
        """Root mean variance of the usable readings, which solvers take as their typical noise."""
        of_usable = self.deviation[self.usable]
        if not of_usable.size:
            return 0.0
        return float(np.sqrt(np.mean(np.square(of_usable, dtype=np.float64))))

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.readings, dtype=dtype, copy=copy)

    def __repr__(self) -> str:
        shots, rows, columns = self.shape
        return (
            f"{type(self).__name__}({shots} shot{'s' * (shots > 1)} of {rows}x{columns} pixels, "
            f"noise {self.noise_sigma:.2g}, {self.usable.mean():.1%} usable)"
        )


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedFrames(Frames):
    """Frames of a simulated exposure, with the raw values and what they read without noise."""

    frames_dn: NDArray[np.uint16]
    noise_free: NDArray[np.floating]

"""What any collection of patch estimates asks of a light field: a target and a weight per sample.

The paper's rho/2 |P L - Lhat|^2 (Section VI-B, eq. 9), for patches of any sizes, places and
weights w, and of any methods, is rho/2 sum_(y, x) W |L - M|^2 + const: W(y, x) sums the weights
of the patches that cover a sample, M is their weighted mean. So L needs no patches any more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.errors import ReconstructionError

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class PatchTerm:
    """target: M, (v, u, y, x, c) float32. weight: W, (y, x) float32, 0 where nothing is known.

    The factor rho stays outside, in the settings of the solver.
    """

    target: NDArray[np.float32]
    weight: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.target.ndim != 5 or self.target.shape[-1] != 3:
            raise ReconstructionError(
                f"a patch target of shape {self.target.shape}: give (v, u, y, x, 3)"
            )
        if self.weight.shape != self.target.shape[2:4]:
            raise ReconstructionError(
                f"patch weights of shape {self.weight.shape} do not fit a target of "
                f"{self.target.shape[2:4]} samples"
            )
        if not np.isfinite(self.weight).all():
            raise ReconstructionError("the patch weights hold values that are not finite")
        if self.weight.size and self.weight.min() < 0:
            raise ReconstructionError(
                f"a patch weight of {self.weight.min():g}: it must be at least 0 (0 leaves out)"
            )
        if not np.isfinite(self.target).all():
            raise ReconstructionError(
                "the patch target has values that are not finite: give those samples weight 0"
            )

    def value(self, light_field: Array) -> float:
        """Return 1/2 sum W |L - M|^2 of a light field (v, u, y, x, c), without rho."""
        total = 0.0
        for view in np.ndindex(self.target.shape[:2]):
            square = np.square(light_field[view] - self.target[view], dtype=np.float64)
            total += float(np.sum(self.weight * square.sum(axis=-1)))
        return total / 2

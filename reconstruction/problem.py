"""What the variational methods minimise: the paper's eq. 9.

min over L of 1/2 |Psi L - I|^2 + mu DV_K(L) + rho/2 |P L - Lhat|^2, over the usable pixels. The
last term, for patches of any sizes, places and weights w (Section VI-B), is rho/2 sum_(y, x) W
|L - M|^2 + const: W(y, x) sums the weights of the patches that cover a sample, M is their weighted
mean. So L needs no patches any more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import ImagingMatrix, rows_of_colours
from emmc_rig.reconstruction.differences import planar_variation

Array = NDArray[np.floating]


def colour_metric(chroma_weight: float) -> NDArray[np.float64]:
    """Return what turns R, G, B into weighted opponent colours, (3, 3)."""
    return np.diag([1, chroma_weight, chroma_weight]) @ OPPONENT


@dataclass(frozen=True, eq=False)
class PatchTerm:
    """What patch estimates ask of a light field.

    target: M, (v, u, y, x, c) float32. weight: W, (y, x) float32, 0 where nothing is known, the
    same for all samples of a pixel.
    """

    target: NDArray[np.float32]
    weight: NDArray[np.float32]

    def value(self, light_field: Array) -> float:
        """Return 1/2 sum W |L - M|^2 of a light field (v, u, y, x, c), without rho."""
        total = 0.0
        for view in np.ndindex(self.target.shape[:2]):
            square = np.square(light_field[view] - self.target[view], dtype=np.float64)
            total += float(np.sum(self.weight * square.sum(axis=-1)))
        return total / 2


@dataclass(frozen=True, eq=False)
class Problem:
    """Psi, frames (0 where not usable), usable pixels (shot, y, x), patches or None, and weights.

    The differences are of colours multiplied by `metric` (3, 3), of Psi's type.
    """

    psi: ImagingMatrix
    frames: Array
    usable: NDArray[np.bool_]
    mu: float
    order: int
    metric: Array
    patch_term: PatchTerm | None = None
    rho: float = 0.0

    def value(self, light_field: Array) -> float:
        """Return the objective at a light field (v, u, y, x, c), fastest if stored (v, u, y, c, x).

        That of the patches leaves out what no light field changes.
        """
        misfit = (self.psi.forward(light_field) - self.frames)[self.usable]
        planar = np.ascontiguousarray(rows_of_colours(light_field))
        variation = planar_variation(planar, self.order, self.metric)
        value = 0.5 * np.sum(np.square(misfit, dtype=np.float64)) + self.mu * variation
        if self.patch_term is not None:
            value += self.rho * self.patch_term.value(light_field)
        return float(value)

    def pixel_weight(self) -> NDArray[np.float64]:
        """Return rho W of the samples of each pixel, (pixel_y, pixel_x)."""
        if self.patch_term is None:
            return np.zeros(self.psi.frames_shape[1:])
        k = self.psi.binning
        return self.rho * self.patch_term.weight[::k, ::k].astype(np.float64)

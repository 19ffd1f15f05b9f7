"""What the variational methods minimise: the paper's eq. 9.

min over L of 1/2 |Psi L - I|^2 + mu DV_K(L) + rho/2 |P L - Lhat|^2, over the usable pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.sensing import ImagingMatrix, rows_of_colours
from reconstruction.differences import planar_variation
from reconstruction.errors import ReconstructionError
from reconstruction.patch_term import PatchTerm

Array = NDArray[np.floating]


def colour_metric(chroma_weight: float) -> NDArray[np.float64]:
    """Return what turns R, G, B into weighted opponent colours, (3, 3)."""
    return np.diag([1, chroma_weight, chroma_weight]) @ OPPONENT


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

        That of the patches leaves out what no light field changes (see `patch_term`).
        """
        misfit = (self.psi.forward(light_field) - self.frames)[self.usable]
        planar = np.ascontiguousarray(rows_of_colours(light_field))
        variation = planar_variation(planar, self.order, self.metric)
        value = 0.5 * np.sum(np.square(misfit, dtype=np.float64)) + self.mu * variation
        if self.patch_term is not None:
            value += self.rho * self.patch_term.value(light_field)
        return float(value)

    def pixel_weight(self) -> NDArray[np.float64]:
        """Return rho W of the samples of each pixel, (pixel_y, pixel_x).

        Raises ReconstructionError where the samples of a pixel differ: Psi Psi^T would then not
        be inverted by the pixels' blocks.
        """
        _, rows, columns = self.psi.frames_shape
        if self.patch_term is None:
            return np.zeros((rows, columns))
        k = self.psi.binning
        blocks = self.patch_term.weight.reshape(rows, k, columns, k)
        if (blocks != blocks[:, :1, :, :1]).any():
            raise ReconstructionError(
                f"pixels of {k}x{k} samples need one patch weight per pixel: "
                f"use patch corners and sizes that are multiples of {k}"
            )
        return self.rho * blocks[:, 0, :, 0].astype(np.float64)

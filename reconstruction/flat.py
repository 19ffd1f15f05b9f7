"""Psi of scenes that look the same in every view: pictures to frames, at a picture's cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class FlatPsi:
    """weights: (shot, y, x, colour), Psi's coefficients summed over the views.

    colour: as Psi's, of every sample. binning: k.
    """

    weights: Array
    colour: NDArray[np.uint8] | None
    binning: int

    def forward(self, picture: Array) -> Array:
        """Return the frames (shot, pixel_y, pixel_x) of a picture (y, x, c) in all views."""
        seen = np.einsum("syxc,yxc->syx", self.weights, picture)
        shots, rows, columns = seen.shape
        k = self.binning
        return seen.reshape(shots, rows // k, k, columns // k, k).sum(axis=(2, 4))

    def adjoint(self, frames: Array) -> Array:
        """Return the sum over the views of Psi^T frames, (y, x, c)."""
        k = self.binning
        return np.einsum("syxc,syx->yxc", self.weights, frames.repeat(k, axis=1).repeat(k, axis=2))


def flat_psi(psi: ImagingMatrix) -> FlatPsi:
    """Return a Psi's action on pictures that are the same in all views."""
    summed = psi.weights.sum(axis=(1, 2), dtype=np.float64).astype(psi.weights.dtype)
    summed = np.moveaxis(summed, 2, 3)
    if psi.colour is None:
        return FlatPsi(np.ascontiguousarray(summed), None, psi.binning)
    weights = np.zeros((*summed.shape[:3], 3), dtype=summed.dtype)
    np.put_along_axis(weights, psi.colour[..., None].astype(np.intp), summed, axis=-1)
    return FlatPsi(weights, psi.colour, psi.binning)

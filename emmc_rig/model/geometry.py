"""The geometry of rays and masks: where a ray crosses a mask, and the footprint of a pixel there.

A ray through the sensor point x and the lens point u (lens at distance D from the sensor) meets
a mask at distance d from the sensor at xi = (1 - d/D) x + (d/D) u (paper, eq. 2). A pixel of
width w_x and an aperture cell of width w_u therefore see the mask through the convolution of two
boxes, (1 - d/D) w_x and (d/D) w_u wide. On square cells that integral is exact and separable.

Neglected: diffraction (see `fresnel_number`), the thickness of the mask, and the obliquity of the
rays (cosine falloff), which whiteboard calibration measures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.errors import CameraError

WAVELENGTH_UM = 0.55
SMALLEST_SHARE = 1e-9


def centred_grid(count: int, pitch: float) -> NDArray[np.float64]:
    """Return `count` equally spaced positions around 0, in the unit of `pitch`."""
    return np.asarray((np.arange(count) - (count - 1) / 2) * pitch, dtype=np.float64)


def mask_position(
    x: NDArray[np.float64] | float,
    u: NDArray[np.float64] | float,
    distance: float,
    lens_distance: float,
) -> NDArray[np.float64]:
    """Return where the ray through x (sensor) and u (lens) meets the mask (paper, eq. 2)."""
    ratio = distance / lens_distance
    return np.asarray((1 - ratio) * np.asarray(x) + ratio * np.asarray(u))


def fresnel_number(cell_um: float, distance_mm: float) -> float:
    """Return a^2 / (lambda d) of a mask cell of half-width a at 550 nm; below 1 diffraction rules.

    Source: Born & Wolf, Principles of Optics, 8.3; infinite for a mask in contact.
    """
    if distance_mm == 0:
        return float("inf")
    return (cell_um / 2) ** 2 / (WAVELENGTH_UM * distance_mm * 1e3)


@dataclass(frozen=True)
class Footprint:
    """Two boxes whose convolution weighs the mask: the pixel's and the aperture cell's, in um."""

    pixel_um: float
    aperture_um: float

    @property
    def half_width_um(self) -> float:
        """Half the support of the convolution of the two boxes."""
        return (self.pixel_um + self.aperture_um) / 2


def covered(edge_um: Any, footprint: Footprint) -> Any:
    """Return the share of the footprint that lies below `edge_um` (relative to its centre).

    edge_um: an array, or a tensor of PyTorch: the share is of the same kind.
    """
    wide = max(footprint.pixel_um, footprint.aperture_um)
    narrow = min(footprint.pixel_um, footprint.aperture_um)
    if wide == 0:
        return (edge_um > 0) * 1.0
    if narrow < 1e-6 * wide:
        return (edge_um / wide + 0.5).clip(0, 1)
    outer, inner = (wide + narrow) / 2, (wide - narrow) / 2
    rise = (edge_um + outer).clip(0, narrow)
    fall = (edge_um - inner).clip(0, narrow)
    flat = (edge_um + inner).clip(0, 2 * inner)
    return (rise**2 / 2 / narrow + flat + fall - fall**2 / 2 / narrow) / wide


@dataclass(frozen=True, eq=False)
class CellWeights:
    """A matrix (footprint, cell) of `cells` columns, in which a row is 0 but for a few neighbours.

    first: (footprint,), the first of them. values: (footprint, neighbour).
    """

    first: NDArray[np.int64]
    values: NDArray[np.float64]
    cells: int

    def __matmul__(self, of_cells: NDArray) -> NDArray[np.float64]:
        """Return the product with an array (cell, any)."""
        total = np.zeros((len(self.first), of_cells.shape[1]))
        for step, share in enumerate(self.values.T):
            if share.any():
                total += share[:, None] * of_cells[np.minimum(self.first + step, self.cells - 1)]
        return total

    @property
    def splits_cells(self) -> bool:
        """Whether some footprint covers several cells."""
        return bool(((self.values > 0).sum(axis=1) > 1).any())

    @classmethod
    def summed(cls, matrices: Sequence[CellWeights]) -> CellWeights:
        """Return the sum of matrices of one shape, as those of neighbouring views."""
        first = np.min([matrix.first for matrix in matrices], axis=0)
        ends = [matrix.first + matrix.values.shape[1] for matrix in matrices]
        values = np.zeros((len(first), int((np.max(ends, axis=0) - first).max())))
        for matrix in matrices:
            columns = (matrix.first - first)[:, None] + np.arange(matrix.values.shape[1])
            np.add.at(values, (np.arange(len(first))[:, None], columns), matrix.values)
        return cls(first, values, matrices[0].cells)

    def toarray(self) -> NDArray[np.float64]:
        """Return the whole matrix."""
        return self @ np.eye(self.cells)


def require_reach(
    farthest_um: float, footprint: Footprint, cell_um: float, cell_count: int
) -> None:
    """Raise CameraError where a footprint, `farthest_um` from the middle, leaves the mask."""
    reach = farthest_um + footprint.half_width_um
    if reach > cell_count * cell_um / 2 * (1 + 1e-9):
        needed = int(np.ceil(2 * reach / cell_um - 1e-9))
        raise CameraError(
            f"the mask is smaller than the beam: it has {cell_count} cells of {cell_um:g} um, "
            f"the beam needs {needed}; enlarge the mask or reduce its offset"
        )


def cell_weights(
    positions_um: NDArray[np.float64],
    footprint: Footprint,
    cell_um: float,
    cell_count: int,
) -> CellWeights:
    """Return how much of each mask cell every footprint covers along one axis.

    positions_um: (n,) centres of the footprints on the mask, 0 at the middle of its
        `cell_count` cells.
    Returns a matrix (n, cell_count) whose rows sum to 1.
    Raises CameraError when a footprint reaches beyond the mask.
    """
    require_reach(float(np.abs(positions_um).max()), footprint, cell_um, cell_count)
    half = cell_count * cell_um / 2
    first = np.floor((positions_um - footprint.half_width_um + half) / cell_um + 1e-9).astype(int)
    first = np.clip(first, 0, cell_count - 1)
    band = int(np.ceil(2 * footprint.half_width_um / cell_um)) + 2
    index = first[:, None] + np.arange(band + 1)[None, :]
    edges_um = index * cell_um - half - positions_um[:, None]
    below = covered(edges_um, footprint)
    below[:, 0] = 0.0
    values = np.diff(below, axis=1)
    values[values < SMALLEST_SHARE] = 0
    return CellWeights(first, values, cell_count)

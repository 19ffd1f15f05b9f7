"""How Psi treats what light fields are made of: coherence of columns, condition along disparities.

Of columns: the mutual coherence of compressed sensing, the largest cosine between two (Donoho &
Elad 2003). Columns of different pixels are orthogonal, and from one shot those of one pixel and
colour are parallel, so that it says nothing of such cameras; what does are atoms, spots on a plane
seen by all views: Psi atom at one disparity against another.

Restricted condition numbers: those of Psi on the patches that a scene can be made of. A texture on
a plane at disparity d makes patches with covariance K_d, whose leading principal components U_d
hold most of their variance; the singular values of Psi U_d bound how much any such patch shrinks
(the restricted isometry of Candes & Tao 2005, on these subspaces in place of all sparse ones).
Union of two disparities: on [U_d U_d'], where what one patch shows is to be parted among both; and
how much of what one reads the other does not explain. Noise gain of least squares on the subspace:
|(Psi U_d)^+|_F per value of the light field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.theory.patch import PatchModel, Texture

Array = NDArray[np.floating]
MODES = 24
"""Principal components that stand for the patches of a disparity: 80 % of their variance or so, and
for a union of two no more than the 64 readings of one shot of 8 x 8 pixels."""
SPOT_PX = 1.0
SAME_DIRECTION = 0.1
"""Sine of the angle below which a direction of one disparity's patches counts as the other's."""


def ray_coherence(psi: ImagingMatrix) -> float:
    """Return the mean cosine between columns of one sample and colour in neighbouring views.

    Over pairs of which both are seen. 1 says that columns alone do not separate the views: from
    one shot, always. NaN where no such pair is seen.
    """
    weights = psi.weights.astype(np.float64)
    if psi.colour is not None:
        seen = psi.colour[:, :, None, :] == np.arange(3)[:, None]
        weights = weights * seen[:, None, None]
    lengths = np.sqrt(np.square(weights).sum(axis=0))
    cosines = []
    for axis in (0, 1):
        first = [slice(None)] * 5
        second = [slice(None)] * 5
        first[axis], second[axis] = slice(0, -1), slice(1, None)
        one, other = weights[(slice(None), *first)], weights[(slice(None), *second)]
        product = lengths[tuple(first)] * lengths[tuple(second)]
        lit = product > 0
        cosines.append((one * other).sum(axis=0)[lit] / product[lit])
    every = np.concatenate(cosines)
    return float(every.mean()) if every.size else float("nan")


def spot_coherence(patch: PatchModel, disparities: Array) -> NDArray[np.float64]:
    """Return the cosines between Psi of grey spots at these disparities, (d, d).

    Spots: Gaussian, of deviation SPOT_PX, in the middle of the patch's centre view.
    """
    middle = (patch.side - 1) / 2
    y, x, v, u = patch.rays.T
    atoms = []
    for d in disparities:
        square = (y - d * v - middle) ** 2 + (x - d * u - middle) ** 2
        read = patch.opponent[0] @ np.exp(-square / (2 * SPOT_PX**2))
        atoms.append(read / max(float(np.linalg.norm(read)), 1e-300))
    return np.array(atoms) @ np.array(atoms).T


@dataclass(frozen=True, eq=False)
class Subspace:
    """basis: (colour, ray, mode), orthonormal modes of each opponent colour, in falling order.

    counts: modes of each colour that count.
    """

    basis: NDArray[np.float64]
    counts: tuple[int, int, int]

    @property
    def size(self) -> int:
        """How many modes count."""
        return sum(self.counts)


def subspace(patch: PatchModel, disparity: float, texture: Texture, modes: int = MODES) -> Subspace:
    """Return the leading principal components of patches of a texture at a disparity."""
    alike = patch.alike(disparity, texture)
    begin = np.random.default_rng(0).standard_normal(len(alike))
    values, vectors = eigsh(alike, k=min(modes, len(alike) - 1), v0=begin)
    values, vectors = values[::-1], vectors[:, ::-1]
    held = texture.variances[:, None] * values
    least = np.sort(held.ravel())[::-1][min(modes, held.size) - 1]
    # Of two chrominances that vary alike, the second stays behind where both would be too many.
    luminance = int((held[0] >= least).sum())
    first = min(int((held[1] >= least).sum()), modes - luminance)
    second = min(int((held[2] >= least).sum()), modes - luminance - first)
    return Subspace(np.broadcast_to(vectors, (3, *vectors.shape)), (luminance, first, second))


def sensed(patch: PatchModel, space: Subspace) -> NDArray[np.float64]:
    """Return Psi on a subspace's modes, (reading, mode)."""
    parts = [
        seen @ basis[:, :count]
        for seen, basis, count in zip(patch.opponent, space.basis, space.counts, strict=True)
    ]
    return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class Condition:
    """number: largest over least singular value, infinite with more modes than readings.

    gain: root mean square error of the light field's values per deviation of a reading's noise, by
    least squares; infinite likewise. modes: of the subspace.
    """

    number: float
    gain: float
    modes: int


def condition(patch: PatchModel, space: Subspace) -> Condition:
    """Return how Psi is conditioned on a subspace."""
    read = sensed(patch, space)
    if read.shape[1] > read.shape[0]:
        return Condition(float("inf"), float("inf"), space.size)
    singular = np.linalg.svd(read, compute_uv=False)
    if singular[-1] <= 1e-12 * singular[0]:
        return Condition(float("inf"), float("inf"), space.size)
    values = 3 * patch.opponent.shape[2]
    gain = float(np.sqrt(np.square(1 / singular).sum() / values))
    return Condition(float(singular[0] / singular[-1]), gain, space.size)


def unexplained(patch: PatchModel, one: Subspace, other: Subspace) -> float:
    """Return the share of what patches of `one` read that no patch of `other` explains, 0 to 1.

    The mean squared sine of the principal angles between the two in the space of the readings
    (Bjorck & Golub 1973): 0 where the disparities cannot be separated.
    """
    first, second = (np.linalg.qr(sensed(patch, space))[0] for space in (one, other))
    cosines = np.linalg.svd(second.T @ first, compute_uv=False)
    return float(1 - np.square(cosines).sum() / first.shape[1])


def union(spaces: Sequence[Subspace]) -> Subspace:
    """Return the subspace of all patches that are sums of patches of these."""
    bases, counts = [], []
    for colour in range(3):
        joined = np.zeros((spaces[0].basis.shape[1], 0))
        for space in spaces:
            new = space.basis[colour, :, : space.counts[colour]]
            beyond = new - joined @ (joined.T @ new)
            left, sines, _ = np.linalg.svd(beyond, full_matrices=False)
            joined = np.concatenate([joined, left[:, sines > SAME_DIRECTION]], axis=1)
        bases.append(joined)
        counts.append(joined.shape[1])
    widest = max(counts)
    filled = [np.pad(one, ((0, 0), (0, widest - one.shape[1]))) for one in bases]
    first, second, third = counts
    return Subspace(np.stack(filled), (first, second, third))

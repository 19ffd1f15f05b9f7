"""Batch orthogonal matching pursuit: sparse codes of many patches in one dictionary.

The Gram matrix of the atoms is computed once (Rubinstein, Zibulevsky, Elad 2008, "Efficient
implementation of the K-SVD algorithm using batch orthogonal matching pursuit"), so that a pursuit
never touches the patches' samples again. Unlike there, every chosen atom's row of the Gram matrix
is orthogonalised against the earlier ones: the correlations are then lowered by one row per step,
and those rows stay in cache where the Gram matrix does not.

Operations for N patches of n samples, K atoms, k of them per code: 2 K^2 n / 2 for the Gram matrix
and 2 N K n for the correlations (matrix products), N K (k^2 + 3 k) for the pursuits. For
N = 30,000, n = 6,075, K = 5,120, k = 10: 0.16, 1.9 and 0.02 TFLOP.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numba import get_num_threads
from numpy.typing import NDArray

from emmc_rig.model.compiling import njit
from emmc_rig.reconstruction.errors import DictionaryError

Array = NDArray[np.float32]
NO_ATOM = -1
_BATCH_BYTES = 24 << 20


@njit(cache=True, nogil=True, fastmath=True)
def _largest(values):
    """Return the place of the value largest in size: by blocks, then in the best block."""
    block = 512
    best = np.float32(-1)
    begin = 0
    for start in range(0, values.size, block):
        top = np.float32(0)
        for i in range(start, min(start + block, values.size)):
            top = max(top, abs(values[i]))
        if top > best:
            best = top
            begin = start
    for i in range(begin, min(begin + block, values.size)):
        if abs(values[i]) == best:
            return i
    return begin


@njit(cache=True, nogil=True, fastmath=True)
def _pursue(gram, correlations, floors, smallest_pivot, indices, coefficients):
    """Set the codes of patches: indices (patch, k), NO_ATOM where fewer suffice, coefficients.

    correlations: (patch, atom) with the atoms, spoilt. floors: (patch,), a pursuit ends when no
    correlation is larger. smallest_pivot: the squared distance of an atom from the span of the
    chosen ones below which it adds nothing but rounding.
    """
    atoms = gram.shape[0]
    steps = indices.shape[1]
    rows = np.empty((steps, atoms), gram.dtype)
    factor = np.zeros((steps, steps))
    along = np.zeros(steps)
    for patch in range(correlations.shape[0]):
        left = correlations[patch]
        done = 0
        for step in range(steps):
            atom = _largest(left)
            if abs(left[atom]) <= floors[patch]:
                break
            square = np.float64(gram[atom, atom])
            for j in range(step):
                factor[step, j] = rows[j, atom]
                square -= factor[step, j] * factor[step, j]
            if square < smallest_pivot:
                break
            pivot = np.sqrt(square)
            factor[step, step] = pivot
            along[step] = left[atom] / pivot
            row, source = rows[step], gram[atom]
            scale = np.float32(1 / pivot)
            for i in range(atoms):
                row[i] = source[i] * scale
            for j in range(step):
                part, other = np.float32(factor[step, j] / pivot), rows[j]
                for i in range(atoms):
                    row[i] -= part * other[i]
            length = np.float32(along[step])
            for i in range(atoms):
                left[i] -= length * row[i]
            indices[patch, step] = atom
            done = step + 1
        for step in range(done, steps):
            indices[patch, step] = NO_ATOM
            coefficients[patch, step] = 0
        for step in range(done - 1, -1, -1):
            value = along[step]
            for j in range(step + 1, done):
                value -= factor[j, step] * coefficients[patch, j]
            coefficients[patch, step] = value / factor[step, step]


def bands(count: int) -> list[tuple[int, int]]:
    """Return the first and last + 1 of as many even parts of `count` as there are threads."""
    edges = np.unique(np.linspace(0, count, get_num_threads() + 1).astype(int))
    return [(int(a), int(b)) for a, b in pairwise(edges)]


def batch_omp(
    atoms: Array,
    patches: Array,
    sparsity: int,
    relative_floor: float = 1e-6,
    smallest_pivot: float = 1e-5,
) -> tuple[NDArray[np.int32], Array]:
    """Return the codes of patches by orthogonal matching pursuit.

    Args:
        atoms: (atom, sample), unit norm, float32.
        patches: (patch, sample) float32.
        sparsity: atoms per code at most; a pursuit ends earlier when the correlations fall below
            `relative_floor` of the patch's norm, or the next atom is nearly in the chosen span.
        relative_floor: see there.
        smallest_pivot: the squared distance from that span that is too near.

    Returns:
        indices (patch, sparsity) int32, NO_ATOM where fewer were taken, and the coefficients.

    Raises:
        DictionaryError: patches of another size, a sparsity below 1 or above the atoms' number.
    """
    if patches.ndim != 2 or patches.shape[1] != atoms.shape[1]:
        raise DictionaryError(
            f"patches of shape {patches.shape}, but atoms have {atoms.shape[1]} samples"
        )
    if not 1 <= sparsity <= len(atoms):
        raise DictionaryError(f"a sparsity of {sparsity}: needs 1 to {len(atoms)}, the atoms")
    count = len(patches)
    indices = np.full((count, sparsity), NO_ATOM, np.int32)
    coefficients = np.zeros((count, sparsity), np.float32)
    gram = atoms @ atoms.T
    size = max(get_num_threads(), _BATCH_BYTES // (4 * len(atoms)))
    correlations = np.empty((min(size, count), len(atoms)), np.float32)
    with ThreadPoolExecutor(get_num_threads()) as pool:
        for start in range(0, count, size):
            batch = patches[start : start + size]
            filled = correlations[: len(batch)]
            np.matmul(batch, atoms.T, out=filled)
            floors = relative_floor * np.linalg.norm(batch, axis=1)

            def pursue(
                band: tuple[int, int],
                start: int = start,
                filled: Array = filled,
                floors: Array = floors,
            ) -> None:
                inner = slice(*band)
                outer = slice(start + band[0], start + band[1])
                codes = indices[outer], coefficients[outer]
                _pursue(gram, filled[inner], floors[inner], smallest_pivot, *codes)

            list(pool.map(pursue, bands(len(batch))))
    return indices, coefficients

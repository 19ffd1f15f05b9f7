"""DV_K and patches by their definitions, in plain NumPy: what solvers are tested with."""

from functools import cache, reduce

import numpy as np
from scipy import sparse

from emmc_rig.reconstruction.differences import fitting_indices, planar_variation
from emmc_rig.reconstruction.problem import PatchTerm

AXIS = (3, 2, 1, 0)
"""Entries of a multi-index, x y u v, as axes of (v, u, y, x, c)."""


def from_patches(positions, patches, weights, shape):
    """Return the term of patches (v, u, y, x, c) at their corners; weights: None counts each once.

    The paper's P and its weights: what covers a sample is averaged, as each patch weighs.
    """
    total = np.zeros(shape, np.float32)
    weight = np.zeros(shape[2:4], np.float32)
    for (y, x), patch, share in zip(
        positions, patches, weights or [1.0] * len(patches), strict=True
    ):
        place = np.s_[y : y + patch.shape[2], x : x + patch.shape[3]]
        weight[place] += share
        total[(slice(None), slice(None), *place)] += (
            np.asarray(share, np.float32)[..., None] * patch
        )
    target = total / np.where(weight > 0, weight, 1)[..., None]
    return PatchTerm(np.asarray(target, np.float32), np.asarray(weight, np.float32))


@cache
def difference_matrix(shape, order):
    """Return the derivatives of flattened light fields as a sparse matrix, index by index."""
    blocks = []
    for index in fitting_indices(order, shape):
        parts = [sparse.eye_array(length) for length in shape]
        for entry, axis in zip(index, AXIS, strict=True):
            inside = sparse.csr_array(np.diff(np.eye(shape[axis]), entry, axis=0))
            inside.resize((shape[axis], shape[axis]))
            parts[axis] = inside
        blocks.append(reduce(sparse.kron, parts))
    return sparse.vstack(blocks).tocsr()


def variation(light_field, order, metric=None):
    """DV_K of a light field (v, u, y, x, c), its colours first multiplied by a metric."""
    planar = np.ascontiguousarray(np.swapaxes(light_field, -1, -2))
    metric = np.eye(3) if metric is None else metric
    return planar_variation(planar, order, metric.astype(planar.dtype))


def gradient(light_field, order):
    """Return all derivatives (index, v, u, y, x, c); 0 where a derivative crosses the border."""
    matrix = difference_matrix(light_field.shape, order)
    return (matrix @ light_field.ravel()).reshape(-1, *light_field.shape)


def adjoint(derivatives, order):
    """Return the adjoint of `gradient`; values where a derivative does not fit do not count."""
    shape = derivatives.shape[1:]
    return (difference_matrix(shape, order).T @ derivatives.ravel()).reshape(shape)

"""DV_K, the paper's differential regulariser of any order (Section VI-B): derivatives and norms.

A derivative of order K follows a multi-index (x, y, u, v) whose entries sum to K: forward
differences, binomial stencils. It exists only where its whole stencil fits, so DV_2 of an affine
light field is 0. DV_K sums over the distinct multi-indices, C(K + 3, 3) of them, as the paper
defines it (its dual variable, of 4^K ordered derivatives, would count mixed ones repeatedly).

Light fields have axes (v, u, y, x, c).
"""

from __future__ import annotations

from itertools import product
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvals_banded

from emmc_rig.reconstruction import kernels
from emmc_rig.reconstruction.errors import ReconstructionError

Array = NDArray[np.floating]
MultiIndex = tuple[int, int, int, int]
EDGE_FREE_AT = 64
"""Samples from which on an axis counts as endless in `norm_squared`: it is so to 1 in 1000."""


def multi_indices(order: int) -> list[MultiIndex]:
    """Return the distinct multi-indices (x, y, u, v) of an order, x's own derivative first."""
    if order < 1:
        raise ReconstructionError(f"derivatives of order {order}: the order must be at least 1")
    return [
        (x, y, u, order - x - y - u)
        for x, y, u in product(range(order, -1, -1), repeat=3)
        if x + y + u <= order
    ]


def fitting_indices(order: int, shape: tuple[int, ...]) -> list[MultiIndex]:
    """Return the multi-indices that fit into a light field (v, u, y, x, ...) somewhere.

    Raises ReconstructionError when none does: DV_K would be 0 whatever the light field.
    """
    views_v, views_u, rows, columns = shape[:4]
    fitting = [
        index
        for index in multi_indices(order)
        if all(n < size for n, size in zip(index, (columns, rows, views_u, views_v), strict=True))
    ]
    if not fitting:
        raise ReconstructionError(
            f"no derivative of order {order} fits {views_v}x{views_u} views of {rows}x{columns} "
            "samples: lower the order"
        )
    return fitting


def stencils(order: int, shape: tuple[int, ...], dtype: np.dtype) -> kernels.Stencils:
    """Return the stencils of all derivatives that fit a light field (v, u, y, x, ...)."""
    indices = fitting_indices(order, shape)
    offsets = [list(product(*(range(n + 1) for n in index))) for index in indices]
    factors = [
        np.prod([(-1) ** (n - k) * comb(n, k) for n, k in zip(index, tap, strict=True)])
        for index, taps in zip(indices, offsets, strict=True)
        for tap in taps
    ]
    return kernels.Stencils(
        np.array(indices, dtype=np.int64),
        np.cumsum([0, *map(len, offsets)]),
        np.array([tap for taps in offsets for tap in taps], dtype=np.int64),
        np.array(factors, dtype=dtype),
    )


def _difference_norm_squared(order: int, samples: int | None) -> float:
    """Return |D|^2 of the order-th difference of `samples` values; None, or many: its limit 4^K.

    D D^T is banded: (-1)^k C(2 K, K + k) on its k-th diagonals; |D|^2 is its largest eigenvalue.
    """
    if samples is None or samples >= EDGE_FREE_AT or order == 0:
        return 4.0**order
    if samples <= order:
        return 0.0
    size = samples - order
    band = [(-1) ** k * comb(2 * order, order + k) for k in range(min(order + 1, size))]
    lower = np.repeat(np.array(band, dtype=np.float64)[:, None], size, axis=1)
    return float(np.max(eigvals_banded(lower, lower=True)))


def norm_squared(order: int, shape: tuple[int | None, ...]) -> float:
    """Return a bound on |gradient|^2 of a light field (v, u, y, x, ...); None: an endless axis.

    The sum over multi-indices of the products of their axes' exact norms: exact where one axis
    differs, or for order 1, and otherwise at most a few per cent above (see the tests).
    """
    views_v, views_u, rows, columns = shape[:4]
    sizes = (columns, rows, views_u, views_v)
    return sum(
        float(np.prod([_difference_norm_squared(n, s) for n, s in zip(index, sizes, strict=True)]))
        for index in multi_indices(order)
    )


def planar_variation(planar: Array, order: int, metric: Array) -> float:
    """Return DV_K of a contiguous light field (v, u, y, c, x)."""
    shape = (*planar.shape[:3], planar.shape[4])
    totals = np.empty(planar.shape[2])
    taps = stencils(order, shape, planar.dtype)
    kernels.variation_rows(planar, taps, metric, totals)
    return float(totals.sum())

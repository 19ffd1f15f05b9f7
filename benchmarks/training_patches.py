"""Patches of light fields to learn from, at random places and through random symmetries."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def cut_patches(
    light_field: Array,
    corners: NDArray[np.int64],
    symmetries: NDArray[np.int64],
    size: tuple[int, int],
) -> Array:
    """Cut patches (patch, v, u, y, x, c) of `size` rows and columns.

    corners: (patch, 2), first row and column. symmetries: (patch,), 1 mirrors columns, + 2 rows,
    + 4 exchanges both (square views and patches only); views and pixels together.
    """
    windows = np.lib.stride_tricks.sliding_window_view(light_field, size, axis=(2, 3))
    cut = windows[:, :, corners[:, 0], corners[:, 1]]
    patches = np.ascontiguousarray(cut.transpose(2, 0, 1, 4, 5, 3))
    for bit in (1, 2, 4):
        turned = (symmetries & bit) > 0
        if not turned.any():
            continue
        some = patches[turned]
        if bit == 1:
            patches[turned] = some[:, :, ::-1, :, ::-1]
        elif bit == 2:
            patches[turned] = some[:, ::-1, :, ::-1]
        else:
            patches[turned] = some.transpose(0, 2, 1, 4, 3, 5)
    return patches


def drawn_patches(
    light_field: Array, count: int, size: tuple[int, int], rng: np.random.Generator
) -> Array:
    """Return patches (patch, v, u, y, x, c) of random places, each in a random symmetry."""
    views_v, views_u, height, width, _ = light_field.shape
    corners = rng.integers(0, (height - size[0] + 1, width - size[1] + 1), (count, 2))
    square = views_v == views_u and size[0] == size[1]
    return cut_patches(light_field, corners, rng.integers(8 if square else 4, size=count), size)

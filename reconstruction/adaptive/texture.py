"""The texture of known surfaces: its fit to the frames, and what lies behind the nearest ones."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.adaptive.rays import Surfaces

Array = NDArray[np.floating]


def conjugate_gradients(
    apply: Callable[[Array], Array], rhs: Array, steps: int, rtol: float = 1e-5
) -> Array:
    """Return the solution of apply(x) = rhs from x = 0, apply symmetric and positive definite."""
    x = np.zeros_like(rhs)
    residual = rhs.copy()
    direction = residual.copy()
    square = float(np.vdot(residual, residual))
    first = square
    for _ in range(steps):
        if square <= rtol**2 * first or square == 0:
            break
        applied = apply(direction)
        step = np.float32(square / float(np.vdot(direction, applied)))
        x += step * direction
        residual -= step * applied
        before, square = square, float(np.vdot(residual, residual))
        direction *= np.float32(square / before)
        direction += residual
    return x


def fitted(
    surfaces: Surfaces,
    frames: Array,
    precision: Array,
    prior: Array,
    sigma: float,
    steps: int,
) -> Array:
    """Return the texture (layer, c, y, x) near `prior`, deviation sigma, that explains the frames.

    The minimiser of 1/2 |S^-1/2 (Psi W T - I)|^2 + |T - prior|^2 / (2 sigma^2), S the variance of
    each reading: the mean of T given the frames, if its prior is Gaussian.

    precision: (shot, pixel_y, pixel_x), the inverse variance of each reading, 0 to leave it out.
    """
    ridge = np.float32(1 / sigma**2)
    rhs = surfaces.adjoint(precision * (frames - surfaces.forward(prior)))

    def normal(textures: Array) -> Array:
        return surfaces.adjoint(precision * surfaces.forward(textures)) + ridge * textures

    return prior + conjugate_gradients(normal, rhs, steps)


def background(front: Array, centre: Array, nearer: int, reach: int) -> Array:
    """Return the texture (c, y, x) behind the nearest surfaces: the further ones', continued.

    front: texture of the centre view. centre: its disparity (y, x). reach: samples that surfaces
    may hide.
    """
    depth = nearer * centre
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    furthest = cv2.erode(depth, kernel)
    known = (depth - furthest < 0.3).astype(np.float32)
    filled = front * known
    have = known.copy()
    for width in (1.5, 3.0, 6.0, 12.0, 24.0):
        missing = have < 1e-3
        if not missing.any():
            break
        share = cv2.GaussianBlur(known, (0, 0), width)
        for c in range(len(front)):
            blurred = cv2.GaussianBlur(front[c] * known, (0, 0), width)
            filled[c][missing] = (blurred / np.maximum(share, 1e-6))[missing]
        have = np.where(missing, share, have)
    empty = have < 1e-3
    filled[:, empty] = front[:, empty]
    return filled

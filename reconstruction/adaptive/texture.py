"""The texture of known surfaces, fitted to the frames."""

from __future__ import annotations

from collections.abc import Callable

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
        # Not x += ...: pyright follows what a loop rebinds, here for 12 s.
        np.add(x, step * direction, out=x)
        np.subtract(residual, step * applied, out=residual)
        before, square = square, float(np.vdot(residual, residual))
        np.multiply(direction, np.float32(square / before), out=direction)
        np.add(direction, residual, out=direction)
    return x


def fitted(
    surfaces: Surfaces,
    frames: Array,
    precision: Array,
    prior: Array,
    sigma: float,
    steps: int,
) -> Array:
    """Return the texture (c, y, x) near `prior`, deviation sigma, that explains the frames.

    The minimiser of 1/2 |S^-1/2 (Psi W T - I)|^2 + |T - prior|^2 / (2 sigma^2), S the variance of
    each reading: the mean of T given the frames, if its prior is Gaussian.

    precision: (shot, pixel_y, pixel_x), the inverse variance of each reading, 0 to leave it out.
    """
    ridge = np.float32(1 / sigma**2)
    rhs = surfaces.adjoint(precision * (frames - surfaces.forward(prior)))

    def normal(textures: Array) -> Array:
        return surfaces.adjoint(precision * surfaces.forward(textures)) + ridge * textures

    return prior + conjugate_gradients(normal, rhs, steps)

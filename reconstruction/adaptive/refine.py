"""Fit the texture of known surfaces to the frames, and sharpen their disparity per pixel.

The latter is one Gauss-Newton step on what the texture misses. With the texture known to a
deviation sigma, the residual of the frames has the variance of the noise plus sigma^2 |row of
Psi|^2; its change with the disparity is the texture's slope seen along the ray. Disparities of
neighbours are Laplace distributed (reweighted squares keep edges).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from reconstruction.adaptive.rays import Surfaces

Array = NDArray[np.floating]
EVEN_PX = 0.02
"""Differences below count as none, when the squares are reweighted. 2x +0.01, 0.5x -0.02 dB."""
TRUSTED_STEP_PX = 0.25
"""Largest step, and the deviation that one is expected to have. 2x +0.02, 0.5x -0.01 dB."""


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


def slopes(texture: Array) -> Array:
    """Return the derivatives (2, c, y, x) along y and x of a texture (c, y, x)."""
    return np.stack([np.gradient(texture, axis=1), np.gradient(texture, axis=2)])


def _smoothness(centre: Array, slope_px: float) -> tuple[Array, Array]:
    """Return the weights of squared differences along y and x, for the Laplace prior."""
    return tuple(
        (1 / (slope_px * np.sqrt(np.square(np.diff(centre, axis=axis)) + EVEN_PX**2))).astype(
            np.float32
        )
        for axis in (0, 1)
    )  # type: ignore[return-value]


def _roughness(weights: tuple[Array, Array], field: Array) -> Array:
    """Return the gradient of half the weighted squared differences of a field (y, x)."""
    out = np.zeros_like(field)
    down = weights[0] * np.diff(field, axis=0)
    right = weights[1] * np.diff(field, axis=1)
    out[1:] += down
    out[:-1] -= down
    out[:, 1:] += right
    out[:, :-1] -= right
    return out


def refined(
    surfaces: Surfaces,
    centre: Array,
    texture: Array,
    residual: Array,
    precision: Array,
    slope_px: float = 0.1,
    steps: int = 8,
) -> Array:
    """Return the padded disparity (y, x) of the centre view after one step.

    texture: (c, y, x) of the centre view, padded. residual: the frames less what the texture
    explains; precision: inverse variance of it, both (shot, pixel_y, pixel_x).
    """
    spread, gather = surfaces.derivative(slopes(texture))
    weights = _smoothness(centre, slope_px)
    ridge = np.float32(1 / TRUSTED_STEP_PX**2)

    def normal(change: Array) -> Array:
        return gather(precision * spread(change)) + _roughness(weights, change) + ridge * change

    rhs = gather(precision * residual) - _roughness(weights, centre)
    step = conjugate_gradients(normal, rhs, steps)
    return centre + np.clip(step, -TRUSTED_STEP_PX, TRUSTED_STEP_PX)

"""Fit the texture of known surfaces to the frames, and sharpen their disparity per pixel.

The latter is one Gauss-Newton step on what the texture misses. With the texture known to a
deviation sigma, the residual of the frames has the variance of the noise plus sigma^2 |row of
Psi|^2; its change with the disparity is the texture's slope seen along the ray. Disparities of
neighbours are Laplace distributed (reweighted squares keep edges).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.bands import in_bands
from emmc_rig.model.compiling import njit
from emmc_rig.reconstruction.adaptive.rays import Surfaces

Array = NDArray[np.floating]
EVEN_PX = 0.02
"""Differences below count as none, when the squares are reweighted. 2x +0.01, 0.5x -0.02 dB."""
TRUSTED_STEP_PX = 0.25
"""Largest step, and the deviation that one is expected to have. 2x +0.02, 0.5x -0.01 dB."""


@njit(cache=True, fastmath=True, nogil=True)
def _applied(sums, direction, residual, ridge, first, last, products):
    """Set sums[0] (row, x) to ridge * direction - sums[0] - sums[1], the operator's product q.

    products: (row, 4), set to d.q, r.q, q.q and r.r of direction d and residual r.
    """
    for row in range(first, last):
        product_row, other, along, left = sums[0, row], sums[1, row], direction[row], residual[row]
        dq, rq, qq, rr = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        for x in range(along.size):
            product = ridge * along[x] - product_row[x] - other[x]
            product_row[x] = product
            dq += product * along[x]
            rq += product * left[x]
            qq += product * product
            rr += left[x] * left[x]
        products[row, 0], products[row, 1], products[row, 2], products[row, 3] = dq, rq, qq, rr


@njit(cache=True, fastmath=True, nogil=True)
def _stepped(sums, direction, residual, solution, step, turn, first, last):
    """Take a step along the direction (row, x), turn it, and clear the sums."""
    for row in range(first, last):
        product, other, along = sums[0, row], sums[1, row], direction[row]
        left, found = residual[row], solution[row]
        for x in range(along.size):
            found[x] += step * along[x]
            left[x] -= step * product[x]
            along[x] = left[x] + turn * along[x]
            product[x] = 0
            other[x] = 0


def conjugate_gradients(
    subtract: Callable[[Array, Array], None],
    ridge: float,
    rhs: Array,
    steps: int,
    rtol: float = 1e-5,
) -> Array:
    """Return the solution x of A(x) + ridge x = rhs, (..., y, x), from x = 0.

        q = A(d) + ridge d,   a = r.r / d.q,   r' = r - a q
        x = x + a d,          d = r' + (r'.r' / r.r) d

    r'.r' = r.r - 2 a r.q + a^2 q.q follows from the products of this step, so that a step is two
    passes over memory: q and its products (`_applied`), then all updates (`_stepped`).

    A, symmetric and positive semidefinite, is given by subtract(d, sums), which subtracts A(d) from
    the sum of sums[0] and sums[1], both of d's shape. Stops after `steps`, or when |r| is rtol of
    |rhs|.
    """
    sums = np.zeros((2, *rhs.shape), dtype=np.float32)
    solution, residual, direction = np.zeros_like(rhs), rhs.copy(), rhs.copy()
    moved = [part.reshape(-1, rhs.shape[-1]) for part in (direction, residual, solution)]
    by_row = sums.reshape(2, -1, rhs.shape[-1])
    products = np.empty((by_row.shape[1], 4), dtype=np.float32)

    def apply(_: int, begin: int, end: int) -> None:
        _applied(by_row, *moved[:2], np.float32(ridge), begin, end, products)

    first = after = float(np.vdot(rhs, rhs))
    for _ in range(steps):
        if after <= rtol**2 * first:
            break
        subtract(direction, sums)
        in_bands(apply, len(products))
        dq, rq, qq, square = products.sum(axis=0, dtype=np.float64)
        step = square / dq
        after = max(square - 2 * step * rq + step**2 * qq, 0.0)
        by = np.float32(step), np.float32(after / square)

        def move(_: int, begin: int, end: int, by: tuple[Any, Any] = by) -> None:
            _stepped(by_row, *moved, *by, begin, end)

        in_bands(move, len(products))
    return solution


@dataclass(frozen=True, eq=False)
class Seen:
    """Frames of a texture through surfaces.

    Attributes:
        surfaces: Psi of the surfaces.
        frames: (shot, pixel_y, pixel_x).
        precision: inverse variance of the readings, 0 to leave one out, of this shape.
    """

    surfaces: Surfaces
    frames: Array
    precision: Array


def fitted(
    surfaces: Surfaces,
    frames: Array,
    precision: Array,
    prior: Array,
    sigma: float,
    steps: int,
    earlier: Sequence[Seen] = (),
) -> Array:
    """Return the texture (c, y, x) near `prior`, deviation sigma, that explains the frames.

    The minimiser of 1/2 |S^-1/2 (Psi W T - I)|^2 + |T - prior|^2 / (2 sigma^2), S the variance of
    each reading: the mean of T given the frames, if its prior is Gaussian.

    precision: (shot, pixel_y, pixel_x), the inverse variance of each reading, 0 to leave it out.
    earlier: what other times saw of the same texture.
    """
    all_seen = [Seen(surfaces, frames, precision), *earlier]
    dark = [np.zeros_like(seen.frames) for seen in all_seen]

    def subtract(texture: Array, sums: Array) -> None:
        for seen, nothing in zip(all_seen, dark, strict=True):
            seen.surfaces.add_missed(texture, nothing, seen.precision, sums)

    missed = surfaces.missed(prior, frames, precision)
    for seen in earlier:
        missed += seen.surfaces.missed(prior, seen.frames, seen.precision)
    return prior + conjugate_gradients(subtract, 1 / sigma**2, missed, steps)


def slopes(texture: Array) -> Array:
    """Return the derivatives (2, c, y, x) along y and x of a texture (c, y, x)."""
    return np.stack([np.gradient(texture, axis=1), np.gradient(texture, axis=2)])


def _smoothness(centre: Array, slope_px: float) -> tuple[Array, Array]:
    """Return the weights of squared differences along y and x, for the Laplace prior.

    w = 1 / (slope_px sqrt(t^2 + EVEN_PX^2)) for a difference t: then w t^2 is about |t| / slope_px.
    """
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
    """Return the padded disparity (y, x) of the centre view after one Gauss-Newton step.

    With the derivative J of the frames by the disparity d, the residual r, its variance S, and the
    roughness R of squared differences with the weights of `_smoothness`, the step x solves

        (J^T S^-1 J + R + 1 / TRUSTED_STEP_PX^2) x = J^T S^-1 r - R d,

    clipped to TRUSTED_STEP_PX.

    texture: (c, y, x) of the centre view, padded. residual: the frames less what the texture
    explains; precision: inverse variance of it, both (shot, pixel_y, pixel_x).
    """
    changes = surfaces.derivative(slopes(texture))
    weights, nothing = _smoothness(centre, slope_px), np.zeros_like(residual)

    def subtract(change: Array, sums: Array) -> None:
        changes.add_missed(change, nothing, precision, sums)
        sums[0, 0] -= _roughness(weights, change[0])

    rhs = changes.missed(np.zeros_like(centre)[None], residual, precision)
    rhs[0] -= _roughness(weights, centre)
    step = conjugate_gradients(subtract, 1 / TRUSTED_STEP_PX**2, rhs, steps)[0]
    return centre + np.clip(step, -TRUSTED_STEP_PX, TRUSTED_STEP_PX)

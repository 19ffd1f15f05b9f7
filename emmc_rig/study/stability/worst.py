"""The perturbation of the frames, no larger than the noise, that changes a reconstruction most.

A method is a black box f, so its Jacobian J is seen by finite differences alone: J z = f(y + s z) -
f(y), s the noise's deviation. What a pixel does stays near it; the picture is cut into tiles, and
every tile looks for its own worst direction at once, from the same few reconstructions. In each
round a tile draws directions beside its best so far and takes, of their span, the one whose change
in the tile is largest: the leading eigenvector of the Gram matrix of the changes (Rayleigh-Ritz;
with the best carried over, a power iteration by blocks: Saad 2011, Numerical Methods for Large
Eigenvalue Problems, section 5.2). Last, every tile takes the sign that errs more.

Every tile's perturbation has the norm that noise is expected to have there: what is lost against
noise of that size is lost to its direction. It is a lower bound of the worst there is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Solve = Callable[[Array], Array]
"""Readings (shot, y, x) to a light field (v, u, y, x, c)."""
TILE_PX = 8
DIRECTIONS, ROUNDS = 6, 2
"""New directions in a round: ROUNDS (DIRECTIONS + 1) + 3 reconstructions in all."""


@dataclass(frozen=True, eq=False)
class Worst:
    """perturbation: (shot, y, x), in readings. random: noise of the same norm, likewise.

    gain: norm of the change by the perturbation over that by the noise.
    """

    perturbation: Array
    random: Array
    gain: float


def worst_perturbation(
    solve: Solve,
    readings: Array,
    deviation: Array,
    truth: Array,
    rng: np.random.Generator,
    rounds: int = ROUNDS,
) -> Worst:
    """Return what harms a method most, of the noise's size.

    readings, deviation: (shot, y, x), free of noise, and the noise's. truth: the light field.
    """
    base = solve(readings)
    tiles = list(_tiles(readings.shape[1:]))

    def drawn() -> Array:
        return _normed(rng.standard_normal(readings.shape), tiles)

    random = drawn()
    noisy = float(np.linalg.norm(solve(readings + deviation * random) - base))
    best = random
    for _ in range(rounds):
        directions = [best, *(drawn() for _ in range(DIRECTIONS))]
        changes = [solve(readings + deviation * z) - base for z in directions]
        best = _normed(_leading(directions, changes, tiles), tiles)
    errors = [np.square(solve(readings + sign * deviation * best) - truth) for sign in (1, -1)]
    for tile in tiles:
        if errors[1][:, :, *tile].sum() > errors[0][:, :, *tile].sum():
            best[:, *tile] *= -1
    changed = float(np.linalg.norm(solve(readings + deviation * best) - base))
    return Worst(deviation * best, deviation * random, changed / max(noisy, 1e-12))


def _tiles(size: tuple[int, ...]) -> Iterator[tuple[slice, slice]]:
    """Yield rows and columns of the tiles of a picture; the last ones may be smaller."""
    for top in range(0, size[0], TILE_PX):
        for left in range(0, size[1], TILE_PX):
            yield slice(top, top + TILE_PX), slice(left, left + TILE_PX)


def _normed(direction: Array, tiles: list[tuple[slice, slice]]) -> Array:
    """Return a direction whose norm in every tile is the root of its count of readings."""
    normed = np.array(direction, dtype=np.float64)
    for tile in tiles:
        part = normed[:, *tile]
        part *= (part.size**0.5) / max(float(np.linalg.norm(part)), 1e-12)
    return normed


def _leading(
    directions: Sequence[Array], changes: Sequence[Array], tiles: Sequence[tuple[slice, slice]]
) -> Array:
    """Return, tile by tile, the sum of directions that changes the tile most for its norm."""
    found = np.empty_like(directions[0])
    for tile in tiles:
        across = np.stack([one[:, *tile].ravel() for one in directions])
        moved = np.stack([one[:, :, *tile].ravel() for one in changes]).astype(np.float64)
        basis, mix = np.linalg.qr(across.T)
        # A direction is a sum of the basis, mix says which; a change is that of their changes.
        turned = np.linalg.solve(mix.T + 1e-9 * np.eye(len(mix)), moved)
        leading = np.linalg.eigh(turned @ turned.T)[1][:, -1]
        found[:, *tile] = (basis @ leading).reshape(found[:, *tile].shape)
    return found


def confined(perturbation: Array, side_px: int) -> tuple[Array, tuple[slice, slice]]:
    """Return a perturbation (shot, y, x) within a square in the middle alone, and the square."""
    square = tuple(slice((n - side_px) // 2, (n + side_px) // 2) for n in perturbation.shape[1:])
    kept = np.zeros_like(perturbation)
    kept[:, *square] = perturbation[:, *square]
    return kept, (square[0], square[1])

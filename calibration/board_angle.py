"""How uneven the white board is over the directions into the aperture, from the board turned.

What the camera lets through of a view stays when the board is turned by 90 degrees; what the board
sends into it turns. With the board's radiance 1 + sum_k c_k t_k(u, v), t the gradients and the
saddles over the aperture, the same open whiteboard after the turn reads
sum_j psi_j (1 + sum_k c_k (t_k(turned u_j) - t_k(u_j))): linear in c, and the views' shadows show
the terms apart. What no turn changes, a board brighter in the middle than at the rim of the
aperture, stays in Psi.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.choice import white_by_view
from calibration.whiteboard import Calibration
from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]
SIGNIFICANT = 4.0
LEAST_UNEVENNESS = 1e-3
ROUNDS = 4
CLIP = 4.0
SAMPLED = 500_000
"""Pixels at most: of more the board's unevenness is known to 1e-5."""


@dataclass(frozen=True, eq=False)
class BoardAngle:
    """The board's radiance into every view, (v, u), mean 1, and its relative deviation."""

    radiance: NDArray[np.float64]
    deviation: NDArray[np.float64]
    significance: float

    @property
    def uneven(self) -> bool:
        """Whether the board is uneven beyond its deviation, and enough to matter."""
        return self.significance > SIGNIFICANT and float(np.ptp(self.radiance)) > LEAST_UNEVENNESS


def _terms(views: tuple[int, int], turn_deg: float) -> NDArray[np.float64]:
    """Return the gradients and saddles over the aperture of a board turned so, (term, v, u)."""
    v, u = (np.linspace(-1, 1, count) if count > 1 else np.zeros(1) for count in views)
    turn = np.deg2rad(turn_deg)
    down = np.cos(turn) * v[:, None] - np.sin(turn) * u
    across = np.sin(turn) * v[:, None] + np.cos(turn) * u
    return np.stack([across, down, across**2 - down**2, across * down])


def board_over_angle(psi: ImagingMatrix, turned: Mapping[float, Board]) -> BoardAngle:
    """Return the board's radiance from open whiteboards by the degrees it was turned.

    psi: as measured with the board not turned.
    """
    views = psi.light_field_shape[:2]
    upright = _terms(views, 0.0)
    size = len(upright)
    matrix, right = np.zeros((size, size)), np.zeros(size)
    squares = count = 0.0
    for turn_deg, board in turned.items():
        change = _terms(views, turn_deg) - upright
        use = np.flatnonzero(board.usable)
        if len(use) > SAMPLED:
            use = np.sort(np.random.default_rng(0).choice(use, SAMPLED, replace=False))
        seen = board.channels.ravel()[use]
        by_view = np.stack([one.ravel()[use] for one in white_by_view(psi, board.shot)], axis=1)
        even = by_view.sum(axis=1)
        levels = [np.where(seen == c, even, 0) for c in np.unique(seen)]
        columns = np.column_stack([by_view @ change.reshape(size, -1).T, *levels])
        deviation = np.sqrt(board.variance.ravel()[use].astype(np.float64))
        scaled, value = columns / deviation[:, None], board.reading.ravel()[use] / deviation
        weight = np.ones(len(value))
        left = value
        for _ in range(ROUNDS):
            normal = scaled.T @ (scaled * weight[:, None])
            solution = np.linalg.solve(normal, scaled.T @ (weight * value))
            left = value - scaled @ solution
            limit = CLIP * 1.4826 * float(np.median(np.abs(left)))
            weight = (np.abs(left) < limit).astype(np.float64)
        squares += float((weight * left**2).sum())
        count += float(weight.sum())
        # The levels of the colours are free: what is left determines the terms.
        inside, outside = slice(0, size), slice(size, None)
        solved = np.linalg.solve(normal[outside, outside], normal[outside, inside])
        matrix += normal[inside, inside] - normal[inside, outside] @ solved
        projected = scaled.T @ (weight * value)
        right += projected[inside] - solved.T @ projected[outside]
    found = np.linalg.solve(matrix, right)
    covariance = np.linalg.inv(matrix) * max(squares / max(count, 1.0), 1.0)
    radiance = 1 + np.tensordot(found, upright, 1)
    deviation = np.sqrt(np.einsum("kvu,kl,lvu->vu", upright, covariance, upright))
    significance = float(np.sqrt(found @ np.linalg.solve(covariance, found) / size))
    return BoardAngle(radiance / radiance.mean(), deviation, significance)


def take_out(board: BoardAngle, known: Calibration) -> None:
    """Make a calibration what an even board would have given."""
    weights, deviation = known.psi.weights, known.deviation
    for shot, v, u in np.ndindex(*weights.shape[:3]):
        radiance = board.radiance[v, u]
        even = weights[shot, v, u] / radiance
        spread = np.square(deviation[shot, v, u] / radiance)
        spread += np.square(even * (board.deviation[v, u] / radiance))
        weights[shot, v, u], deviation[shot, v, u] = even, np.sqrt(spread)

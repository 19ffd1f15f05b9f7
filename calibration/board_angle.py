"""How uneven the white board is over the directions into the aperture, from the board turned.

What the camera lets through of a view stays when the board is turned by 90 degrees; what the board
sends into it turns. With the board's radiance 1 + sum_k c_k t_k(u, v), t the gradients and the
saddles over the aperture, the same open whiteboard after the turn reads
sum_j psi_j (1 + sum_k c_k (t_k(turned u_j) - t_k(u_j))): linear in c, and the views' shadows tell
the terms apart. What no turn changes, a board brighter in the middle than at the rim of the
aperture, stays in Psi.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.whiteboard import Calibration
from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]
SIGNIFICANT = 4.0
LEAST_UNEVENNESS = 1e-3
ROUNDS = 4
CLIP = 4.0


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
        white = np.ones(psi.light_field_shape, dtype=psi.weights.dtype)
        even = psi.forward(white)[board.shot].astype(np.float64)
        parts = [
            psi.forward(white * term[:, :, None, None, None].astype(white.dtype))[board.shot]
            for term in change
        ]
        channels = np.unique(board.channels)
        levels = [np.where(board.channels == c, even, 0) for c in channels]
        use = board.usable
        columns = np.stack([*(part[use] for part in parts), *(one[use] for one in levels)], axis=1)
        deviation = np.sqrt(board.variance[use].astype(np.float64))
        scaled, value = columns / deviation[:, None], board.reading[use] / deviation
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
        # The levels of the colours are free: what is left tells the terms.
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


def without(board: BoardAngle, known: Calibration) -> Calibration:
    """Return a calibration as an even board would have given it."""
    even = (1 / board.radiance)[None, :, :, None, None, None].astype(np.float32)
    relative = (board.deviation / board.radiance)[None, :, :, None, None, None]
    weights = known.psi.weights * even
    deviation = np.sqrt(np.square(known.deviation * even) + np.square(weights * relative))
    psi = replace(known.psi, weights=weights)
    return replace(known, psi=psi, deviation=deviation.astype(np.float32))

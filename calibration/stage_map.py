"""The mask stage as the sensor sees it: scale, rotation, orthogonality, repeatability.

Every whiteboard shows where its mask stood, by the fitted shadow, to thousandths of a pixel. Those
places are a linear map of the positions commanded; all are approached from one side, so that
backlash does not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.errors import CalibrationError
from calibration.placement import Placement
from calibration.shadow import Shadow, ShadowMask
from emmc_rig.model.blas import one_blas_thread

Array = NDArray[np.floating]
FEWEST = 8
PIXELS = 20_000
CONVERGED_UM = 1e-4


@dataclass(frozen=True)
class Place:
    """Where a whiteboard's mask stood beyond what the placement says, um, and how sure."""

    x_um: float
    y_um: float
    deviation_um: float


def locate(board: Board, mask: ShadowMask, placement: Placement, seed: int = 0) -> Place:
    """Return where the mask stood on one whiteboard, from the placement's offset, (x, y).

    The board's own `stage_um` is where to begin; brightness is free. Good for moves within half
    a cell of that.
    """
    rng = np.random.default_rng(seed)
    chosen = np.flatnonzero(board.usable)
    if len(chosen) > PIXELS:
        chosen = np.sort(rng.choice(chosen, PIXELS, replace=False))
    pixels = np.stack(np.unravel_index(chosen, board.reading.shape), axis=1)
    channels = board.channels.ravel()[chosen]
    deviation = np.sqrt(board.variance.ravel()[chosen].astype(np.float64))
    reading = board.reading.ravel()[chosen].astype(np.float64)
    shadow = Shadow(mask, placement)
    at = np.array(board.stage_um, dtype=np.float64)
    covariance = np.eye(3)
    for _ in range(12):
        fitted, slopes = shadow.with_slopes(
            pixels, channels, board.views_open, (float(at[0]), float(at[1])), board.shot
        )
        rows = np.stack([slopes[:, 0], slopes[:, 1], fitted], axis=1) / deviation[:, None]
        residual = (reading - fitted) / deviation
        spread = max(1.0, 1.4826 * float(np.median(np.abs(residual))))
        weight = np.clip(1 - (residual / (4.685 * spread)) ** 2, 0, None) ** 2
        matrix = rows.T @ (rows * weight[:, None])
        step = np.linalg.solve(matrix, rows.T @ (weight * residual))
        at += np.clip(step[:2], -0.5 * mask.cell_um, 0.5 * mask.cell_um)
        covariance = np.linalg.inv(matrix) * spread**2
        if np.abs(step[:2]).max() < CONVERGED_UM:
            break
    return Place(float(at[0]), float(at[1]), float(np.sqrt(np.diag(covariance)[:2].max())))


@dataclass(frozen=True, eq=False)
class StageMap:
    """What the stage really does.

    matrix: (2, 2), from commanded to real moves, x and y. repeatability_um: of one approach, x
    and y. residual_um: (place, 2), what the map leaves of each place.
    """

    matrix: NDArray[np.float64]
    offset_um: tuple[float, float]
    repeatability_um: tuple[float, float]
    deviations: dict[str, float]
    residual_um: NDArray[np.float64]

    @property
    def scale(self) -> tuple[float, float]:
        """Real over commanded length of a move along x and along y."""
        return tuple(float(np.hypot(*self.matrix[:, axis])) for axis in (0, 1))  # type: ignore

    @property
    def rotation_deg(self) -> float:
        """Of the stage's x axis against the sensor's."""
        return float(np.degrees(np.arctan2(self.matrix[1, 0], self.matrix[0, 0])))

    @property
    def orthogonality_deg(self) -> float:
        """Angle between the axes less 90 degrees."""
        y_axis = np.degrees(np.arctan2(self.matrix[1, 1], self.matrix[0, 1]))
        return float(y_axis - self.rotation_deg - 90)

    def rows(self) -> list[tuple[str, float, float, str]]:
        """Return (quantity, value, standard deviation, unit) for a table."""
        values = {
            "Scale, x": (self.scale[0], "scale_x", ""),
            "Scale, y": (self.scale[1], "scale_y", ""),
            "Rotation": (self.rotation_deg, "rotation_deg", "degrees"),
            "Orthogonality": (self.orthogonality_deg, "orthogonality_deg", "degrees off 90"),
            "Repeatability, x": (self.repeatability_um[0], "repeatability_x_um", "um"),
            "Repeatability, y": (self.repeatability_um[1], "repeatability_y_um", "um"),
        }
        return [
            (name, value, self.deviations[key], unit) for name, (value, key, unit) in values.items()
        ]


@one_blas_thread()
def stage_map(commanded_um: Sequence[tuple[float, float]], places: Sequence[Place]) -> StageMap:
    """Return the map from where the stage was sent to where the mask stood.

    Raises CalibrationError for too few moves, and moves along one line.
    """
    commanded = np.array(commanded_um, dtype=np.float64)
    real = np.array([(place.x_um, place.y_um) for place in places])
    if len(commanded) < FEWEST:
        raise CalibrationError(
            f"{len(commanded)} stage positions: the stage map needs {FEWEST - len(commanded)} more"
        )
    rows = np.column_stack([commanded, np.ones(len(commanded))])
    scale = np.array([max(np.ptp(commanded[:, 0]), 1e-9), max(np.ptp(commanded[:, 1]), 1e-9), 1])
    if np.linalg.matrix_rank(rows / scale, tol=1e-6) < 3:
        raise CalibrationError("the stage positions lie on one line: move along x and along y")
    found = np.asarray(np.linalg.lstsq(rows, real, rcond=None)[0], np.float64)
    left = real - rows @ found
    variance = np.square(left).sum(axis=0) / max(len(left) - 3, 1)
    covariances = [np.linalg.inv(rows.T @ rows) * one for one in variance]
    spread_x, spread_y = (float(one) for one in np.sqrt(variance))
    return StageMap(
        np.asarray(found[:2].T, np.float64),
        (float(found[2, 0]), float(found[2, 1])),
        (spread_x, spread_y),
        _deviations(covariances, (spread_x, spread_y), len(commanded)),
        left,
    )


def _deviations(
    covariances: Sequence[NDArray[np.float64]], spread: Sequence[float], count: int
) -> dict[str, float]:
    """Return standard deviations by first order around a map that is nearly the identity."""
    along_x, along_y = covariances
    turn = np.degrees(np.sqrt([along_y[0, 0], along_x[1, 1]]))
    freedom = np.sqrt(2 * max(count - 4, 1))
    return {
        "scale_x": float(np.sqrt(along_x[0, 0])),
        "scale_y": float(np.sqrt(along_y[1, 1])),
        "rotation_deg": float(turn[0]),
        "orthogonality_deg": float(np.hypot(*turn)),
        "repeatability_x_um": spread[0] / freedom,
        "repeatability_y_um": spread[1] / freedom,
    }

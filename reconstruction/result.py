"""What every reconstruction returns: the light field, how it went, and how long it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray


class Status(StrEnum):
    """How a reconstruction ended; a result's `advice` says what to do about all but the first.

    CONVERGED: changes became small. STEP_LIMIT: steps ended before. INCOMPLETE: a part failed or is
    missing. IN_TILES: computed in tiles, some of which did not converge.
    """

    CONVERGED = "converged"
    STEP_LIMIT = "step limit reached"
    INCOMPLETE = "incomplete"
    IN_TILES = "in tiles"


@dataclass(frozen=True)
class Progress:
    """One step of a solver, as given to `on_step`; None where not evaluated or not known.

    total: steps there will be.
    """

    step: int
    relative_change: float | None
    objective: float | None
    total: int | None = None


@dataclass(frozen=True)
class Reconstruction:
    """What a method returns: the light field, how the solver ended, and its figures.

    method: the method's name. light_field: (v, u, y, x, c) float32, linear RGB in [0, 1].
    status: how the solver ended. advice: what to do about it; empty when converged.
    steps: number of steps. objective: pairs (step, value of the objective).
    seconds: without compiling_seconds, in which kernels were compiled or loaded.
    parameters: figures that the solver chose or was given, by name.
    maps: further estimates by name, such as `disparity` (y, x) in pixels per view step and `sigma`
    (v, u, y, x).
    screening: corrections of the frames before, in words.
    film: for a frame of a film, the state from which the next frame continues.
    measured: which views (v, u) the readings contain; None: all. Other views follow from their
    neighbours, and no figure of accuracy counts them.
    """

    method: str
    light_field: NDArray[np.float32]
    status: Status
    advice: str
    steps: int
    objective: tuple[tuple[int, float], ...]
    seconds: float
    parameters: dict[str, float]
    maps: Mapping[str, NDArray] = field(default_factory=dict)
    screening: tuple[str, ...] = ()
    film: Any = None
    compiling_seconds: float = 0.0
    measured: NDArray[np.bool_] | None = None

    @property
    def stated(self) -> dict[str, Any]:
        """The PSNR stated, its interval and its worst place, see `stated_figures`."""
        sigma = self.maps.get("sigma")
        if sigma is None:
            return stated_figures(None, self.parameters)
        every = np.ones(sigma.shape[:2], dtype=bool) if self.measured is None else self.measured
        square = square_deviation(sigma, every)
        return stated_figures(float(square.mean()), self.parameters, worst_place(square))

    def without_light_field(self) -> Reconstruction:
        """Return the result with an empty light field and no maps, to keep many."""
        empty = np.empty((0, 0, 0, 0, 3), dtype=np.float32)
        return replace(self, light_field=empty, maps={}, film=None)


TAILS, WITHIN, SCALE = "stated_tails_db", "stated_within_db", "stated_scale_db"
"""Parameters of a result: by how many dB its mean square error exceeds that of its deviation, since
few errors are large; how far the true PSNR is from the one stated, in 9 of 10 captures at most; by
how many dB the square of the deviation was scaled from what held-out readings show."""


PLACE_PX = 24
"""Side of the square whose accuracy is stated apart, right to 6 dB in nine of ten trusted captures
of group B (`benchmarks/stated.py`)."""


class WorstPlace(NamedTuple):
    """A square of PLACE_PX: its mean square deviation, and its middle."""

    variance: float
    row: int
    column: int


def square_deviation(sigma: NDArray[np.floating], views: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the mean square of a deviation (v, u, y, x) over chosen views (v, u), by place."""
    total = np.zeros(sigma.shape[2:])
    for view in zip(*np.nonzero(views), strict=True):
        total += np.square(sigma[view], dtype=np.float64)
    return total / views.sum()


def worst_place(square: NDArray[np.float64]) -> WorstPlace:
    """Return the square of PLACE_PX with the largest mean of a square deviation (y, x)."""
    sides = [min(PLACE_PX, length) for length in square.shape]
    # A window of OpenCV lies about sample `side // 2`; windows that leave the picture are cut off.
    middles = [
        slice(side // 2, length - side + side // 2 + 1)
        for side, length in zip(sides, square.shape, strict=True)
    ]
    within = cv2.blur(square, (sides[1], sides[0]))[*middles]
    row, column = np.unravel_index(int(within.argmax()), within.shape)
    return WorstPlace(
        float(within[row, column]), int(row) + middles[0].start, int(column) + middles[1].start
    )


def stated_figures(
    variance: float | None, parameters: Mapping[str, float], worst: WorstPlace | None = None
) -> dict[str, Any]:
    """Return stated_db and what else metrics.json has of it; None where not stated.

    variance: mean square of the deviation of the light field.
    """
    if variance is None:
        return {"stated_db": None, "stated_interval_db": None}
    tails_db, within = parameters.get(TAILS, 0.0), None
    stated_db = float(-10 * np.log10(variance)) - tails_db
    if WITHIN in parameters:
        within = [stated_db - parameters[WITHIN], stated_db + parameters[WITHIN]]
    figures = {"stated_db": stated_db, "stated_interval_db": within}
    if worst is not None:
        worst_db = float(-10 * np.log10(worst.variance)) - tails_db
        figures |= {"stated_worst_db": worst_db, "stated_worst_at": [worst.row, worst.column]}
    return figures

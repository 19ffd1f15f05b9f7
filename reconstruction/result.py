"""What every reconstruction returns: the light field, how it went, and how long it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Status(StrEnum):
    """How a reconstruction ended; its advice says what to do about all but the first."""

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
    """light_field: (v, u, y, x, c) float32 in [0, 1]; `advice` is empty when converged.

    objective: (step, value) pairs. parameters: what the solver chose or was given. maps: what else
    it found, by name: `disparity` (y, x) in pixels per view step, ... screening: what was
    done to the frames before, in words. film: of a frame of a film, what the next one goes on from.
    seconds: without compiling_seconds, in which kernels were compiled or loaded. measured: which
    views (v, u) the readings say something of; None: all. Others follow from their neighbours, and
    no figure of accuracy counts them.
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
        """The PSNR stated and its interval, see `stated_figures`."""
        sigma = self.maps.get("sigma")
        if sigma is not None and self.measured is not None:
            sigma = sigma[self.measured]
        variance = None if sigma is None else float(np.mean(np.square(sigma, dtype=np.float64)))
        return stated_figures(variance, self.parameters)

    def without_light_field(self) -> Reconstruction:
        """Return the result with an empty light field and no maps, to keep many."""
        empty = np.empty((0, 0, 0, 0, 3), dtype=np.float32)
        return replace(self, light_field=empty, maps={}, film=None)


TAILS, WITHIN, SCALE = "stated_tails_db", "stated_within_db", "stated_scale_db"
"""Parameters of a result: by how many dB its mean square error exceeds that of its deviation, since
few errors are large; how far the true PSNR is from the one stated, in 9 of 10 captures at most; by
how many dB the square of the deviation was scaled from what held-out readings show."""


def stated_figures(variance: float | None, parameters: Mapping[str, float]) -> dict[str, Any]:
    """Return stated_db and stated_interval_db as metrics.json has them; None where not stated.

    variance: mean square of the deviation of the light field.
    """
    if variance is None:
        return {"stated_db": None, "stated_interval_db": None}
    stated_db, within = float(-10 * np.log10(variance)) - parameters.get(TAILS, 0.0), None
    if WITHIN in parameters:
        within = [stated_db - parameters[WITHIN], stated_db + parameters[WITHIN]]
    return {"stated_db": stated_db, "stated_interval_db": within}

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
    done to the frames before, in words.
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

    @property
    def stated_db(self) -> float | None:
        """The PSNR that the deviation of the light field stands for, dB; None without one."""
        sigma = self.maps.get("sigma")
        if sigma is None:
            return None
        return float(-10 * np.log10(np.mean(np.square(sigma, dtype=np.float64))))

    def without_light_field(self) -> Reconstruction:
        """Return the result with an empty light field and no maps, to keep many."""
        empty = np.empty((0, 0, 0, 0, 3), dtype=np.float32)
        return replace(self, light_field=empty, maps={})


BELOW, ABOVE = "stated_below_db", "stated_above_db"
"""Parameters of a result: by how many dB the true PSNR lies below and above the one stated, in 9 of
10 captures at most."""


def stated_figures(stated_db: float | None, parameters: Mapping[str, float]) -> dict[str, Any]:
    """Return a stated PSNR and its interval, as metrics.json has them; None where not stated."""
    interval = None
    if stated_db is not None and BELOW in parameters and ABOVE in parameters:
        interval = [stated_db - parameters[BELOW], stated_db + parameters[ABOVE]]
    return {"stated_db": stated_db, "stated_interval_db": interval}

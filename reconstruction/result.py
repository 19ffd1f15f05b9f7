"""What every reconstruction returns: the light field, how it went, and how long it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

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

    def without_light_field(self) -> Reconstruction:
        """Return the result with an empty light field and no maps, to keep many."""
        empty = np.empty((0, 0, 0, 0, 3), dtype=np.float32)
        return replace(self, light_field=empty, maps={})

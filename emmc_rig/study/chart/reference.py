"""A reference for the machine's speed: the time of a fixed, small reconstruction.

A method's seconds of computing over the yardstick's carry a chart from one machine to another, and
from a busy hour to a quiet one, as far as all slow down alike.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.tv import TVSettings, reconstruct_tv

SIZE, STEPS, REPEATS = (64, 80), 20, 3


@dataclass(frozen=True)
class Reference:
    """Median seconds, by the clock and of all cores together."""

    seconds: float
    cpu_seconds: float


def reference() -> Reference:
    """Return what 20 steps of total variation take on 5x5 views of 64x80 pixels."""
    run = _warm()
    found = []
    for _ in range(REPEATS):
        cpu, wall = time.process_time(), time.perf_counter()
        run()
        found.append((time.perf_counter() - wall, time.process_time() - cpu))
    walls, cpus = zip(*found, strict=True)
    return Reference(statistics.median(walls), statistics.median(cpus))


@lru_cache(maxsize=1)
def _warm() -> Callable[[], object]:
    """Return the reconstruction, run once, which may have compiled."""
    rng = np.random.default_rng(0)
    weights = rng.random((1, 5, 5, SIZE[0], 1, SIZE[1]), dtype=np.float32)
    colour = rng.integers(0, 3, (1, *SIZE), dtype=np.uint8)
    psi = ImagingMatrix(weights, colour, 1)
    frames = rng.random(psi.frames_shape, dtype=np.float32)
    settings = TVSettings(mu=1e-3, max_steps=STEPS, rtol=1e-30)

    def run() -> object:
        return reconstruct_tv(psi, frames, 0.005, settings)

    run()
    return run

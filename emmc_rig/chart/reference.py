"""A yardstick for the machine: the seconds of a fixed, small reconstruction.

Seconds over the yardstick's carry a chart from one machine to another, and from a busy hour to a
quiet one, as far as both slow down alike.
"""

from __future__ import annotations

import numpy as np

from emmc_rig.benchmarks.timing import median_s
from emmc_rig.model.sensing import ImagingMatrix
from reconstruction.tv import TVSettings, reconstruct_tv

SIZE, STEPS, REPEATS = (64, 80), 10, 3


def reference_s() -> float:
    """Return the median seconds of 10 steps of total variation on 5x5 views of 64x80 pixels."""
    rng = np.random.default_rng(0)
    weights = rng.random((1, 5, 5, SIZE[0], 1, SIZE[1]), dtype=np.float32)
    colour = rng.integers(0, 3, (1, *SIZE), dtype=np.uint8)
    psi = ImagingMatrix(weights, colour, 1)
    frames = rng.random(psi.frames_shape, dtype=np.float32)
    settings = TVSettings(mu=1e-3, max_steps=STEPS, rtol=1e-30)
    return median_s(lambda: reconstruct_tv(psi, frames, 0.005, settings), REPEATS)

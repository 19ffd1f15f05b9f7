"""Which method to take for a time: the most accurate that a cost formula says to end in it.

The seconds of a method are those of the method of factor 1 on a window of these frames, on this
machine, times the light field's values over the window's, times the factor of the method, see
`reconstruction.method.Method`. Factors are from the charts docs/results/chart-group-*.csv and
group-b-chart.csv (64x80 and 128x160 views, one and three shots): there they lie within 0.6 and 1.6
times these for any scene, camera and size.
"""

from __future__ import annotations

import numpy as np

from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.reconstruction.methods import METHODS, reconstruct
from emmc_rig.store.results import parse_seconds

FACTORS = {name: method.factor for name, method in METHODS.items() if method.factor is not None}
TIMED = next(name for name, factor in FACTORS.items() if factor == 1)
WINDOW = 96
"""Samples a side of the window that is timed, at most."""


def method_within(psi: ImagingMatrix, frames: Frames, budget: str) -> tuple[str, str]:
    """Return the method for a budget as typed, such as "30s", and why it is, in words.

    Raises WrongUsageError for what is no time, ReconstructionError for frames that do not fit Psi.
    """
    budget_s = parse_seconds(budget, "budget")
    assert budget_s is not None
    unit_s = timed(psi, frames)
    within = [method for method, factor in FACTORS.items() if factor * unit_s <= budget_s]
    choose = max if within else min
    method = choose(within or FACTORS, key=FACTORS.__getitem__)
    why = "the most accurate within" if within else "the quickest: none is done within"
    takes_s = FACTORS[method] * unit_s
    return method, f"{method}: {why} {budget_s:g} s; about {takes_s:.2g} s on this machine"


def timed(psi: ImagingMatrix, frames: Frames) -> float:
    """Return the seconds that TIMED takes for all of the frames, from its time for a window."""
    k, places = psi.binning, []
    for length in psi.size:
        side = min(WINDOW // k * k, length)
        start = (length - side) // 2 // k * k
        places.append(slice(start, start + side))
    part = psi.window(*places)
    pixels = (slice(None), *(slice(at.start // k, at.stop // k) for at in places))
    solved = reconstruct(TIMED, part, frames.cut(pixels))
    return solved.seconds * float(np.prod(psi.size)) / float(np.prod(part.size))

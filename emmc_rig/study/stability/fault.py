"""The class of faults, and the names of their kinds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from emmc_rig.study.trial import Capture, Trial

SEVERAL = 3
"""Shots that a camera is given where a fault needs several."""
SENSOR, MASK, SHOTS = "Light and sensor", "Mask and lens", "Between shots"
SCENE = "Scene"


@dataclass(frozen=True)
class Fault:
    """One way to fail; where a sweep has a strength 0, it is no fault.

    strengths: from harmless to hopeless, in `unit`. quick: those that `--fast` measures.
    repairable: whether better calibration, detection or repair could undo it, rather than physics
    setting the limit. shots: fewest that it takes. whole: whether there is nothing between two
    strengths.
    """

    name: str
    title: str
    unit: str
    strengths: tuple[float, ...]
    quick: tuple[float, ...]
    kind: str
    make: Callable[[Capture, float], Trial]
    repairable: bool = False
    shots: int = 1
    whole: bool = False

    @property
    def explained(self) -> str:
        """What happens, in one sentence."""
        return (self.make.__doc__ or "").strip().partition("\n")[0]

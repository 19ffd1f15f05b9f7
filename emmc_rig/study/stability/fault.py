"""A fault of a capture: its unit, its strengths from harmless to hopeless, and its trial."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from emmc_rig.study.stability.trial import Setup, Trial

SEVERAL = 3
"""Shots that a camera is given where a fault needs several."""


SENSOR, MASK, SHOTS = "Light and sensor", "Mask and lens", "Between shots"
SCENE, DESIGN = "Scene", "Design"


@dataclass(frozen=True)
class Fault:
    """One way to fail.

    strengths: from harmless to hopeless, in `unit`; a sweep is judged on both sides of its best,
    as a design has two ends. quick: those that `--fast` measures. repairable: whether better
    calibration, detection or repair could undo it, rather than physics or the design setting the
    limit. screened: whether screening the frames is meant to help. shots: fewest that it takes.
    whole: whether there is nothing between two strengths. clean: whether strength 0 is no fault.
    """

    name: str
    title: str
    unit: str
    strengths: tuple[float, ...]
    quick: tuple[float, ...]
    kind: str
    make: Callable[[Setup, float], Trial]
    repairable: bool = False
    screened: bool = False
    shots: int = 1
    whole: bool = False
    clean: bool = True

    def is_clean(self, strength: float) -> bool:
        """Whether nothing is wrong at a strength: the trial is then that of any other fault."""
        return self.clean and strength == 0

    @property
    def explained(self) -> str:
        """What happens, in one sentence."""
        return (self.make.__doc__ or "").strip().partition("\n")[0]

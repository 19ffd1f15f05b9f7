"""The rows of a check: figures measured, their targets, and whether they are met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
COVERED, COVERED_TWICE, MARGIN = 0.683, 0.954, 0.03


@dataclass(frozen=True)
class Row:
    """One figure, its target, and whether it is met ("" where there is no target)."""

    what: str
    measured: str
    asked: str = ""
    verdict: str = ""


def target_row(what: str, value: float, limit: float | None, form: str, above: bool = False) -> Row:
    """Return the row of a figure with an upper, or lower, limit as its target (None: no target)."""
    if limit is None:
        return Row(what, format(value, form))
    met = value >= limit if above else value <= limit
    asked = f"{'at least' if above else 'at most'} {limit:{form}}"
    return Row(what, format(value, form), asked, "met" if met else "missed")


def covered(what: str, share: float, asked: float) -> Row:
    """Return the row of a share of coefficients within so many stated deviations."""
    met = abs(share - asked) <= MARGIN
    return Row(what, f"{share:.1%}", f"{asked:.0%} +- {MARGIN:.0%}", "met" if met else "missed")

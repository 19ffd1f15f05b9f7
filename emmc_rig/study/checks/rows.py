"""The rows of a check: what was measured, what was asked, and whether it is met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Row:
    """One target: what, measured, asked, and whether it is met ("" where nothing was asked)."""

    what: str
    measured: str
    asked: str = ""
    verdict: str = ""


def target_row(what: str, value: float, limit: float | None, form: str, above: bool = False) -> Row:
    """Return the row of a figure that is to be at most, or at least, a limit (None: nothing)."""
    if limit is None:
        return Row(what, format(value, form))
    met = value >= limit if above else value <= limit
    asked = f"{'at least' if above else 'at most'} {limit:{form}}"
    return Row(what, format(value, form), asked, "met" if met else "missed")

"""Breaking points of a curve: the strengths between which a method stays above a limit.

A place on a sweep is an index into its strengths, with a fraction between two of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

LOST_DB = 3.0


@dataclass(frozen=True)
class Span:
    """Between which places a curve stays above its limit; None: to the end of the sweep.

    low: towards the harmless end, which is where a design may break too. high: towards the
    hopeless end.
    """

    low: float | None
    high: float | None


def below_best(levels: Sequence[float | None], whole: bool = False) -> Span | None:
    """Return where levels (dB, None where a method failed) fall LOST_DB below their best.

    None where there is no level at all. whole: see `span`.
    """
    known = [level for level in levels if level is not None]
    if not known:
        return None
    return span([None if v is None else v - max(known) + LOST_DB for v in levels], whole)


def below_view(
    levels: Sequence[float | None], views: Sequence[float | None], whole: bool = False
) -> Span | None:
    """Return where levels fall below those of the copied centre view; None: they never exceed it.

    Where the copied view is exact (None or infinite) nothing exceeds it.
    """
    margins = [
        None if level is None or view is None or math.isinf(view) else level - view
        for level, view in zip(levels, views, strict=True)
    ]
    return span(margins, whole)


def span(margins: Sequence[float | None], whole: bool = False) -> Span | None:
    """Return how far around the largest margin the margins stay at 0 or above.

    Crossings are interpolated linearly between the measured places; whole: there is nothing
    between them, so the first one beyond counts. None where no margin reaches 0.
    """
    values = [-math.inf if margin is None else margin for margin in margins]
    start = max(range(len(values)), key=values.__getitem__)
    if not values[start] >= 0:
        return None
    return Span(_crossing(values, start, -1, whole), _crossing(values, start, 1, whole))


def _crossing(values: Sequence[float], start: int, step: int, whole: bool) -> float | None:
    at = start
    while 0 <= at + step < len(values):
        if values[at + step] < 0:
            if whole or math.isinf(values[at + step]):
                return float(at + step)
            return at + step * values[at] / (values[at] - values[at + step])
        at += step
    return None


def strength_at(strengths: Sequence[float], place: float) -> float:
    """Return the strength at a place: geometric between two above 0, else linear."""
    index = min(int(place), len(strengths) - 1)
    part = place - index
    if part == 0:
        return strengths[index]
    first, last = strengths[index], strengths[index + 1]
    if first > 0 and last > 0:
        return first * (last / first) ** part
    return first + (last - first) * part


def span_words(found: Span | None, strengths: Sequence[float]) -> str:
    """Return a span in words, for the table."""
    if found is None:
        return "already at the mildest"
    words = []
    if found.low is not None:
        words.append(f"before {_plain(strength_at(strengths, found.low))}")
    if found.high is not None:
        from_there = _plain(strength_at(strengths, found.high))
        words.append(f"from {from_there}" if words else from_there)
    return ", ".join(words) or "never"


def _plain(strength: float) -> str:
    """Return a strength with two digits and no exponent: 0.042, 12, 340."""
    rounded = float(f"{strength:.2g}")
    return f"{rounded:.0f}" if rounded >= 10 else f"{rounded:g}"

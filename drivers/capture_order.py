"""The order in which files were captured: by the times that they state, else by their names.

Numbers in names count as numbers (2 comes before 10), and a camera's counter that began again
(IMG_9999, IMG_0001) is followed.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise, zip_longest

HIGHEST_NUMBERS = (9_999, 99_999, 999_999)
"""After these the counters of cameras begin again, at 0 or 1."""
DELETED = 10
"""Frames that may be missing at either end of the counter."""


@dataclass(frozen=True)
class CaptureOrder:
    """The places of the files, the first captured first; notes: where names and times differ."""

    places: tuple[int, ...]
    notes: tuple[str, ...] = ()


def capture_order(names: Sequence[str], times: Sequence[datetime | None]) -> CaptureOrder:
    """Return the order of files with these names, and the times that they state or None.

    The times decide where every file states one, and names among equal times. Times with and
    without a time zone are compared as clocks showed them.
    """
    by_name, began_again = _by_name(names)
    named = [names[place] for place in by_name]
    stated = [times[place] for place in by_name]
    known = [(name, at) for name, at in zip(named, stated, strict=True) if at is not None]
    if not all(at.tzinfo for _, at in known):
        known = [(name, at.replace(tzinfo=None)) for name, at in known]
    back = next(((a, b) for a, b in pairwise(known) if b[1] < a[1]), None)
    if back is None and began_again and len(known) == len(names) and known[0][1] < known[-1][1]:
        note = f"{began_again}, by the times that they state: ordered by time, not by name"
        return CaptureOrder(tuple(by_name), (note,))
    notes = [f"{began_again}: the counter in the names began again"] if began_again else []
    if back is None:
        return CaptureOrder(tuple(by_name), tuple(notes))
    (earlier, earlier_at), (later, later_at) = back
    what = f"{later} states a time before {earlier} ({later_at} and {earlier_at})"
    if len(known) < len(names):
        missing = next(name for name, at in zip(named, stated, strict=True) if at is None)
        notes.append(f"{what}, but {missing} states none: ordered by name")
    else:
        ranks = sorted(range(len(known)), key=lambda rank: (known[rank][1], rank))
        return CaptureOrder(
            tuple(by_name[rank] for rank in ranks),
            (f"{what}: ordered by time, not by name",),
        )
    return CaptureOrder(tuple(by_name), tuple(notes))


def natural(name: str) -> list[tuple[int, str]]:
    """Return a key by which the numbers in names sort as numbers."""
    parts = re.split(r"(\d+)", name.lower())
    return [(int(part), "") if place % 2 else (0, part) for place, part in enumerate(parts)]


def _by_name(names: Sequence[str]) -> tuple[list[int], str]:
    """Return the places of names in order, and where a counter began again; "" where none did."""
    places = sorted(range(len(names)), key=lambda place: natural(names[place]))
    keys = [natural(names[place]) for place in places]
    columns = list(zip_longest(*keys))
    differing = [column for column in columns if len(set(column)) > 1]
    if len(differing) != 1 or None in differing[0]:
        return places, ""
    numbers = [part[0] for part in differing[0]]
    highest = next((most for most in HIGHEST_NUMBERS if most >= numbers[-1]), math.inf)
    if numbers[0] > DELETED or numbers[-1] < highest - DELETED:
        return places, ""
    gaps = [later - earlier for earlier, later in pairwise(numbers)]
    widest = max(gaps)
    if 2 * widest <= numbers[-1]:
        return places, ""
    first = gaps.index(widest) + 1
    return places[first:] + places[:first], f"{names[places[0]]} follows {names[places[-1]]}"

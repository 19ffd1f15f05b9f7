"""How sharp the picture is, from two frames in a row, and how that compares with a moment ago.

Noise differs between two frames, edges do not: the product of both frames' differences between
neighbours is the edges' energy alone, which noise neither raises nor, in the dark, imitates.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.raw import RawFrame
from emmc_rig.pages.frame_view import colour_planes

LONGEST_PX = 1024
"""Of the frame's middle, in pixels of one colour."""
CLEAR = 5.0
"""Deviations that edges must lie above nothing, and brightness above black, to count."""
CORRELATED = 2.0
"""On the deviation: a pixel's noise is in the differences to two neighbours along each axis."""
REMEMBERED_S = 60.0


@dataclass(frozen=True)
class Sharpness:
    """Energy of the differences between neighbours over that of the picture, and its deviation."""

    value: float
    deviation: float


def sharpness(now: RawFrame, before: RawFrame) -> Sharpness | None:
    """Return how sharp two frames of the same scene are; None where they do not show it."""
    alike = (now.mosaic.shape, now.cfa, now.exposure_s)
    if alike != (before.mosaic.shape, before.cfa, before.exposure_s):
        return None
    one, other = _plane(now), _plane(before)
    noise = float(np.var(one - other, dtype=np.float64)) / 2
    levels = float(one.mean(dtype=np.float64)), float(other.mean(dtype=np.float64))
    surely_lit = CLEAR * np.sqrt(noise / one.size) + 0.5
    if min(levels) <= surely_lit:
        return None
    energy, variance = 0.0, 0.0
    for axis in (0, 1):
        first, second = np.diff(one, axis=axis), np.diff(other, axis=axis)
        product = float(np.vdot(first, second))
        spread = float(np.mean((first - second) ** 2, dtype=np.float64)) / 2
        energy += product / first.size
        variance += (2 * max(product, 0.0) * spread + first.size * spread**2) / first.size**2
    deviation = CORRELATED * float(np.sqrt(variance))
    if energy <= CLEAR * deviation:
        return None
    power = levels[0] * levels[1]
    return Sharpness(energy / power, deviation / power)


def _plane(frame: RawFrame) -> NDArray[np.float32]:
    """Return the middle of the frame's pixels of one colour, above black."""
    planes = colour_planes(frame)
    plane = planes.get("green", planes.get("grey", []))[0]
    cuts = []
    for length in plane.shape:
        kept = min(length, LONGEST_PX)
        cuts.append(slice((length - kept) // 2, (length - kept) // 2 + kept))
    return plane[tuple(cuts)].astype(np.float32) - np.float32(frame.black_level_dn.mean())


class FocusMeter:
    """The sharpness of frames as they come, against the sharpest of the last minute."""

    def __init__(self) -> None:
        self._before: RawFrame | None = None
        self._seen: deque[tuple[float, Sharpness]] = deque()

    def forget(self) -> None:
        """Compare with nothing seen so far: something else is before the camera.

        May be called by another thread while `add` works: what that looks at is left as it is.
        """
        self._before = None
        self._seen = deque()

    def add(self, frame: RawFrame, now_s: float) -> dict[str, float] | None:
        """Return the share of the best sharpness and its deviation; None where unknown."""
        before, self._before = self._before, frame
        found = None if before is None else sharpness(frame, before)
        seen = self._seen
        while seen and now_s - seen[0][0] > REMEMBERED_S:
            seen.popleft()
        if found is None:
            return None
        seen.append((now_s, found))
        best = max((one for _, one in seen), key=lambda one: one.value)
        share = found.value / best.value
        relative = np.hypot(found.deviation / found.value, best.deviation / best.value)
        return {
            "share": share,
            "deviation": 0.0 if found is best else float(share * relative),
            "value": found.value,
        }

"""How a mask repeats: the shifts after which its shadow looks as before, from its cells alone.

Whatever drew the cells: a tile, waves, stripes, a pattern of a plug-in. Where a mask repeats, its
place is known up to those shifts only.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfftn, next_fast_len, rfftn

Array = NDArray[np.floating]
ALIKE = 0.9
"""Correlation of a mask with itself, shifted, from which on a shadow hardly shows the shift: 0.9
where a twentieth of the cells differ."""
PARALLEL = 0.2
"""Sine of the angle between two shifts, below which one is a multiple of the other."""


@dataclass(frozen=True)
class Repeats:
    """Shifts after which a mask looks as before.

    steps_um: the shortest (x, y), in two directions at most; none where the mask does not repeat.
    uniform: along some direction there is nothing to see, as along stripes.
    """

    steps_um: tuple[tuple[float, float], ...] = ()
    uniform: bool = False

    @property
    def words(self) -> str:
        """The ambiguity of a mask's place in words, "" where the place is unique."""
        if self.uniform:
            return "the mask looks the same all along one direction: its place there is not seen"
        steps = ", ".join(f"({x:.0f}, {y:.0f})" for x, y in self.steps_um)
        return steps and f"the mask repeats every {steps} um: it may be any number of these farther"

    def nearest(self, shift_um: Array) -> NDArray[np.float64]:
        """Return the smallest shift (x, y) that looks like this one."""
        found = np.asarray(shift_um, dtype=np.float64)
        if not self.steps_um:
            return found
        steps = np.array(self.steps_um)
        most = int(np.hypot(*found) / np.hypot(*steps.T).min()) + 2
        counts = np.arange(-most, most + 1)
        grid = np.stack(np.meshgrid(*[counts] * len(steps), indexing="ij"), axis=-1)
        alike = found + grid.reshape(-1, len(steps)) @ steps
        return np.asarray(alike[np.argmin(np.hypot(*alike.T))], dtype=np.float64)


def repeats_of(cells: Array, cell_um: float, reach_um: float) -> Repeats:
    """Return how a mask repeats by shifts up to `reach_um` along either axis.

    cells: (row, column, colour), of the colours that the sensor sees.
    """
    sides = np.array(cells.shape[:2])
    reach = np.minimum(int(reach_um / cell_um), 3 * sides // 4)
    kept = np.minimum(4 * reach + 1, sides)
    first = (sides - kept) // 2
    middle = cells[first[0] : first[0] + kept[0], first[1] : first[1] + kept[1]].astype(np.float64)
    middle = middle - middle.mean(axis=(0, 1))
    energy = (middle**2).sum(axis=-1)
    if not energy.mean() > 1e-9:
        return Repeats(uniform=True)
    ones = np.ones(energy.shape)

    def overlapped(first: Array, second: Array) -> Array:
        rows, columns = (slice(n - 1 - r, n + r) for n, r in zip(kept, reach, strict=True))
        return convolved(first, second[::-1, ::-1])[rows, columns]

    product = sum(overlapped(plane, plane) for plane in np.moveaxis(middle, -1, 0))
    both = overlapped(energy, ones) + overlapped(ones, energy)
    likeness = 2 * product / np.maximum(both, 1e-9)
    alike_enough = (likeness >= ALIKE).astype(np.uint8)
    count, islands = cv2.connectedComponents(alike_enough, connectivity=4)
    own = islands == islands[tuple(reach)]
    if own[0].any() or own[:, 0].any():
        return Repeats(uniform=True)
    peaks = []
    for island in range(1, count):
        at = np.unravel_index(np.argmax(np.where(islands == island, likeness, -1)), own.shape)
        y, x = (
            place + vertex(likeness.T if axis else likeness, at[::-1] if axis else at) - most
            for axis, (place, most) in enumerate(zip(at, reach, strict=True))
        )
        # A shift and its opposite are the same step.
        if (round(y), round(x)) > (0, 0):
            peaks.append((float(x) * cell_um, float(y) * cell_um))
    steps = sorted(peaks, key=lambda step: float(np.hypot(*step)))
    for x, y in steps[1:]:
        first_x, first_y = steps[0]
        area = abs(first_x * y - first_y * x)
        if area > PARALLEL * np.hypot(x, y) * np.hypot(first_x, first_y):
            return Repeats((steps[0], (x, y)))
    return Repeats(tuple(steps[:1]))


def convolved(first: Array, second: Array) -> NDArray[np.float64]:
    """Return the convolution of two arrays (y, x), as large as any of it, by FFT."""
    # As scipy.signal.fftconvolve, which takes half a second to load.
    shape = [a + b - 1 for a, b in zip(first.shape, second.shape, strict=True)]
    fast = [next_fast_len(side, real=True) for side in shape]
    product = rfftn(first, fast) * rfftn(second, fast)
    return np.asarray(irfftn(product, fast)[: shape[0], : shape[1]], np.float64)


def vertex(scores: Array, peak: tuple[np.intp, ...]) -> float:
    """Return where the parabola through a peak along the first axis has its top, from the peak."""
    at, other = int(peak[0]), int(peak[1])
    if at == 0 or at == len(scores) - 1:
        return 0.0
    before, here, after = (float(scores[at + step, other]) for step in (-1, 0, 1))
    bend = before - 2 * here + after
    return 0.0 if bend >= 0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))

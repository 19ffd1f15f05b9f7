"""What to show of a light field: lines of epipolar images, pieces to enlarge."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Piece:
    """A square of a picture to enlarge."""

    y: int
    x: int
    side: int

    def of(self, picture: NDArray) -> NDArray:
        """Cut it out of (y, x, c)."""
        return picture[self.y : self.y + self.side, self.x : self.x + self.side]


def epipolar_lines(truth: Array) -> tuple[int, int]:
    """Return the row and the column (y, x) along which the outer views differ most.

    Epipolar images through them show slopes. They lie in the middle three fifths of the picture.
    """
    across = np.abs(truth[truth.shape[0] // 2, -1] - truth[truth.shape[0] // 2, 0])
    down = np.abs(truth[-1, truth.shape[1] // 2] - truth[0, truth.shape[1] // 2])
    found = []
    for difference, axis in ((across, 0), (down, 1)):
        inner = difference[tuple(slice(n // 5, n - n // 5) for n in difference.shape[:2])].mean(
            axis=(1 - axis, 2)
        )
        found.append(int(inner.argmax()) + difference.shape[axis] // 5)
    return found[0], found[1]


def detailed_pieces(picture: Array, side: int, count: int = 1) -> list[Piece]:
    """Return the squares of a picture (y, x, c) with most edges and colour, away from each other.

    They lie inside the border, which has no neighbours in other views.
    """
    height, width = picture.shape[:2]
    side = min(side, height, width)
    grey = picture.mean(axis=-1, dtype=np.float32)
    slope_y, slope_x = np.gradient(grey)
    spread = np.abs(picture - grey[..., None]).mean(axis=-1)
    interest = np.minimum(np.hypot(slope_y, slope_x), 0.2) + 0.5 * np.abs(np.gradient(spread)[0])
    sums = cv2.boxFilter(interest.astype(np.float32), -1, (side, side), anchor=(0, 0))
    sums = sums[: height - side + 1, : width - side + 1].copy()
    border = [min((length - side) // 2, length // 12) for length in (height, width)]
    inside = np.zeros(sums.shape, dtype=bool)
    inside[border[0] : height - side + 1 - border[0], border[1] : width - side + 1 - border[1]] = 1
    sums[~inside] = -1
    found = []
    for _ in range(count):
        y, x = np.unravel_index(int(sums.argmax()), sums.shape)
        found.append(Piece(int(y), int(x), side))
        sums[max(0, y - side) : y + side, max(0, x - side) : x + side] = -1
    return found

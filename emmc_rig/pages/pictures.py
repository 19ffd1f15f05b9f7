"""Small pictures of a light field for figures: views, epipolar images, pieces to enlarge."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.files import whole_file
from emmc_rig.model.lightfield import centre_view, epi_horizontal, epi_vertical

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Pictures:
    """corner, centre: views (y, x, c), the top-left and the centre one. across: (u, x, c), along
    a row of the centre row of views; down: (v, y, c), along a column.
    """

    corner: Array
    centre: Array
    across: Array
    down: Array

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all; half precision is finer than a screen."""
        path.parent.mkdir(exist_ok=True)
        arrays = {f.name: getattr(self, f.name).astype(np.float16) for f in fields(self)}
        with whole_file(path) as partial, open(partial, "wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> Pictures | None:
        """Read what `save` wrote; None where there is nothing whole."""
        try:
            with open(path, "rb") as stream, np.load(stream) as file:
                return cls(*(file[f.name].astype(np.float32) for f in fields(cls)))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None


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


def pictures_of(light_field: Array, lines: tuple[int, int]) -> Pictures:
    """Return the pictures of a light field (v, u, y, x, c); lines: row and column."""
    y, x = lines
    return Pictures(
        light_field[0, 0],
        centre_view(light_field),
        epi_horizontal(light_field, light_field.shape[0] // 2, y),
        epi_vertical(light_field, light_field.shape[1] // 2, x),
    )

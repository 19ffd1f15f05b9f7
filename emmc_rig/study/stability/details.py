"""A small detail put into a scene, and how much of it a reconstruction keeps, or invents.

The detail lies on a plane at the disparity of its place and is as bright in every view. How much of
it a picture shows is its projection: <difference, detail> / <detail, detail>, 1 where it is whole,
0 where there is none. Two reconstructions with the same noise, with and without the detail, show
what is kept; the one without, against its truth, shows what is invented.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
HAIR_PX = 20
"""Length of a hair."""
KEPT = 0.5
"""Share from which a detail counts as kept, or as invented."""


def _letter(size_px: int) -> Array:
    """Return an E whose strokes are so wide."""
    letter = np.array([[1, 1, 1], [1, 0, 0], [1, 1, 1], [1, 0, 0], [1, 1, 1]], dtype=np.float64)
    return np.kron(letter, np.ones((size_px, size_px)))


def _hair(size_px: int) -> Array:
    """Return a slanting line so wide."""
    at = np.arange(HAIR_PX)
    off = np.abs(at[None, :] - at[:, None] / 2 - HAIR_PX / 4) / np.hypot(1, 0.5)
    return np.clip(size_px / 2 + 0.5 - off, 0, 1)


def _glint(size_px: int) -> Array:
    """Return a spot so wide."""
    return np.ones((size_px, size_px))


SHAPES: dict[str, tuple[Callable[[int], Array], int]] = {
    "letter": (_letter, 1),
    "hair": (_hair, -1),
    "glint": (_glint, 1),
}
"""How each is drawn, and whether it is brighter (1) or darker (-1) than what it lies on."""


@dataclass(frozen=True)
class Detail:
    """kind: a name of SHAPES. size_px: width of its strokes. contrast: of full scale."""

    kind: str
    size_px: int
    contrast: float

    @property
    def label(self) -> str:
        """In words."""
        return f"{self.kind}, {self.size_px} px, contrast {self.contrast:g}"

    def put_into(self, light_field: Array, disparity_px: float) -> Array:
        """Return a light field (v, u, y, x, c) with the detail in the middle of the centre view.

        It is darker where what it lies on is too bright to be brighter, and the other way round.
        """
        draw, sign = SHAPES[self.kind]
        shape = draw(self.size_px)
        views_v, views_u, rows, columns, _ = light_field.shape
        picture = np.zeros((rows, columns), dtype=np.float32)
        top, left = (rows - shape.shape[0]) // 2, (columns - shape.shape[1]) // 2
        place = np.s_[top : top + shape.shape[0], left : left + shape.shape[1]]
        picture[place] = shape
        there = light_field[views_v // 2, views_u // 2][place].mean()
        if not 0 <= there + sign * self.contrast <= 1:
            sign = -sign
        found = np.empty_like(light_field)
        for v, u in np.ndindex(views_v, views_u):
            by = disparity_px * (u - views_u // 2), disparity_px * (v - views_v // 2)
            move = np.array([[1, 0, by[0]], [0, 1, by[1]]], dtype=np.float64)
            seen = cv2.warpAffine(picture, move, (columns, rows), flags=cv2.INTER_LINEAR)
            found[v, u] = light_field[v, u] + sign * self.contrast * seen[..., None]
        return np.clip(found, 0, 1)


Fate = Literal["kept", "lost", "invented", "kept, and invented without"]


@dataclass(frozen=True)
class Shown:
    """kept: share of a detail that is shown where it is. invented: where it is not."""

    kept: float
    invented: float

    @property
    def fate(self) -> Fate:
        """What becomes of the detail."""
        if abs(self.invented) >= KEPT:
            return "kept, and invented without" if self.kept >= KEPT else "invented"
        return "kept" if self.kept >= KEPT else "lost"


def shown(with_it: Array, without: Array, truth_with: Array, truth_without: Array) -> Shown:
    """Return how much of a detail two reconstructions show; all are light fields."""
    detail = (truth_with - truth_without).astype(np.float64)
    power = max(float(np.sum(np.square(detail))), 1e-12)
    kept = float(np.sum((with_it - without) * detail)) / power
    return Shown(kept, float(np.sum((without - truth_without) * detail)) / power)

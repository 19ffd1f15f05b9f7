"""The lens's pupil: which part of every aperture cell is open, seen from a point of the sensor.

The views are cells of a grid over the aperture. A lens is round, or a polygon of blades: it covers
the grid's corners. A pixel off the axis sees the pupil through the rim of the lens's barrel as
well, a second disk that moves over the aperture with the pixel (mechanical vignetting).

What is open of a cell is cut into strips along y. The pupil is convex, so a strip's opening is one
interval in x; its moments give a box of equal area, middle and spread:

    share = area / cell area,    (x, y) = mean,    width^2 = 12 variance

The mask's shadow through the opening is the sum of the shadows through the boxes. Four strips miss
0.13 % of Psi for 25 mm of round pupil behind 5 x 5 views of 5 mm (shadow of a cell: 30 um on mask
cells of 24 um), eight 0.03 %; a cell that is wholly open is one exact box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.settings import Settings

LONGEST_MM = 1e6
Length = Annotated[float, Field(gt=0, lt=LONGEST_MM)]
Place = Annotated[float, Field(gt=-LONGEST_MM, lt=LONGEST_MM)]
STRIPS = 4
"""Of a cell that is cut: see the module's figures."""
LINES = 64
"""Lines in x by which a strip is integrated: 16 miss 0.2 % of Psi behind an upright square, and
fits of the pupil stop at their steps."""
LEAST_SHARE = 1e-4
"""Of a cell: a view that is less open is outside of the pupil."""
KNOTS_PER_CELL = 16
"""Places of the picture where openings are integrated while the rim moves by an aperture cell.
Bilinear blending between them misses 0.15 % of Psi (samples of 0.5 mm, rim of 26 mm before 25 mm
of round pupil); 8 miss 0.5 %, 12 miss 0.2 %."""
MOST_KNOTS = 33
"""Along an axis of the picture."""


class Rim(Settings):
    """The rim that cuts the pupil off the axis: a disk in the pupil's plane.

    shift: by which its middle moves there, in mm, for each mm of the pixel from the axis; in the
    pixel's direction where it is positive.
    """

    diameter_mm: Length
    shift: float = Field(default=-1.0, gt=-1e3, lt=1e3)


class Pupil(Settings):
    """The lens's open aperture: a disk, a polygon of blades, or a square.

    diameter_mm: of the disk, of the circle around the polygon, or the square's side. centre_mm: x
    and y from the middle of the views. turn_deg: of polygon or square, from x towards y.
    """

    shape: Literal["round", "polygon", "square"] = "round"
    diameter_mm: Length
    centre_mm: tuple[Place, Place] = (0.0, 0.0)
    blades: int = Field(default=6, ge=3, le=64, description="of a polygon")
    turn_deg: float = 0.0
    rim: Rim | None = None

    def chords(
        self, y_mm: NDArray[np.float64], pixel_mm: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return where the opening begins and ends along x at every y, in mm; begin >= end: shut.

        pixel_mm: x and y of the pixel that looks, from the axis.
        """
        x_mm, middle_mm = self.centre_mm
        if self.shape == "round":
            begin, end = _disk_chords(y_mm - middle_mm, self.diameter_mm / 2)
        else:
            corners = 4 if self.shape == "square" else self.blades
            around = self.diameter_mm / 2 * (np.sqrt(2) if self.shape == "square" else 1.0)
            # A square stands on its side, a polygon of blades has a corner on x.
            first = np.pi / 4 if self.shape == "square" else 0.0
            turn = first + np.deg2rad(self.turn_deg)
            begin, end = _polygon_chords(y_mm - middle_mm, around, corners, turn)
        begin, end = begin + x_mm, end + x_mm
        if self.rim is not None:
            rim_x, rim_y = (self.rim.shift * place for place in pixel_mm)
            cut_begin, cut_end = _disk_chords(y_mm - rim_y, self.rim.diameter_mm / 2)
            begin, end = np.maximum(begin, cut_begin + rim_x), np.minimum(end, cut_end + rim_x)
        return begin, end


def _disk_chords(
    y: NDArray[np.float64], radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    half = np.sqrt(np.maximum(radius**2 - y**2, 0.0))
    return -half, half


def _polygon_chords(
    y: NDArray[np.float64], radius: float, corners: int, turn_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the chords of a regular polygon: of every side, n . (x, y) <= radius cos(pi / n)."""
    begin, end = np.full_like(y, -np.inf), np.full_like(y, np.inf)
    reach = radius * np.cos(np.pi / corners)
    for side in range(corners):
        angle = turn_rad + (side + 0.5) * 2 * np.pi / corners
        across, down = np.cos(angle), np.sin(angle)
        if abs(across) < 1e-12:
            end = np.where(down * y <= reach, end, -np.inf)
        elif across > 0:
            end = np.minimum(end, (reach - down * y) / across)
        else:
            begin = np.maximum(begin, (reach - down * y) / across)
    return begin, end


@dataclass(frozen=True, eq=False)
class Openings:
    """The boxes through which the views look: one of a whole view, several of a view that is cut.

    view: (box, 2), row and column of the view. share: (box,), of the cell's area. x_um, y_um:
    (box,), middle of the box from the middle of its cell. width_um, height_um: (box,).
    """

    view: NDArray[np.int64]
    share: NDArray[np.float64]
    x_um: NDArray[np.float64]
    y_um: NDArray[np.float64]
    width_um: NDArray[np.float64]
    height_um: NDArray[np.float64]

    def of_view(self, v: int, u: int) -> NDArray[np.intp]:
        """Return the indices of one view's boxes."""
        return np.flatnonzero((self.view == (v, u)).all(axis=1))

    def shares(self, views: tuple[int, int]) -> NDArray[np.float64]:
        """Return which share of every view is open, (v, u)."""
        total = np.zeros(views)
        np.add.at(total, tuple(self.view.T), self.share)
        return total


def cell_openings(
    pupil: Pupil | None,
    views: tuple[int, int],
    cell_um: float,
    fill: float = 1.0,
    pixel_um: tuple[float, float] = (0.0, 0.0),
    strips: int = STRIPS,
    whole: Sequence[tuple[int, int]] | None = None,
) -> Openings:
    """Return the boxes of all views, as a pixel at (x, y) from the axis sees them.

    cell_um: between the middles of two views; fill: open width of a cell, of cell_um. Without a
    pupil every cell is open. whole: views that are one box (default: those that are wholly open);
    every other view has `strips` boxes, even if shut, so that boxes of several pupils correspond.
    """
    v_um, u_um = (centred_grid(count, cell_um) for count in views)
    open_um = cell_um * fill
    v, u = (index.ravel() for index in np.indices(views))
    if pupil is None:
        full = np.ones(len(v))
        return Openings(
            np.stack([v, u], 1), full, 0 * full, 0 * full, open_um * full, open_um * full
        )
    lines = strips * LINES
    # Lines lie in the middle of equal parts of the cell; of a point aperture all lie in its middle.
    within_um = centred_grid(lines, open_um / lines)
    y_um = v_um[:, None] + within_um
    pixel_mm = pixel_um[0] / 1e3, pixel_um[1] / 1e3
    begin, end = (1e3 * chord for chord in pupil.chords(y_um / 1e3, pixel_mm))
    middle_um = u_um[None, :, None]
    if open_um == 0:
        inside = ((begin[:, None] <= middle_um) & (middle_um <= end[:, None])).mean(axis=2)
        none = np.zeros(len(v))
        return Openings(np.stack([v, u], 1), inside.ravel(), none, none, none, none)
    left = np.clip(begin[:, None] - middle_um, -open_um / 2, open_um / 2)
    right = np.clip(end[:, None] - middle_um, -open_um / 2, open_um / 2)
    length = np.maximum(right - left, 0.0)
    area = length / open_um / lines
    # (right^3 - left^3) / 3, without powers, which take most of the time.
    cube = length * (right * right + right * left + left * left) / 3
    sums = {
        "share": area,
        "x": (right + left) / 2 * area,
        "x2": cube / open_um / lines,
        "y": within_um * area,
        "y2": (within_um**2 + (open_um / lines) ** 2 / 12) * area,
    }
    total = area.sum(axis=2)
    is_whole = total > 1 - 1e-9
    if whole is not None:
        is_whole = np.zeros(views, dtype=bool)
        for view in whole:
            is_whole[view] = True
    parts = np.where(is_whole, 1, strips).ravel()
    chosen = np.repeat(np.stack([v, u], 1), parts, axis=0)
    # A whole view's box is the sum of its strips.
    first = np.concatenate([[0], np.cumsum(parts)[:-1]])

    def of_boxes(values: NDArray[np.float64]) -> NDArray[np.float64]:
        by_strip = values.reshape(len(v), strips, LINES).sum(axis=2)
        found = np.empty(len(chosen))
        found[first[parts == 1]] = by_strip[parts == 1].sum(axis=1)
        if strips > 1:
            cut = first[parts > 1][:, None] + np.arange(strips)
            found[cut] = by_strip[parts > 1]
        return found

    share, x, x2, y, y2 = (of_boxes(values) for values in sums.values())
    safe = np.maximum(share, 1e-12)
    x, y = x / safe, y / safe
    return Openings(
        chosen,
        share,
        x,
        y,
        np.sqrt(12 * np.maximum(x2 / safe - x**2, 0.0)),
        np.sqrt(12 * np.maximum(y2 / safe - y**2, 0.0)),
    )


@dataclass(frozen=True, eq=False)
class Knot:
    """A place of the picture where openings are integrated.

    x_um, y_um: from the axis. rows, columns: of the picture's samples around it. down, across: how
    much the knot counts at these; of all knots together 1.
    """

    x_um: float
    y_um: float
    rows: slice
    columns: slice
    down: NDArray[np.float64]
    across: NDArray[np.float64]


def field_knots(
    pupil: Pupil | None,
    cell_um: float,
    samples_um: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> list[Knot]:
    """Return the knots of a picture with samples at y and x: one, wherever all see the same.

    A rim moves over the pupil with the pixel: openings are integrated at knots of a grid over the
    picture, and blended bilinearly between them,

        opening(y, x) = sum_knots max(0, 1 - |y - y_knot| / step) max(0, 1 - |x - x_knot| / step)
                        opening(y_knot, x_knot),

    KNOTS_PER_CELL of them while the rim moves by cell_um.
    """
    if pupil is None or pupil.rim is None:
        everywhere = slice(None)
        return [Knot(0.0, 0.0, everywhere, everywhere, *(np.ones(len(s)) for s in samples_um))]
    step_um = cell_um / KNOTS_PER_CELL / max(abs(pupil.rim.shift), 1e-9)
    along = [_tents(places_um, step_um) for places_um in samples_um]
    return [
        Knot(x_um, y_um, rows, columns, down, across)
        for y_um, rows, down in along[0]
        for x_um, columns, across in along[1]
    ]


def _tents(
    samples_um: NDArray[np.float64], step_um: float
) -> list[tuple[float, slice, NDArray[np.float64]]]:
    """Return the knots along an axis, with the samples around each and how much it counts there."""
    first, last = samples_um[[0, -1]]
    count = int(np.clip(np.ceil((last - first) / step_um) + 1, 2, MOST_KNOTS))
    places = np.linspace(first, last, count) if last > first else np.array([first])
    found = []
    for place, tent in zip(places, np.eye(len(places)), strict=True):
        counts = np.interp(samples_um, places, tent)
        near = np.flatnonzero(counts)
        if len(near):
            samples = slice(int(near[0]), int(near[-1]) + 1)
            found.append((float(place), samples, counts[samples]))
    return found

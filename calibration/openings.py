"""Which views a whiteboard opens: one by the pinhole, all by the plate's window, or a part of them.

The window, moved by whole aperture cells, uncovers the views on one side alone: halves and corners
of the aperture. Sums of fewer views determine single ones better than the whole, and are brighter
than the pinhole: ten such whiteboards replace one of every view where the mask is known by design.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

View = tuple[int, int]
Window = tuple[int, int]
CENTRED: Window = (0, 0)


def views_open(
    views: tuple[int, int], pinhole: View | None, window: Window = CENTRED
) -> NDArray[np.bool_]:
    """Return which views (v, u) are open.

    pinhole: before this view alone; None: the window, moved by so many cells in x and y.
    """
    opened = np.zeros(views, dtype=bool)
    if pinhole is not None:
        opened[pinhole] = True
        return opened
    down, across = (
        slice(max(cells, 0), count + min(cells, 0))
        for cells, count in zip(reversed(window), views, strict=True)
    )
    opened[down, across] = True
    return opened


def window_place_um(
    window: Window, views: tuple[int, int], cell_um: float, side_um: float
) -> tuple[float, float]:
    """Return where the window's middle stands, x and y from the axis, to uncover whole cells.

    side_um: of the window, which is a little larger than the aperture: the edge that crosses the
    aperture is put between two cells.
    """
    x_um, y_um = (
        cells * cell_um + np.sign(cells) * (side_um - count * cell_um) / 2
        for cells, count in zip(window, reversed(views), strict=True)
    )
    return float(x_um), float(y_um)


def parts(views: tuple[int, int]) -> list[Window]:
    """Return the windows that uncover halves, then corners, of the aperture."""
    rows, columns = views
    half_x, half_y = (columns + 1) // 2, (rows + 1) // 2
    corner_x, corner_y = columns // 2, rows // 2
    halves = [(half_x, 0), (-half_x, 0), (0, half_y), (0, -half_y)]
    corners = [(x, y) for x in (corner_x, -corner_x) for y in (corner_y, -corner_y)]
    return [
        window
        for window in dict.fromkeys((*halves, *corners))
        if window != CENTRED and views_open(views, None, window).any()
    ]
